"""What stages take, foretold: fleets admit them by it. It is what the stage itself says once it begins."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from efficientnerf.asset.format import load, outline
from pipeline.errors import TooLittleMemory
from pipeline.executors.memory import Limit
from stages.artifacts import MeshOutputs
from stages.bake import run as bake
from stages.bake.run import BakeSettings
from stages.evaluate import run as evaluate
from stages.memory.plan import memory_needed
from stages.memory.rendering import tree_bytes
from stages.mesh import run as mesh
from stages.mesh.memory import surface_needed
from stages.points import run as points
from stages.poses.memory import features_needed
from stages.splats import run as splats
from stages.train import run as train
from stages.turntable import run as turntable
from tests.efficientnerf.balls import settings
from tests.stages.balls import job, poses
from workflows.asset import NAMES, STAGES, WORKFLOW

GOLDEN = Path(__file__).parents[2] / "data" / "golden"
GIB = 2**30
DEFAULTS: dict[str, Any] = {stage.name: stage.settings() for stage in STAGES}
QUICK = {"iterations": 4, "sample_batch_size": 1024, "occupancy_warmup_steps": 2, "preview_every": "off"}
OWN: dict[str, Any] = {
    **DEFAULTS,
    "train": settings(**QUICK),
    "bake": BakeSettings(resolution=16, samples_per_voxel=1, refine_steps=1, weight_threshold=0.0, max_mib=1.0),
    "splats": replace(DEFAULTS["splats"], make="on"),
}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, int]]:
    """A run of a ball with its first artifacts, and what its stages said that they took."""
    folder = tmp_path_factory.mktemp("plan")
    place, said = folder / "run", {}
    place.mkdir()
    shutil.copytree(poses(folder / "poses"), place / "poses")
    for module in (train, bake):
        stage = module.STAGE
        made = job(folder / stage.name, OWN[stage.name], **{need: place / need for need in stage.needs})
        module.run(made)
        shutil.copytree(made.out, place / stage.name)
        said[stage.name] = made.facts["memory"]["needed"]
    for name in ("mesh", "splats"):
        (place / name).mkdir()
    MeshOutputs(place / "mesh").report.write_text("{}", encoding="utf-8")
    return place, said


@pytest.mark.parametrize("module", [mesh, splats, evaluate, turntable, points])
def test_it_is_what_the_stage_says_that_it_needs(run: tuple[Path, dict[str, int]], module: Any, tmp_path: Path) -> None:
    place, stage = run[0], module.STAGE
    short = job(tmp_path, OWN[stage.name], **{need: place / need for need in stage.needs})
    short.stage, short.memory = stage.name, Limit(1, "--memory")
    with pytest.raises(TooLittleMemory) as caught:
        module.run(short)
    assert memory_needed(stage.name, place, (), OWN) == caught.value.needed


def test_training_and_baking_take_no_more_than_was_foretold(run: tuple[Path, dict[str, int]]) -> None:
    place, said = run
    assert memory_needed("train", place, (), OWN) == said["train"]
    at_most = memory_needed("bake", place, (), OWN)
    assert at_most is not None
    assert said["bake"] <= at_most < said["bake"] + GIB
    larger = {**OWN, "bake": replace(OWN["bake"], resolution=512, max_mib=64.0)}
    assert (memory_needed("bake", place, (), larger) or 0) > at_most + GIB


@pytest.mark.parametrize("device", ["cpu", "cuda"])
def test_without_what_it_reads_nothing_is_foretold_but_of_the_first_stage(tmp_path: Path, device: str) -> None:
    found = {name: memory_needed(name, tmp_path / "run", (tmp_path,), DEFAULTS, device) for name in NAMES}
    assert [name for name, needed in found.items() if needed is not None] == ["poses"]
    assert WORKFLOW.memory is memory_needed


def test_photographs_are_foretold_by_their_headers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    for number in range(3):
        Image.fromarray(np.zeros((30, 40 + number, 3), np.uint8)).save(tmp_path / f"{number}.png")
    (tmp_path / "broken.jpg").write_bytes(b"no picture")
    (tmp_path / "notes.txt").write_bytes(b"words")
    own = DEFAULTS["poses"]
    expected = features_needed([(42, 30)] * 4, own.feature_image_size, 4096, 2).total
    assert memory_needed("poses", tmp_path / "run", (tmp_path,), DEFAULTS) == expected
    Image.fromarray(np.zeros((3000, 4000, 3), np.uint8)).save(tmp_path / "large.png")
    larger = memory_needed("poses", tmp_path / "run", (tmp_path,), DEFAULTS)
    assert larger is not None
    assert larger > expected + GIB // 2


@pytest.mark.parametrize("path", sorted(GOLDEN.glob("*.nerftree")), ids=lambda path: path.stem)
def test_the_outline_of_an_asset_takes_what_the_asset_does(path: Path) -> None:
    whole, claimed = load(path), outline(path)
    assert tree_bytes(claimed) == tree_bytes(whole)
    assert surface_needed(claimed, 1000, 512, 10**6, dense=True) == surface_needed(whole, 1000, 512, 10**6, dense=True)
    assert (claimed.resolution, claimed.degree, len(claimed.outer)) == (whole.resolution, whole.degree, len(whole.outer))
    assert claimed.harmonics_count == whole.harmonics_count
