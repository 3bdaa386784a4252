"""benchmarks/scenes: closed forms of the shapes, the same files each time, and what the poses stage makes of each kind."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.scenes.__main__ import write_scene
from benchmarks.scenes.catalogue import cameras, recipes
from benchmarks.scenes.rendering import image, nearest
from benchmarks.scenes.shapes import Box, Capsule, Ground, Material, Shape, Sphere
from efficientnerf.geometry.cameras import rays
from pipeline.stage import Job
from stages.io import scene
from stages.poses.run import PosesSettings, run

GREY = Material(((0.5, 0.5, 0.5), (0.5, 0.5, 0.5)))
COUNTS = {"train": 6, "val": 2, "test": 3}


def distance_to(shape: Shape, points: np.ndarray) -> np.ndarray:
    """(R,) distance of points from the surface."""
    if isinstance(shape, Sphere):
        return np.linalg.norm(points - shape.centre, axis=1) - shape.radius
    if isinstance(shape, Box):
        beyond = np.abs((points - np.array(shape.centre)) @ shape.rotation) - shape.half
        return np.linalg.norm(np.maximum(beyond, 0), axis=1) + np.minimum(beyond.max(1), 0)
    if isinstance(shape, Capsule):
        a, axis = np.array(shape.a), np.array(shape.b) - shape.a
        nearest_point = a + np.clip((points - a) @ axis / (axis @ axis), 0, 1)[:, None] * axis
        return np.linalg.norm(points - nearest_point, axis=1) - shape.radius
    assert isinstance(shape, Ground)
    return points[:, 2] - shape.height


@pytest.mark.parametrize(
    "shape",
    [
        Sphere((0.2, -0.1, 0.3), 0.5, GREY), Box((0.1, 0.2, -0.1), (0.3, 0.5, 0.2), GREY, heading=33.0), Capsule((-0.4, 0, 0), (0.3, 0.2, 0.4), 0.2, GREY),
        Ground(-0.3, GREY),
    ],
    ids=["sphere", "box", "capsule", "ground"],
)  # fmt: skip
def test_a_ray_is_outside_until_it_hits(shape: Shape) -> None:
    rng = np.random.default_rng(0)
    origins = np.array([0.0, 0.0, 1.0]) + rng.normal(size=(400, 3)) * [2, 2, 0.2]
    origins = origins[distance_to(shape, origins) > 0.01]
    directions = rng.normal(size=origins.shape)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    t = shape.hit(origins, directions)
    hit = np.isfinite(t) & (t < 50)
    assert hit.any()
    points = origins[hit] + t[hit, None] * directions[hit]
    np.testing.assert_allclose(distance_to(shape, points), 0, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(shape.normal(points), axis=1), 1, atol=1e-6)
    for share in (0.1, 0.5, 0.9, 0.99):
        assert (distance_to(shape, origins[hit] + share * t[hit, None] * directions[hit]) > -1e-9).all()
    for along in np.linspace(0, 6, 40):  # a ray that misses stays outside
        assert (distance_to(shape, origins[~hit] + along * directions[~hit]) > -1e-9).all()


@pytest.mark.parametrize("kind", recipes())
def test_culling_changes_no_hit(kind: str) -> None:
    recipe = recipes()[kind]
    origins, directions = rays(cameras(recipe, "train", 4, 48)[1])
    found = nearest(recipe.shapes, origins, directions)
    every = np.stack([shape.hit(origins, directions) for shape in recipe.shapes])
    np.testing.assert_array_equal(found.distance, every.min(0))
    np.testing.assert_array_equal(found.shape >= 0, np.isfinite(every.min(0)))


def test_wires_are_thinner_than_a_pixel() -> None:
    recipe = recipes()["gloss"]
    drawn = image(recipe.shapes, cameras(recipe, "test", 3, 64)[0], alpha=True)
    partly = (drawn[..., 3] > 0) & (drawn[..., 3] < 255)
    assert partly.sum() > 0.2 * (drawn[..., 3] > 0).sum()


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
