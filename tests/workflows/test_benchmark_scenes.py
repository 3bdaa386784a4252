"""benchmarks/scenes: closed forms of the shapes, the same files each time, and what the poses stage makes of each kind."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.scenes.__main__ import write_scene
from benchmarks.scenes.catalogue import cameras, recipes
from benchmarks.scenes.rendering import nearest
from efficientnerf.geometry.cameras import rays
from pipeline.stage import Job
from stages.io import scene
from stages.poses.run import run
from stages.poses.settings import PosesSettings

COUNTS = {"train": 6, "val": 2, "test": 3}


@pytest.mark.parametrize("kind", recipes())
def test_culling_changes_no_hit(kind: str) -> None:
    recipe = recipes()[kind]
    origins, directions = rays(cameras(recipe, "train", 4, 48)[1])
    found = nearest(recipe.shapes, origins, directions)
    every = np.stack([shape.hit(origins, directions) for shape in recipe.shapes])
    np.testing.assert_array_equal(found.distance, every.min(0))
    np.testing.assert_array_equal(found.shape >= 0, np.isfinite(every.min(0)))


def scene_of(source: Path, settings: PosesSettings) -> scene.Scene:
    job = Job(settings=settings, source=source, out=source / "poses", work=source / "work")
    run(job)
    return scene.load(job.out)


def test_the_forward_facing_scene_is_an_llff_data_set(tmp_path: Path) -> None:
    write_scene(recipes()["window"], tmp_path, COUNTS, 32, supersample=1)
    by_transforms, by_llff = scene_of(tmp_path, PosesSettings()), scene_of(tmp_path, PosesSettings(format="llff"))
    assert by_llff.space == "ndc"
    for view in by_llff.views:  # the same cameras, up to the similarity of each training frame
        other = next(each for each in by_transforms.views if each.name == view.name)
        one, two = (s.world_from_capture.inverse().points(v.camera.centre[None]) for s, v in ((by_llff, view), (by_transforms, other)))
        np.testing.assert_allclose(one, two, atol=1e-5)


@pytest.mark.parametrize(("kind", "space"), [("object", "box"), ("court", "contracted"), ("window", "contracted"), ("gloss", "box")])
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
