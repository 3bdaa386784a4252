"""A checkpoint is restored whole or not at all, and what can't be used costs a warning and some steps."""

import hashlib
import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from efficientnerf.training import loop
from pipeline.errors import Interrupted
from stages.artifacts import TrainOutputs
from stages.io.field_file import read_tensors, write_tensors
from stages.train import run as train
from tests.efficientnerf.balls import BOUNDS, settings
from tests.stages.balls import StopAt, job, poses
from tests.stages.spoilers import SPOILERS

QUICK: dict[str, Any] = {"iterations": 9, "checkpoint_every": 4, "sample_batch_size": 512, "occupancy_warmup_steps": 4, "preview_every": 2}
Tensors, About = dict[str, torch.Tensor], dict[str, Any]


@pytest.fixture(scope="module")
def stopped(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, str]:
    """A scene, the scratch of a run that was stopped after step 6, and the digest of the field of one that was not."""
    folder = tmp_path_factory.mktemp("stopped")
    scene = poses(folder / "poses")
    whole = run(folder / "whole", scene)[0]
    with pytest.raises(Interrupted):
        train.run(job(folder / "cut", settings(**QUICK), poses=scene, stop=StopAt(6)))
    return scene, folder / "cut" / "work", whole


def run(folder: Path, scene: Path) -> tuple[str, list[str]]:
    """The digest of the field, and what was said."""
    events: list[dict[str, Any]] = []
    made = job(folder, settings(**QUICK), poses=scene, events=events)
    train.run(made)
    return hashlib.sha256((made.out / TrainOutputs.field).read_bytes()).hexdigest(), [event["text"] for event in events if event["event"] == "warning"]


def moment_of_another_shape(tensors: Tensors, about: About) -> None:
    tensors[sorted(name for name in tensors if name.startswith("adam.1."))[-1]] = torch.zeros(3)


def moment_missing(tensors: Tensors, about: About) -> None:
    del tensors[sorted(name for name in tensors if name.startswith("adam.1."))[-1]]


def moment_of_another_type(tensors: Tensors, about: About) -> None:
    name = sorted(name for name in tensors if name.startswith("adam.0."))[-1]
    tensors[name] = tensors[name].double()


def progress(*values: float) -> Callable[[Tensors, About], None]:
    def change(tensors: Tensors, about: About) -> None:
        tensors["progress"] = torch.tensor(values, dtype=torch.float64)

    return change


def seconds(value: Any) -> Callable[[Tensors, About], None]:
    def change(tensors: Tensors, about: About) -> None:
        about["seconds"] = value

    return change


CHANGES: dict[str, Callable[[Tensors, About], None]] = {
    "moment of another shape": moment_of_another_shape,
    "moment missing": moment_missing,
    "moment of another type": moment_of_another_type,
    "a tensor too many": lambda tensors, about: tensors.update(other=torch.zeros(1)),
    "progress missing": lambda tensors, about: tensors.pop("progress"),  # type: ignore[arg-type, return-value]
    "progress empty": progress(),
    "step of another file": progress(5, 100),
    "step too large": progress(1e300, 100),
    "step not a number": progress(math.nan, 100),
    "samples not a number": progress(6, math.nan),
    "samples negative": progress(6, -4),
    "seconds null": seconds(None),
    "seconds negative": seconds(-1.0),
    "seconds infinite": seconds(math.inf),
    "seconds not a number": seconds(math.nan),
    "seconds huge": seconds(10**400),
    "seconds text": seconds("1"),
    "step text": lambda tensors, about: about.update(step="6"),
    "step past the end": lambda tensors, about: about.update(step=9),
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_checkpoint_that_does_not_fit_changes_nothing(stopped: tuple[Path, Path, str], tmp_path: Path, change: str) -> None:
    scene, work, whole = stopped
    shutil.copytree(work, tmp_path / "work")
    *older, newest = sorted((tmp_path / "work").glob("checkpoint_*"))
    for path in older:
        path.unlink()  # so that half of a state would be trained on
    tensors, about = read_tensors(newest)
    about = {name: about[name] for name in ("step", "seconds")}
    CHANGES[change](tensors, about)
    write_tensors(tensors, about, newest)
    digest, said = run(tmp_path, scene)
    assert digest == whole
    assert len(said) == 1
    assert newest.name in said[0]


@pytest.mark.parametrize("how", ["cut", "zero", "link"])
def test_every_scratch_file_of_training_may_be_damaged(stopped: tuple[Path, Path, str], tmp_path: Path, how: str) -> None:
    scene, work, whole = stopped
    shutil.copytree(work, tmp_path / "work")
    for path in sorted(work.iterdir()):
        SPOILERS[how](tmp_path / "work" / path.name)
    assert run(tmp_path, scene)[0] == whole
    lines = [json.loads(line) for line in (tmp_path / "out" / "log.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines][-1] == 9
    assert not any(path.is_symlink() for path in (tmp_path / "out").rglob("*"))


def test_a_state_that_does_not_fit_leaves_the_trainer_as_it_was() -> None:
    from efficientnerf.geometry.spaces import space_from
    from efficientnerf.model import model

    def made(seed: int) -> loop.Trainer:
        return loop.trainer(model(space_from(BOUNDS), settings(seed=seed), (1.0, 1.0, 1.0), "cpu", (1.0, 5.0)))

    t, other = made(0), loop.state_of(made(1))
    before = {name: tensor.clone() for name, tensor in loop.state_of(t).items()}
    other["progress"] = torch.tensor([3.0, 50.0], dtype=torch.float64)
    last = sorted(name for name in other if name.startswith("adam.1."))[-1]
    for spoilt in (
        {**other, last: torch.zeros(2)},
        {name: tensor for name, tensor in other.items() if name != last},
        {**other, "progress": torch.zeros(2).double()},
    ):
        with pytest.raises(ValueError, match=r"adam|step 0"):
            loop.restore(t, spoilt)
        assert all(torch.equal(before[name], tensor) for name, tensor in loop.state_of(t).items())
    loop.restore(t, other)
    assert (t.step, t.samples_per_ray) == (3, 50.0)
