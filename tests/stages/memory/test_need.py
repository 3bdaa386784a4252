"""Every stage says before its work what it takes: it is refused where that does not fit, and made smaller where that changes no byte."""

import hashlib
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from pipeline.errors import UsageError
from pipeline.executors.memory import Limit
from pipeline.stage import Job
from stages.artifacts import TrainOutputs
from stages.poses.run import run as run_poses
from stages.poses.settings import PosesSettings
from stages.train import run as train
from tests.efficientnerf.balls import settings
from tests.stages.balls import job, poses

GIB = 2**30
QUICK = {"iterations": 4, "sample_batch_size": 1024, "occupancy_warmup_steps": 2, "preview_every": "off"}


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return poses(tmp_path_factory.mktemp("memory") / "poses")


def limited(made: Job, size: int, events: list[dict[str, Any]] | None = None) -> Job:
    made.stage, made.memory = "toy", Limit(size, "--memory")
    if events is not None:
        made.report = events.append
    return made


def test_training_pixels_that_do_not_fit_go_to_a_file(scene: Path, tmp_path: Path) -> None:
    first = job(tmp_path / "first", settings(**QUICK), poses=scene)
    train.run(first)
    events: list[dict[str, Any]] = []
    short = limited(job(tmp_path / "short", settings(**QUICK), poses=scene), first.facts["memory"]["needed"] - 1, events)
    train.run(short)
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
def test_training_that_does_not_fit_is_refused_before_it_begins(scene: Path, tmp_path: Path, change: dict[str, Any], remedy: str) -> None:
    large = limited(job(tmp_path, settings(**{**QUICK, **change}), poses=scene), 2 * GIB)
    with pytest.raises(UsageError) as caught:
        train.run(large)
    assert remedy in str(caught.value)
    assert not list(large.out.iterdir())


def test_a_photograph_that_does_not_fit_is_refused_before_it_is_decoded(tmp_path: Path) -> None:
    source = tmp_path / "photographs"
    source.mkdir()
    for n in range(3):
        Image.new("L", (12000, 10000)).save(source / f"{n}.png")
    short = Job(settings=PosesSettings(), source=source, out=tmp_path / "out", work=tmp_path / "work", stage="poses", memory=Limit(GIB, "--memory"))
    with pytest.raises(UsageError, match="feature_image_size"):
        run_poses(short)
    assert not list(short.out.iterdir())
