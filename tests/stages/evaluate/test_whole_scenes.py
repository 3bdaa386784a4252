"""Assets that hold a whole scene: rendered by themselves, and over what the network shows around cascade 0."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from efficientnerf.asset.camera_paths import pose_on_sphere
from efficientnerf.asset.cascades import cascade_tree, cascades_of, subset, voxel_cascades
from efficientnerf.asset.rendering import Rendering
from efficientnerf.asset.tree import NerfTree
from efficientnerf.evaluation.surfaces import opacity_nearer
from efficientnerf.geometry.cameras import Camera, Similarity, rays
from efficientnerf.geometry.orbit import Orbit
from efficientnerf.geometry.spaces import Box
from efficientnerf.rendering.field_renderer import FieldRendering, SampleCounts
from stages.evaluate.asset import EvaluatedAsset, evaluated
from stages.evaluate.run import evaluate
from stages.figures.plots import to_uint8
from stages.io.png import write_png
from stages.io.scene import Scene, View, save
from tests.efficientnerf.tree_reference import render_reference
from tests.efficientnerf.trees import random_cascades
from tests.stages.evaluate.balls import BALL_MESH, TREE, figures_of, job_in, settings


def reference_image(tree: NerfTree, camera: Camera, *, background: tuple[float, float, float] | None = None, normals: bool = False) -> Rendering:
    """The image of a tree by the reference render: over its environment, or over a background in its place."""
    seen = replace(tree, environment=None) if background is not None else tree
    colour, opacity = (part.numpy() for part in render_reference(seen, *(torch.from_numpy(a) for a in rays(camera))))
    behind = np.zeros(3) if background is None else np.asarray(background)
    size = (camera.height, camera.width)
    flat = np.zeros(size, np.float32)
    return Rendering((colour + (1 - opacity[:, None]) * behind).reshape(*size, 3).astype(np.float32), opacity.reshape(size).astype(np.float32), flat, flat)


def whole_asset(tree: NerfTree) -> EvaluatedAsset:
    """As `evaluated`, by the reference render."""
    made = evaluated(tree)
    return replace(made, render=partial(reference_image, tree), inner=partial(reference_image, cascade_tree(tree, 0)))


class ReferenceField:
    """A field that is a tree: split by its cascade 0."""

    def __init__(self, tree: NerfTree) -> None:
        self.tree = tree
        self.calls: list[str] = []
        self.boxes: list[tuple[Any, Any]] = []

    def colour(self, camera: Camera, progress: Any = None) -> np.ndarray:
        self.calls.append(camera.name)
        return reference_image(self.tree, camera).colour

    def render(self, camera: Camera, progress: Any = None, *, box: Any = None, reach: Any = None, limits: Any = None) -> FieldRendering:
        tree, size = self.tree, (camera.height, camera.width)
        bounds = [cascade.bounds(tree.brick) for cascade in cascades_of(tree)]
        self.calls.append(camera.name)
        self.boxes += [(box, bounds[0]), (reach, bounds[-1])]
        origins, directions = rays(camera)
        inner, all_of_it = reference_image(cascade_tree(tree, 0), camera), reference_image(tree, camera)
        enter = (1 - 1e-9) * Box(bounds[0]).intersect(torch.from_numpy(origins), torch.from_numpy(directions))[0].clamp(min=0)
        before = opacity_nearer(subset(tree, voxel_cascades(tree) > 0), origins, directions, enter.numpy()).reshape(size)
        assert before.max() < 1e-6, "these cameras stand in cascade 0"
        passing = np.maximum(1 - inner.opacity, 1e-6)[..., None]
        behind = ((all_of_it.colour - inner.colour) / passing).astype(np.float32)
        nearer = None if limits is None else np.zeros(size, np.float32)
        depth = np.full(size, np.inf, np.float32)
        nothing = np.zeros((*size, 4), np.float32)
        return FieldRendering(all_of_it.colour, all_of_it.opacity, depth, nothing, behind, inner.opacity, SampleCounts(), all_of_it.opacity, nearer)


def photographed(tree: NerfTree, folder: Path, count: int) -> Path:
    """A poses artifact of photographs from the middle of a tree outwards."""
    (folder / "images").mkdir(parents=True)
    middle, views = (tree.bounds_min + tree.bounds_max) / 2, []
    for k in range(count):
        pose = pose_on_sphere(tuple(middle), 0.1, 360.0 * k / count, 10.0)
        camera = Camera(f"v{k}.png", 24, 18, "SIMPLE_PINHOLE", (16.0, 12.0, 9.0), pose)
        write_png(to_uint8(reference_image(tree, camera).colour), folder / "images" / f"v{k}.png")
        views.append(View(f"images/v{k}.png", None, "test", camera, camera, 0.01, 50.0))
    save(Scene("tree", tuple(views), np.array([[-1.0] * 3, [1.0] * 3]), None, Similarity.identity(), Orbit((0.0, 0.0, 0.0), 3.0, 20.0, False, 0.0)), folder)
    return folder


def test_a_whole_scene_is_rendered_by_itself_and_over_the_network_too(tmp_path: Path) -> None:
    tree = random_cascades(5)
    poses = photographed(tree, tmp_path / "poses", 3)
    field = ReferenceField(tree)
    job = job_in(tmp_path, poses, settings(field_views=2, strips="on"))
    evaluate(whole_asset(tree), TREE, lambda: field, job, BALL_MESH)
    found = figures_of(job)
    assert found["asset"]["psnr"] > 50
    assert found["asset"]["views"] == 3
    assert found["gap"]["psnr"] == pytest.approx(0.0, abs=1e-3)
    assert found["holes"] == 0.0
    assert found["asset_with_network_background"]["views"] == 2
    assert found["asset_with_network_background"]["psnr"] > 50, "the field's surroundings are the asset's"
    assert [view["asset_with_network_background"] is None for view in found["views"]] == [view["network"] is None for view in found["views"]]
    assert len(field.calls) == 2 + 3, "what the asset shows by itself needs no field"
    assert all(np.array_equal(box, bounds) for box, bounds in field.boxes)
