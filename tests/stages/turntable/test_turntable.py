"""The turntable stage: its files, and that a stop in the middle changes none of their bytes."""

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import OpenEXR
import pytest

from efficientnerf.asset import format
from efficientnerf.asset.camera_paths import turntable_cameras
from efficientnerf.asset.tree import Region, tree_from_voxels
from efficientnerf.evaluation.metrics import psnr
from pipeline.errors import Interrupted
from pipeline.stage import Job
from stages.figures import frames as figures
from stages.io.png import read_png
from stages.turntable.run import cameras_of, render_turntable
from stages.turntable.settings import STAGE, TurntableSettings
from tests.fakes import BallTree
from tests.stages.spoilers import SPOILERS

SETTINGS = TurntableSettings(frames=5, width=64, height=48, fps=10)


class CountingTree(BallTree):
    calls: int = 0

    def render(self, camera: Any, **options: Any) -> Any:
        type(self).calls += 1
        return super().render(camera, **options)


def digests(folder: Path) -> dict[str, str]:
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in folder.iterdir()}


def job_in(folder: Path, out: str = "out", settings: TurntableSettings = SETTINGS, **more: Any) -> Job:
    return Job(settings=settings, out=folder / out, work=folder / "work", **more)


def rendered(job: Job, tree: BallTree = BallTree()) -> Job:  # noqa: B008 (frozen)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(figures, "render", lambda tree, camera, **options: tree.render(camera, **options))
        render_turntable(tree, job, cameras_of(tree, job.settings))
    return job


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The digests of an undisturbed turntable."""
    return digests(rendered(job_in(tmp_path_factory.mktemp("whole"))).out)


def stopped(folder: Path, moment: int) -> None:
    asked = iter(range(100))
    with pytest.raises(Interrupted):
        rendered(job_in(folder, "first", stop=lambda: 2 if next(asked) >= moment else None))


def test_it_writes_frames_a_video_of_them_and_one_exr(tmp_path: Path) -> None:
    job = rendered(job_in(tmp_path))
    assert sorted(digests(job.out)) == ["frame_0000.exr", *(f"frame_000{k}.png" for k in range(5)), "turntable.mp4"]
    frames = [read_png(job.out / f"frame_000{k}.png") for k in range(5)]
    assert all(frame.shape == (48, 64, 3) for frame in frames)
    assert (frames[0][0, 0] == 255).all()
    assert not (frames[0] == frames[1]).all()
    with av.open(str(job.out / "turntable.mp4")) as container:
        decoded = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert len(decoded) == 5
    assert min(psnr(a / 255.0, b / 255.0) for a, b in zip(decoded, frames, strict=True)) > 30
    with OpenEXR.File(str(job.out / "frame_0000.exr"), separate_channels=True) as file:
        channels = {name: channel.pixels.copy() for name, channel in file.channels().items()}
    assert channels["A"][24, 32] > 0.99
    camera = turntable_cameras(BallTree(), frames=5, width=64, height=48)[0]
    assert channels["depth.Z"][24, 32] == pytest.approx(np.linalg.norm(camera.centre) - 0.6, abs=0.05)
    assert np.isinf(channels["depth.Z"][0, 0])


@pytest.mark.parametrize("moment", [1, 3, 6, 8])
def test_a_stop_anywhere_and_going_on_gives_the_same_bytes(whole: dict[str, str], tmp_path: Path, moment: int) -> None:
    stopped(tmp_path, moment)
    CountingTree.calls = 0
    assert digests(rendered(job_in(tmp_path, "second"), CountingTree()).out) == whole
    assert CountingTree.calls == max(0, 5 - moment), "finished frames are not drawn again"


@pytest.mark.parametrize(("how", "suffix"), [("cut", ".png"), ("zero", ".exr"), ("link", ".png"), ("half zero", ".json")])
def test_every_scratch_file_of_a_turntable_may_be_damaged(whole: dict[str, str], tmp_path: Path, suffix: str, how: str) -> None:
    stopped(tmp_path, 3)
    for path in sorted((tmp_path / "work" / "frames").glob(f"*{suffix}")):
        SPOILERS[how](path)
    events: list[dict[str, Any]] = []
    assert digests(rendered(job_in(tmp_path, "second", report=events.append)).out) == whole
    assert [event["text"].partition(" ")[0] for event in events if event["event"] == "warning"] == ["frame_0000.json"]


def test_the_foreground_is_shown_unless_all_is_asked_for_and_framed_in_both(tmp_path: Path) -> None:
    indices = np.stack(np.meshgrid(*[np.arange(16)] * 3, indexing="ij"), -1).reshape(-1, 3)
    tree = tree_from_voxels((4, 4, 4), 0.125, np.full(3, -1.0), indices, np.full(len(indices), 400.0), np.zeros((len(indices), 1, 3)))
    (tmp_path / "bake").mkdir()
    region = Region(np.array([[-0.5, -0.5, -1.0], [0.5, 0.5, 0.0]]))
    format.save(replace(tree, region=region), tmp_path / "bake" / "asset.nerftree")
    frames = {}
    for name in ("foreground", "all"):
        settings = TurntableSettings(frames=2, width=64, height=64, exr="off", region=name)  # type: ignore[arg-type]
        job = job_in(tmp_path / name, settings=settings, inputs={"bake": tmp_path / "bake"})
        STAGE.run(job)
        frames[name] = read_png(job.out / "frame_0000.png").min(axis=2) < 200
    rows, columns = np.nonzero(frames["foreground"])
    assert 2 <= rows.min() <= 63 - rows.max() + 4
    assert min(rows.min(), columns.min(), 63 - rows.max(), 63 - columns.max()) >= 1, "whole"
    assert np.ptp(rows) > 40
    assert frames["all"].sum() > 1.15 * frames["foreground"].sum()
