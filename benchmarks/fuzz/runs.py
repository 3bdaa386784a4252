"""Readers of a run folder's files: what the engine, `status`, `verify`, `report`, `inspect` and `export` read."""

import contextlib
import hashlib
import io
import json
import os
import shutil
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from random import Random
from typing import Any

from benchmarks.fuzz import json_text, safetensors_bytes
from benchmarks.fuzz.reader import Opened, Reader
from tests.stages import captures

REPORTS = {
    "poses/report.json": None,  # the stage's own
    "bake/report.json": {"resolution": 64, "voxels": 1000, "bytes": 12345, "psnr_before": 20.5, "psnr_after": 22.5, "layout": "sparse", "lost": False},
    "mesh/report.json": {"vertices": 10, "faces": 20, "watertight": True, "area": 1.5, "bounds": [[0, 0, 0], [1, 1, 1]]},
    "evaluate/metrics.json": {
        "split": "test", "network": {"psnr": 24.5, "ssim": 0.8}, "asset": {"psnr": 23.5, "ssim": 0.75},
        "mesh": {"psnr": 22.5, "ssim": 0.7, "psnr_vertex_colours": 21.5, "faces": 100},
        "gap": {"psnr": -1.0, "ssim": -0.05, "psnr_colour_fitted": -0.75}, "holes": 0.02, "floaters": 0.03,
        "strips": [{"which": "worst", "view": "img_0.png", "network": {"psnr": 24.5, "ssim": 0.8}, "asset": {"psnr": 23.5, "ssim": 0.75}}],
        "views": [{"name": "img_0.png", "network": {"psnr": 24.5, "ssim": 0.8}, "asset": {"psnr": 23.5, "ssim": 0.75}, "gap": {"psnr": -1.0, "ssim": None},
                   "holes": 0.02, "floaters": None}],
    },
}  # fmt: skip


@cache
def _made_run() -> Path:
    """A run with the poses stage done, made once a process, in the folder of its temporary files, and copied."""
    from workflows.cli.main import main

    folder = Path(tempfile.mkdtemp(prefix="fuzz-run-"))
    source = captures.nerfstudio(folder / "source", captures.cameras(4))
    captures.colmap_bin(folder / "model", captures.cameras(4))
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        code = main(["run", str(folder / "model"), "--out", str(folder / "run"), "--until", "poses", "--preset", "tiny", "--quiet"])
    assert code == 0, f"the run to be fuzzed ended with {code}"
    for name, content in REPORTS.items():
        if content is not None:
            (folder / "run" / name).parent.mkdir(exist_ok=True)
            (folder / "run" / name).write_text(json.dumps(content))
    shutil.rmtree(source)
    return folder


def run_in(folder: Path) -> Path:
    shutil.copytree(_made_run() / "model", folder / "model")
    return Path(shutil.copytree(_made_run() / "run", folder / "run"))


def seed_of(name: str) -> Callable[[], list[bytes]]:
    return lambda: [(_made_run() / "run" / name).read_bytes()]


def opened(name: str, call: Callable[[Path], object], *commands: tuple[str, ...]) -> Callable[[Path], Opened]:
    """A reader of the file `name` of a run, and the commands that read it; RUN and OUT in them stand for the run and a file next to it."""

    def open_it(folder: Path) -> Opened:
        run, out = run_in(folder), folder / "out"
        path = run / name
        path.parent.mkdir(exist_ok=True)

        def read(data: bytes) -> None:
            path.write_bytes(data)
            call(run)

        def prepare(data: bytes) -> None:
            path.write_bytes(data)
            for made in folder.glob("out*"):
                made.unlink()

        filled = tuple(tuple(word.replace("RUN", str(run)).replace("OUT", str(out)) for word in command) for command in commands)
        return Opened(read, filled, prepare)

    return open_it


def _open_run(run: Path) -> None:
    from workflows.cli.target import open_run

    open_run(run).plain()


def _manifest(run: Path) -> None:
    from pipeline.manifest import read_manifest

    made = read_manifest(run / "poses")
    assert all(not os.path.isabs(name) and ".." not in name.split("/") for name in made.outputs), "a name outside"
    made.to_bytes()


def manifest_changed(rng: Random, data: bytes) -> bytes:
    """A change of a value; the digests and the checksum are put right, so that what comes after them is reached."""
    found = json_text.changed(rng, data)
    if rng.random() < 0.15:
        return found
    document = json_text.parsed(found)
    if not isinstance(document, dict):
        return found
    with contextlib.suppress(Exception):
        document["request_digest"] = _sha(document["request"])
    with contextlib.suppress(Exception):
        rows = [[name, document["outputs"][name]["sha256"]] for name in sorted(document["outputs"]) if not document["outputs"][name].get("volatile", False)]
        document["digest"] = _sha(["artifact", rows])
    document.pop("checksum", None)
    with contextlib.suppress(Exception):
        document["checksum"] = _sha(document)
    try:
        return json.dumps(document).encode("utf-8", "surrogatepass")
    except (ValueError, RecursionError):
        return found


def _sha(value: Any) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=True, allow_nan=False).encode("ascii")).hexdigest()


def _lock(run: Path) -> None:
    from pipeline.locks.lock import holder_of

    holder = holder_of(run)
    if holder is not None:
        holder.text()


def lock_seeds() -> list[bytes]:
    return [
        json.dumps({"pid": pid, "host": host, "since": 1.7e9, "command": "enerf run x"}).encode() for pid, host in ((os.getpid(), "elsewhere"), (1, "here"))
    ]


def _hashes(run: Path) -> None:
    from pipeline.hashes import Hashes

    found = Hashes(run / ".cache" / "hashes.json")
    found.digest("poses/scene.json", run / "poses" / "scene.json")
    found.forget("source")
    found.save()


def hashes_seeds() -> list[bytes]:
    entries = {f"poses/{k}": [100, 10**18, 5, "ab" * 32] for k in range(4)}
    return [json.dumps({"format": "enerf-hashes-1", "files": entries}).encode()]


def _scene(run: Path) -> None:
    import numpy as np

    from stages.io import scene

    found = scene.load(run / "poses")
    for view in found.views:
        for camera in (view.camera, view.source_camera):
            assert np.isfinite(camera.world_from_camera).all(), "a camera that is not finite"
            assert np.isfinite(camera.params).all(), "a lens that is not finite"
    scene.describe(run / "poses")


def scene_seeds() -> list[bytes]:
    """As the poses stage writes it; with a mask; of a forward-facing capture."""
    document = json.loads(seed_of("poses/scene.json")()[0])
    masked = {**document, "views": [{**view, "mask": "masks/a.png"} for view in document["views"]], "background": [1.0, 1.0, 1.0], "space": "box"}
    return [json.dumps(each).encode() for each in (document, masked, {**document, "format": 1})]


def _points(run: Path) -> None:
    from stages.io import scene

    found = scene.read_points(run / "poses")
    assert found.xyz.ndim == 2, "points of another shape"


@cache
def _decisions(run: Path) -> tuple[Any, list[Any]]:
    """The run and the state of its stages, which the reports have no part in."""
    from pipeline.decide import survey
    from workflows.asset import STAGES
    from workflows.cli.target import open_run

    found = open_run(run)
    return found, survey(STAGES, found)


def _page(run: Path) -> None:
    from workflows.report import page

    page.page(*_decisions(run)).encode("utf-8")


def _reports(name: str) -> Reader:
    read = opened(name, _page, ("report", "RUN"), ("inspect", "RUN"), ("inspect", "RUN", "--json"))
    return Reader(f"report_{name.split('/')[0]}", f"{name} of a run", seed_of(name), json_text.changed, read, every=100, share=1 / len(REPORTS))


_STATUS = (("status", "RUN"), ("status", "RUN", "--json"))
READERS = (
    Reader("run", "run.json", seed_of("run.json"), json_text.changed,
           opened("run.json", _open_run, *_STATUS, ("run", "--out", "RUN", "--dry-run"), ("report", "RUN"), ("inspect", "RUN"))),
    Reader("manifest", "manifest.json of an artifact", seed_of("poses/manifest.json"), manifest_changed,
           opened("poses/manifest.json", _manifest, *_STATUS, ("verify", "RUN"), ("report", "RUN"), ("inspect", "RUN"))),
    Reader("lock", ".lock.json, who writes a run", lock_seeds, json_text.changed, opened(".lock.json", _lock, *_STATUS)),
    Reader("hashes", ".cache/hashes.json", hashes_seeds, json_text.changed, opened(".cache/hashes.json", _hashes, *_STATUS)),
    Reader("scene", "scene.json, the cameras of a run", scene_seeds, json_text.changed,
           opened("poses/scene.json", _scene, ("inspect", "RUN"), ("inspect", "RUN", "--json"), ("export", "RUN", "--to", "OUT.json"), *_STATUS)),
    Reader("points", "points.safetensors of a run", seed_of("poses/points.safetensors"), safetensors_bytes.changed,
           opened("poses/points.safetensors", _points, ("inspect", "RUN")), share=0.25),
    *(_reports(name) for name in REPORTS),
)  # fmt: skip
