"""What all tests of baking share: a ball that a network has seen a little of."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from stages.train import run as train
from tests.efficientnerf.balls import settings
from tests.stages.balls import job, poses


@pytest.fixture(scope="module", autouse=True)
def no_curve() -> Iterator[None]:
    """Drawing the curve takes longer than such a little training."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("stages.train.log.curve", lambda path, *_, **__: path.write_bytes(b""))
        yield


@pytest.fixture(scope="session")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("bake")
    scene = poses(folder / "poses")
    train.run(job(folder / "train", settings(iterations=30, sample_batch_size=4096, occupancy_warmup_steps=10), poses=scene))
    return {"poses": scene, "train": folder / "train" / "out"}
