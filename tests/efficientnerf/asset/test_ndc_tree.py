"""Trees in normalised device coordinates: planes of the world at their depth, lookups by world points, harmonics along world directions."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from efficientnerf.asset.cascades import voxel_coordinates
from efficientnerf.asset.queries import colour_at, density_at, normal_at
from efficientnerf.asset.rendering import render, render_rays
from efficientnerf.backends.numba.tree import rendering
from efficientnerf.backends.numba.tree.march import PACKED_EARLY_STOP
from efficientnerf.geometry.cameras import Camera, rays
from tests.efficientnerf.tree_reference import render_reference
from tests.efficientnerf.walls import DEPTH, NEAR, camera_at, looking_along_y, wall


@pytest.mark.parametrize("place", [(0.0, 0.0, 0.0), (0.8, -0.5, -0.4), (0.2, 2.5, 0.1)], ids=["reference", "beside and behind", "beyond the near plane"])
def test_a_wall_is_seen_at_its_depth(place: tuple[float, float, float]) -> None:
    tree = wall()
    seen = render(tree, camera_at(*place))
    expected = DEPTH - place[1]
    assert (seen.opacity > 0.99).all()
    # Half of the light is gone 1.2 voxels behind the front, where the density has risen to an integral of ln 2; z = 2 n / (1 - z').
    assert tree.ndc is not None
    behind = 2 * NEAR / (2 * NEAR / DEPTH - tree.voxel * np.sqrt(2 * np.log(2))) - DEPTH
    np.testing.assert_allclose(seen.depth, expected + behind, atol=0.5 * DEPTH**2 / (2 * NEAR) * tree.voxel)
    np.testing.assert_allclose(seen.normal, np.broadcast_to([0, -1, 0], seen.normal.shape), atol=0.05)


def test_lookups_take_points_of_the_world() -> None:
    tree = wall()
    at = np.array([[0.3, DEPTH - 1.0 + 0.5, 0.2], [0.3, DEPTH - 2.0, 0.2], [0.3, -5.0, 0.2]])  # in the wall, before it, behind the camera
    density = density_at(tree, at)
    assert density[0] > 0
    assert density[1] == 0
    assert density[2] == 0
    np.testing.assert_allclose(normal_at(tree, at[:1])[0], [0, -1, 0], atol=0.05)
    towards = np.array([[0.6, 0.8, 0.0]])
    seen = render_rays(tree, at[:1] - 4 * towards, towards)
    np.testing.assert_allclose(seen.colour[0] / seen.opacity[0], colour_at(tree, at[:1], towards)[0], atol=1e-3)
    assert not np.allclose(colour_at(tree, at[:1], towards), colour_at(tree, at[:1], -towards), atol=1e-2)


def test_the_kernel_is_the_reference() -> None:
    tree = wall(0.4, voxels=48)
    rng = np.random.default_rng(1)
    origins = rng.uniform(-1, 1, (64, 3)) + np.array([0.3, -1.0, 0.2])
    directions = rng.normal(size=(64, 3)) * 0.3 + [0, 1, 0]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    seen = render_rays(tree, origins, directions)
    colour, opacity = render_reference(tree, torch.from_numpy(origins), torch.from_numpy(directions))
    np.testing.assert_allclose(seen.opacity, opacity.numpy(), atol=1e-3)
    np.testing.assert_allclose(seen.colour, colour.numpy(), atol=1e-3)


PLACES = {"reference": (0.0, 0.0, 0.0), "beside and behind": (0.8, -0.5, -0.4), "beyond the near plane": (0.2, 2.5, 0.1), "close": (0.1, 5.5, 0.0)}


@pytest.mark.parametrize("place", PLACES)
def test_a_picture_whose_voxels_are_painted_once_is_the_reference(place: str) -> None:
    """Close before the wall, where a voxel's direction is not its samples', voxels are not painted."""
    tree = wall(0.4, voxels=144, degree=2)
    # Voxels that have nothing in common with their neighbours.
    tree = replace(tree, harmonics=np.random.default_rng(3).normal(0, 0.1, tree.sh.shape).astype(np.float32))
    camera = camera_at(*PLACES[place])
    direction = rendering._view_direction(tree, camera.centre)
    away = np.linalg.norm(voxel_coordinates(tree) @ direction[:, :3].T + direction[:, 3], axis=1) / np.linalg.norm(direction[:, :3], 2)
    assert (away > rendering._min_distance(tree)).mean() == pytest.approx(0 if place == "close" else 1, abs=0.1)
    y, x = np.mgrid[: camera.height, : camera.width]
    origins, directions = rays(camera, np.stack([x.ravel(), y.ravel()], -1) + 0.5)
    colour, opacity = render_reference(tree, torch.from_numpy(origins), torch.from_numpy(directions))
    seen = render(tree, camera)
    np.testing.assert_allclose(seen.colour.reshape(-1, 3), colour.numpy(), atol=2e-3)
    np.testing.assert_allclose(seen.opacity.reshape(-1), opacity.numpy(), atol=1e-3)
    # Rays of which nothing is known are summed sample by sample.
    alone = render_rays(tree, origins, directions)
    np.testing.assert_allclose(seen.colour.reshape(-1, 3), alone.colour, atol=2e-3)
    # A ray ends where less light than PACKED_EARLY_STOP is left: one that hardly has more goes on in one of the two alone.
    opaque = np.float32(1 - PACKED_EARLY_STOP)
    np.testing.assert_allclose(np.minimum(seen.opacity.reshape(-1), opaque), np.minimum(alone.opacity, opaque), atol=1e-5)
    assert (np.abs(seen.opacity.reshape(-1) - alone.opacity) > 1e-5).mean() < 2e-3
    np.testing.assert_allclose(seen.normal.reshape(-1, 3), np.where(alone.opacity[:, None] >= 0.5, alone.normal, 0), atol=1e-4)
    # Close by, colours are those of each ray, but for rounding.
    assert (np.abs(seen.colour.reshape(-1, 3) - alone.colour).max() > 1e-5) == (place != "close")


LENSES = {"PINHOLE": (60.0, 55.0, 20.0, 14.0), "SIMPLE_RADIAL": (60.0, 20.0, 15.0, -0.05), "OPENCV_FISHEYE": (60.0, 55.0, 20.0, 15.0, 0.02, 0.0, 0.001, 0.0)}


@pytest.mark.parametrize(("model", "place"), [("PINHOLE", (0.0, 20.0, 0.0)), *zip(LENSES, list(PLACES.values())[1:], strict=True)])
def test_rays_that_are_warped_in_the_kernel_are_those_that_are_given(model: str, place: tuple[float, float, float]) -> None:
    """Rays of a camera that stands anywhere and looks aside, too, some of which never come to the near plane. Seen from the very reference camera rays run
    along the faces of voxels, of which rounding says whose they are."""
    surroundings = np.random.default_rng(2).random((8, 16, 3)).astype(np.float32)
    tree = replace(wall(0.4, voxels=48, degree=2, hard=0.02), environment=surroundings)
    turned = looking_along_y()
    turned[:3, :3] = turned[:3, :3] @ np.array([[0.6, 0.0, 0.8], [0.0, 1.0, 0.0], [-0.8, 0.0, 0.6]])
    for pose in (looking_along_y(), turned):
        pose[:3, 3] += np.array([0.0137, -0.0071, 0.0093]) + place
        camera = Camera("a", 40, 30, model, LENSES[model], pose)
        seen, (origins, directions) = render(tree, camera), rays(camera)
        given = render_rays(tree, origins, directions, eye=camera.centre, columns=camera.width)
        np.testing.assert_allclose(seen.opacity.reshape(-1), given.opacity, atol=1e-3)
        assert (np.abs(seen.opacity.reshape(-1) - given.opacity) > 1e-5).mean() < 2e-3  # rays that end a sample sooner or later
        np.testing.assert_allclose(seen.colour.reshape(-1, 3), given.colour, atol=1e-3)
        depth = given.depth * (directions @ camera.forward)
        hit = np.isfinite(depth)
        assert np.array_equal(np.isfinite(seen.depth.reshape(-1)), hit)
        np.testing.assert_allclose(seen.depth.reshape(-1)[hit], depth[hit], rtol=1e-4)
        np.testing.assert_allclose(seen.normal.reshape(-1, 3), given.normal, atol=2e-3)
        assert hit.mean() > 0.3 or pose is turned or place == (0.0, 20.0, 0.0)


def test_frame_rays_are_where_the_grid_is() -> None:
    tree = wall()
    origins, directions = np.array([[0.3, -1.0, 0.2]]), np.array([[0.1, 1.0, -0.05]]) / np.linalg.norm([0.1, 1.0, -0.05])
    seen = render_rays(tree, origins, directions)
    warped = tree.frame.rays(origins, directions)
    point = tree.ndc.points(origins + seen.depth[:, None].astype(np.float64) * directions)
    along = point - warped.origins
    np.testing.assert_allclose(np.cross(along, warped.directions), 0, atol=1e-6)
