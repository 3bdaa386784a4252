"""Every stage says before its work what it takes: it is refused where that does not fit, and made smaller where that changes no byte."""

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from pipeline.errors import UsageError
from pipeline.executors.memory import Limit
from pipeline.stage import Job
from stages.artifacts import BakeOutputs, TrainOutputs
from stages.bake import settings as bake
from stages.bake.settings import BakeSettings
from stages.evaluate import settings as evaluate
from stages.evaluate.settings import EvaluateSettings
from stages.mesh import settings as mesh
from stages.mesh.settings import MeshSettings
from stages.points import settings as points
from stages.points.settings import PointsSettings
from stages.poses.run import run as run_poses
from stages.poses.settings import PosesSettings
from stages.splats import settings as splats
from stages.splats.settings import SplatsSettings
from stages.train import settings as train
from stages.turntable import settings as turntable
from stages.turntable.settings import TurntableSettings
from tests.efficientnerf.balls import settings
from tests.stages.balls import job, poses

GIB = 2**30
QUICK = {"iterations": 4, "sample_batch_size": 1024, "occupancy_warmup_steps": 2, "preview_every": "off"}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A ball, trained and baked."""
    folder = tmp_path_factory.mktemp("memory")
    scene = poses(folder / "poses")
    train.STAGE.run(job(folder / "train", settings(**QUICK), poses=scene))
    inputs = {"poses": scene, "train": folder / "train/out"}
    bake.STAGE.run(job(folder / "bake", BakeSettings(resolution=16, samples_per_voxel=1, refine_steps=1, weight_threshold=0.0), **inputs))
    return {**inputs, "bake": folder / "bake/out", "mesh": folder / "none", "splats": folder / "none"}  # refused before a mesh is looked at


def limited(made: Job, size: int, events: list[dict[str, Any]] | None = None) -> Job:
    made.stage, made.memory = "toy", Limit(size, "--memory")
    if events is not None:
        made.report = events.append
    return made


def test_training_pixels_that_do_not_fit_go_to_a_file(made: dict[str, Path], tmp_path: Path) -> None:
    first = job(tmp_path / "first", settings(**QUICK), poses=made["poses"])
    train.STAGE.run(first)
    events: list[dict[str, Any]] = []
    short = limited(job(tmp_path / "short", settings(**QUICK), poses=made["poses"]), first.facts["memory"]["needed"] - 1, events)
    train.STAGE.run(short)
    assert sum("kept in a file" in event.get("text", "") for event in events) == 1
    assert short.facts["memory"]["needed"] < first.facts["memory"]["needed"]
    digests = [hashlib.sha256((each.out / TrainOutputs.field).read_bytes()).hexdigest() for each in (first, short)]
    assert digests[0] == digests[1]


@pytest.mark.parametrize(
    ("change", "remedy"),
    [
        ({"num_levels": 16, "log2_hashmap_size": 24, "finest_resolution": 4096}, "train.log2_hashmap_size (24)"),
        ({"sample_batch_size": "off", "max_rays_per_batch": 10**9}, "train.max_rays_per_batch (1000000000)"),
    ],
)
def test_training_that_does_not_fit_is_refused_before_it_begins(made: dict[str, Path], tmp_path: Path, change: dict[str, Any], remedy: str) -> None:
    large = limited(job(tmp_path, settings(**{**QUICK, **change}), poses=made["poses"]), 2 * GIB)
    with pytest.raises(UsageError) as caught:
        train.STAGE.run(large)
    assert remedy in str(caught.value)
    assert not list(large.out.iterdir())


@pytest.mark.parametrize(
    ("stage", "wanted", "remedy"),
    [
        (turntable, TurntableSettings(width=8192, height=8192), "turntable.width"),
        (points, PointsSettings(num_points=10**9), "points.num_points"),
        (mesh, MeshSettings(), "bake.max_mib"),
        (splats, SplatsSettings(make="on"), "splats.count (300000)"),
        (evaluate, EvaluateSettings(), "poses.max_image_size"),
    ],
)
def test_later_stages_are_refused_before_they_begin(made: dict[str, Path], tmp_path: Path, stage: Any, wanted: Any, remedy: str) -> None:
    small = stage in (mesh, evaluate, splats)
    inputs = {need: made[need] for need in stage.STAGE.needs}
    short = limited(job(tmp_path, wanted, **inputs), 2**28 if small else 2 * GIB)
    with pytest.raises(UsageError) as caught:
        stage.STAGE.run(short)
    assert remedy in str(caught.value)
    assert not list(short.out.iterdir())


def test_a_photograph_that_does_not_fit_is_refused_before_it_is_decoded(tmp_path: Path) -> None:
    source = tmp_path / "photographs"
    source.mkdir()
    for n in range(3):
        Image.new("L", (12000, 10000)).save(source / f"{n}.png")
    short = Job(settings=PosesSettings(), source=source, out=tmp_path / "out", work=tmp_path / "work", stage="poses", memory=Limit(GIB, "--memory"))
    with pytest.raises(UsageError, match="feature_image_size"):
        run_poses(short)
    assert not list(short.out.iterdir())


def test_enclosed_space_is_found_with_any_number_of_bricks_at_once(made: dict[str, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    from efficientnerf.asset.format import load
    from efficientnerf.surface import isosurface
    from efficientnerf.surface import volume as volumes
    from efficientnerf.surface.volume import volume_of

    volume = volume_of(load(made["bake"] / BakeOutputs.asset))
    whole = isosurface.enclosed_cells(volume, 1e-3, np.zeros((0, 3)))
    monkeypatch.setattr(volumes, "VOXELS_AT_ONCE", 1)
    assert np.array_equal(isosurface.enclosed_cells(volume, 1e-3, np.zeros((0, 3))), whole)
