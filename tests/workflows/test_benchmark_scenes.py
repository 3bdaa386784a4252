"""benchmarks/scenes: closed forms of the shapes, the same files each time, and what the poses stage makes of each kind."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.scenes.__main__ import write_scene
from benchmarks.scenes.catalogue import recipes
from pipeline.stage import Job
from stages.io import scene
from stages.poses.run import run
from stages.poses.settings import PosesSettings

COUNTS = {"train": 6, "val": 2, "test": 3}


def scene_of(source: Path, settings: PosesSettings) -> scene.Scene:
    job = Job(settings=settings, source=source, out=source / "poses", work=source / "work")
    run(job)
    return scene.load(job.out)


@pytest.mark.parametrize(("kind", "space"), [("object", "box"), ("court", "contracted")])
def test_a_scene_is_a_source(kind: str, space: str, tmp_path: Path) -> None:
    recipe = recipes()[kind]
    for name in ("one", "two"):
        write_scene(recipe, tmp_path / name, COUNTS, 32, supersample=1)
    one, two = ([(path.name, path.read_bytes()) for path in sorted((tmp_path / name).rglob("*")) if path.is_file()] for name in ("one", "two"))
    assert one == two
    made = scene_of(tmp_path / "one", PosesSettings())
    assert {split: len(scene.views_of(made, split)) for split in COUNTS} == COUNTS
    assert (made.background is not None) == recipe.alpha
    assert made.space == space
    centres = np.array([view.camera.centre for view in made.views])
    apart = np.linalg.norm(centres[:, None] - centres[None], axis=-1)
    assert apart[~np.eye(len(centres), dtype=bool)].min() > 0.005  # no view of one split is a view of another
