"""Scenes that seeds draw."""

from pathlib import Path

import numpy as np

from benchmarks.scenes.__main__ import write_drawn
from benchmarks.scenes.catalogue import cameras
from benchmarks.scenes.drawn import MIDDLE, drawn
from benchmarks.scenes.rendering import image
from benchmarks.scenes.shapes import Sphere


def test_a_seed_draws_the_same_scene_again_and_another_seed_another() -> None:
    assert (drawn(3).shapes, drawn(3).sun) == (drawn(3).shapes, drawn(3).sun)
    assert drawn(3).shapes != drawn(4).shapes
    assert drawn(3).sun != drawn(4).sun


def test_scenes_lie_in_their_box_and_all_cameras_look_at_it() -> None:
    for seed in range(150):
        recipe = drawn(seed)
        assert 4 <= len(recipe.shapes) <= 13
        assert abs(np.linalg.norm(recipe.sun) - 1) < 1e-9
        for shape in recipe.shapes:
            centre, _ = shape.ball
            reach = shape.radius if isinstance(shape, Sphere) else 0.0
            assert (np.abs(centre - MIDDLE) + reach <= 1.05).all()
        for camera in cameras(recipe, "train", 5, 16):
            offset = np.array(MIDDLE) - camera.centre
            assert 2.7 <= np.linalg.norm(offset) <= 3.6
            assert offset @ camera.forward / np.linalg.norm(offset) > 0.9999


def test_the_light_of_a_scene_falls_on_it() -> None:
    recipe = drawn(0)
    camera = cameras(recipe, "train", 5, 16)[1]
    assert (image(recipe.shapes, camera, alpha=True, light=recipe.sun) != image(recipe.shapes, camera, alpha=True)).any()


def test_a_drawn_scene_is_written_once(tmp_path: Path) -> None:
    counts = {"train": 2, "val": 0, "test": 0}
    write_drawn(tmp_path / "a", 5, counts, 8)
    before = (tmp_path / "a" / "transforms.json").stat().st_mtime_ns
    write_drawn(tmp_path / "a", 5, counts, 8)
    assert (tmp_path / "a" / "transforms.json").stat().st_mtime_ns == before
