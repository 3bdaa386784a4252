"""Fleets that never ran, for tests of what shows them."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from pipeline.fleet.state import FleetState, SceneState, StageState, Totals, Verdict
from stages.artifacts import TurntableOutputs
from workflows.report.signature import write_page

NASTY = '</script><script>alert("x")</script> & <b>\x1b[2J'
STAGES = ("poses", "train", "bake", "turntable")


def done(name: str, psnr: float = 30.0, seconds: float = 8.0, size: int = 2_000_000, **more: object) -> SceneState:
    """A scene that is done; its stages took equally long."""
    stages = {stage: StageState("done", seconds / len(STAGES)) for stage in STAGES}
    metrics = {"asset": {"psnr": psnr, "ssim": 0.9}, "network": {"psnr": psnr + 1, "ssim": 0.95}}
    verdicts = {"verdict": Verdict("good", "All is well."), "result": Verdict("poor", f"All is fog {NASTY}.")}
    return SceneState(name, "done", metrics=metrics, seconds=seconds, bytes=size, stages=stages, run=name, **verdicts, **more)  # type: ignore[arg-type]


def fleet(*scenes: SceneState, state: str = "running") -> FleetState:
    made = FleetState(started="2026-11-23T03:00:00Z", updated="2026-11-23T04:00:00Z", forecast_seconds=90.0, slots=2, scenes=list(scenes))
    made.state, made.totals = state, Totals.of(made.scenes)  # type: ignore[assignment]
    return made


def mixed(count: int = 24, state: str = "running") -> FleetState:
    """A tenth is quarantined with what a stranger might write into a message, some wait or run."""
    scenes = []
    for number in range(count):
        name = f"scene-{number:03d}"
        if number % 10 == 3:
            scenes.append(SceneState(name, "quarantined", NASTY, stage=None, last_lines=[NASTY, "last"], warnings=[NASTY], run=name, sources=[f"/{NASTY}"]))
        elif number % 10 in (5, 7):
            waiting = number % 10 == 5
            scenes.append(
                SceneState(name, "waiting" if waiting else "running", stage=None if waiting else "train", run=name, worker=None if waiting else NASTY)
            )
        else:
            scenes.append(done(name, 20 + number % 7, 10 + number % 3, 1_000_000 * (1 + number % 5)))
    return fleet(*scenes, state=state)


def short_video(path: Path) -> bytes:
    """Some frames of H.264; the file is removed."""
    import av

    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=10)
        stream.width, stream.height, stream.pix_fmt = 96, 72, "yuv420p"
        for number in range(5):
            frame = av.VideoFrame.from_ndarray(np.full((72, 96, 3), 40 * number, np.uint8))
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    data = path.read_bytes()
    path.unlink()
    return data


def with_pictures(folder: Path, state: FleetState) -> None:
    """Posters, a turntable's file and a report in the runs of scenes that are done."""
    video = short_video(folder / "short.mp4")
    for scene in state.scenes:
        if scene.state == "done":
            made = TurntableOutputs.of_run(folder / scene.name)
            made.folder.mkdir(parents=True)
            Image.new("RGB", (320, 200), (200, 120, 40)).save(made.poster)
            made.video.write_bytes(video)
            write_page(folder / scene.name / "report.html", b"the report")


def toy_manifest(folder: Path, count: int, **fails: str) -> Path:
    """A manifest of toy scenes s0, s1 and so on, whose sources are made; toy_manifest(folder, 3, s1="bad") lets the training of s1 fail so."""
    lines = ['preset = "tiny"']
    for number in range(count):
        source = folder / "shoots" / f"s{number}"
        source.mkdir(parents=True, exist_ok=True)
        (source / "a.txt").write_text(f"scene {number}", encoding="utf-8")
        lines += [f"[scenes.s{number}]", f'source = "{source}"', f'train.fail = "{fails.get(f"s{number}", "")}"']
    path = folder / "scenes.toml"
    path.write_text("\n".join(lines), encoding="utf-8")
    return path


def fleet_json(fleet: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((fleet / "fleet.json").read_text(encoding="utf-8"))
    return found


def facts(page: str) -> dict[str, Any]:
    """What a page's script is handed."""
    found = re.search(r'<script id="data" type="application/json">(.*?)</script>', page, re.DOTALL)
    assert found is not None
    out: dict[str, Any] = json.loads(found[1])
    return out
