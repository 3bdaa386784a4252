"""Tiles of training images whose rays may meet a tree: `efficientnerf.asset.refinement.tiles`."""

import numpy as np

from efficientnerf.asset.refinement.tiles import tiles_met
from efficientnerf.asset.rendering import render_rays
from efficientnerf.asset.tree import NerfTree, tree_from_voxels
from efficientnerf.geometry.cameras import Camera
from efficientnerf.training.patches import PatchGrid
from efficientnerf.training.pixels import Pixels
from tests.efficientnerf.balls import pose

SIDE = 4


def few_bricks() -> NerfTree:
    """Three bricks in a grid of 16^3, two of them at its faces."""
    at = np.concatenate([np.argwhere(np.ones((4, 4, 4))) + corner for corner in ([0, 8, 12], [36, 36, 36], [60, 20, 8])])
    return tree_from_voxels((16, 16, 16), 0.03, np.full(3, -0.96), at, np.full(len(at), 50.0), np.ones((len(at), 1, 3), np.float32), background=(1, 1, 1))


def pixels(poses: list[np.ndarray], width: int = 241, height: int = 183) -> Pixels:
    cameras = [Camera(f"{n}.png", width, height, "PINHOLE", (280.0, 280.0, width / 2, height / 2), at) for n, at in enumerate(poses)]
    images = [np.zeros((height, width, 3), np.uint8) for _ in cameras]
    return Pixels(cameras, images, [None] * len(cameras), np.ones(len(cameras)), np.full(len(cameras), 9.0))


def test_every_patch_with_a_ray_that_meets_the_tree_is_of_a_tile_that_does() -> None:
    tree = few_bricks()
    grid = PatchGrid(pixels([pose(0.1, 0.2, 3.0), pose(1.8, 0.6, 2.5), pose(4.5, 0.1, 1.2)]), SIDE)
    met = tiles_met(tree, grid)
    assert 0.01 < met.mean() < 0.6

    rng = np.random.default_rng(0)
    hits = 0
    for _ in range(5):
        drawn = grid.drawn_from(rng.integers(len(grid), size=round(20000 / grid.mean_pixels)), rng)
        origins, directions = grid.pixels.bundle(drawn.pixels)[:2]
        hit = render_rays(tree, origins, directions).opacity > 0
        any_hit = np.logical_or.reduceat(hit, drawn.first[:-1])
        assert met[drawn.tile[any_hit]].all()
        hits += int(any_hit.sum())
    assert hits > 80
