"""Where few photographs look no matter is learned: what counts as few, that it is told camera by camera, and that training keeps to it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from efficientnerf.asset import format
from efficientnerf.asset.cascades import cascades_of, voxel_cascades, voxel_coordinates
from efficientnerf.geometry.cameras import Camera, project, rays
from efficientnerf.geometry.spaces import BoundedSpace, ContractedSpace
from stages.artifacts import BakeOutputs
from stages.bake import run as bake
from stages.bake.settings import BakeSettings
from stages.framing.scene_bounds import shows
from stages.framing.view_coverage import (
    among,
    before_near,
    cells_among_cameras,
    cells_before_near,
    cells_below_min_views,
    cells_without_view,
    close_to_path,
    poorly_seen,
)
from stages.io.field_file import space_of
from stages.io.scene import Scene, views_of
from stages.io.scene import load as load_scene
from stages.io.scene import save as save_scene
from stages.train import run as train
from tests.efficientnerf import balls
from tests.poses import looking_at
from tests.stages.balls import job, poses

SPACE = ContractedSpace(np.array([[-1.0, -0.8, -1.0], [1.0, 0.9, 1.2]]))
SIDE = 24


def centres(side: int = SIDE) -> tuple[np.ndarray, np.ndarray]:
    """World coordinates (D, D, D, 3) by which voxels are judged, and which of these lie in the box.

    Voxels in the box are judged by their own centre, others by the middle of a block of 2 x 2 x 2.
    """
    own, block = (np.arange(side) + 0.5) / side, np.minimum((np.arange(side) // 2 * 2 + 1) / side, 1)
    in_box, beside = (np.stack(np.meshgrid(at, at, at, indexing="ij"), axis=-1) for at in (own, block))
    box = (np.abs(in_box * 4 - 2) <= 1).all(axis=-1)
    return SPACE.world(torch.from_numpy(np.where(box[..., None], in_box, beside)).reshape(-1, 3)).numpy().reshape(in_box.shape), box


def between(points: np.ndarray, cameras: list[Camera]) -> np.ndarray:
    """(...) bool: which points (..., 3) are in the box, or not as far from its centre as cameras are, beside a pinhole's picture, half a picture at most, at
    less than 3/4 of the depth of the box's centre, and in no picture at less than 1.1 of it."""
    low, high = SPACE.bounds
    before, shown = np.zeros(points.shape[:-1], bool), np.zeros(points.shape[:-1], bool)
    for camera in cameras:
        to = camera.world_from_camera[:3, :3].T
        x, y, depth = np.moveaxis((points - camera.centre) @ to.T, -1, 0)
        border = np.maximum(np.abs(x) / camera.width, np.abs(y) / camera.height) * 2 * camera.params[0]  # of a plane at distance one, its middle in the middle
        subject = (to @ (SPACE.centre - camera.centre))[2]
        before |= (depth > 0) & (depth < 0.75 * subject) & (border > depth) & (border <= 1.5 * depth)
        shown |= (depth > 0) & (depth < 1.1 * subject) & (border <= depth)
    return ((points >= low) & (points <= high)).all(axis=-1) | (before & ~shown & (np.linalg.norm(points - SPACE.centre, axis=-1) < reach_of(cameras)))


def reach_of(cameras: list[Camera]) -> float:
    """How far from the box's centre nine in ten cameras are at least."""
    distances = sorted(float(np.linalg.norm(camera.centre - SPACE.centre)) for camera in cameras)
    place = 0.1 * (len(distances) - 1)
    low = int(place)
    return distances[low] + (place - low) * (distances[min(low + 1, len(distances) - 1)] - distances[low])


def narrow(camera: Camera, factor: float) -> Camera:
    return replace(camera, params=(camera.params[0] * factor, *camera.params[1:]))


def aimed(at: np.ndarray, count: int) -> list[Camera]:
    """Cameras round a point that see little else."""
    out = []
    for camera in balls.cameras(count):
        moved = camera.world_from_camera.copy()
        moved[:3, 3] += at
        out.append(replace(narrow(camera, 4), world_from_camera=moved))
    return out


@pytest.mark.parametrize(("side", "min_views"), [(24, 2), (17, 3)])
def test_closed_voxels_are_those_that_few_cameras_see(side: int, min_views: int) -> None:
    cameras = [narrow(camera, 1.8) for camera in balls.cameras(12)]
    world, box = centres(side)
    inside = box | between(world, cameras)
    assert box.sum() < inside.sum() < inside.size
    views = np.zeros(int(inside.sum()), int)
    for camera in cameras:
        pixels, depth = project(camera, world[inside])
        x, y = pixels.T
        views += (depth > 0) & (x >= 0) & (x <= camera.width) & (y >= 0) & (y <= camera.height)
    expected = np.zeros_like(inside)
    expected[inside] = views < min_views
    assert 0.05 < expected[inside].mean() < 0.95
    np.testing.assert_array_equal(cells_below_min_views(SPACE, cameras, min_views, side), expected)


@pytest.mark.parametrize(("watching", "min_views", "closed"), [(1, 2, True), (2, 2, False), (2, 3, True), (3, 3, False)])
def test_a_place_is_open_where_enough_cameras_see_it(watching: int, min_views: int, closed: bool) -> None:
    """Twelve cameras look at the middle; a place beside it is seen by those alone that look there."""
    beside = np.array([0.85, 0.8, 1.05])
    cameras = [*aimed(np.zeros(3), 12), *aimed(beside, watching)]
    found = cells_below_min_views(SPACE, cameras, min_views, SIDE)
    world, inside = centres()
    (lump,) = np.argwhere(inside)[[np.argmin(np.linalg.norm(world[inside] - beside, axis=-1))]]
    (middle,) = np.argwhere(inside)[[np.argmin(np.linalg.norm(world[inside], axis=-1))]]
    left = ~(inside | between(world, cameras))
    assert found[tuple(lump)] == closed
    assert not found[tuple(middle)]
    assert not found[left].any()
    assert left.any()


def narrow_scene(folder: Path) -> Scene:
    """Photographs of a ball, of which nine are for training, whose corners of the box few of them show."""
    s = load_scene(poses(folder, count=10, photographs=True))
    s = replace(s, views=tuple(replace(view, camera=narrow(view.camera, 2.2)) for view in s.views))
    save_scene(s, folder)
    return s


@pytest.mark.parametrize("min_views", [2, 0])
def test_no_voxel_is_baked_that_few_photographs_have_in_view(tmp_path: Path, min_views: int) -> None:
    s = narrow_scene(tmp_path / "poses")
    trained = job(tmp_path / "train", balls.settings(iterations=30, min_views=min_views or "off"), poses=tmp_path / "poses")
    train.run(trained)
    made = job(
        tmp_path / "bake",
        BakeSettings(resolution=32, visibility_rays=5000, samples_per_voxel=2, refine_steps=4, refine_rays_per_batch=1024),
        poses=tmp_path / "poses",
        train=trained.out,
    )
    bake.run(made)
    tree = format.load(made.out / BakeOutputs.asset)
    at, of = voxel_coordinates(tree), voxel_cascades(tree)
    centre = np.concatenate([grid.bounds_min + (at[of == n] + 0.5) * grid.voxel for n, grid in enumerate(cascades_of(tree))])
    few = poorly_seen(centre, space_of(s).bounds, [view.camera for view in views_of(s, "train")], 2)
    assert len(few) > 1000
    assert few.any() == (min_views == 0)


def leaving_out(camera: Camera, centre: np.ndarray, radius: float) -> np.ndarray:
    """The mask (H, W) bool that leaves a ball out."""
    origins, directions = (np.asarray(part).reshape(-1, 3) for part in rays(camera))
    along = ((centre - origins) * directions).sum(1)
    return (np.linalg.norm(origins + along[:, None] * directions - centre, axis=1) > radius).reshape(camera.height, camera.width)


@pytest.mark.parametrize("space", [SPACE, BoundedSpace(SPACE.bounds)])
def test_voxels_that_no_kept_pixel_shows(space: BoundedSpace) -> None:
    """All that some kept pixel shows stays; what lies well inside of the ignored part of every picture goes."""
    side, cameras, hidden, radius = 64, balls.cameras(6), np.array([0.1, 0.0, 0.2]), 0.7
    masks = [leaving_out(camera, hidden, radius) for camera in cameras]
    found = cells_without_view(space, cameras, side, masks)
    grid = (np.stack(np.meshgrid(*(np.arange(side),) * 3, indexing="ij"), axis=-1) + 0.5) / side
    world = space.world(torch.from_numpy(grid).reshape(-1, 3)).numpy()
    seen = np.any([shows(world, camera, mask) for camera, mask in zip(cameras, masks, strict=True)], axis=0).reshape((side,) * 3)
    distance = np.linalg.norm(world - hidden, axis=1).reshape((side,) * 3)
    assert not (found & seen).any()
    assert found[distance < 0.05].all() or space.contracted
    assert not found[(distance > 1.3 * radius) & (distance < 1)].any()
    assert cells_without_view(space, cameras, side, [np.zeros((4, 4), bool) for _ in cameras]).all()
    assert not cells_without_view(space, cameras, side, [None for _ in cameras])[distance < 0.8].any()


@pytest.mark.parametrize("count", [1, 9])
def test_space_that_cameras_look_through_is_masked_and_no_other(count: int) -> None:
    cameras = balls.cameras(count)
    near = [0.3 * float(np.linalg.norm(camera.centre)) for camera in cameras]
    side = 160
    masked = cells_before_near(SPACE, cameras, near, side)
    world = SPACE.world(torch.from_numpy((np.argwhere(masked) + 0.5) / side)).numpy()
    allowed = close_to_path(world, cameras, near)
    for camera, plane in zip(cameras, near, strict=True):
        allowed |= before_near(world, camera, plane)
    assert masked.any()
    assert allowed.mean() > 0.98  # but for the curved edges of blocks in the shell
    for camera, plane in zip(cameras, near, strict=True):
        at = SPACE.grid(torch.from_numpy(camera.centre + 0.3 * plane * camera.forward)).numpy()
        assert masked[tuple((at * side).astype(int))]
        beyond = SPACE.grid(torch.from_numpy(camera.centre + 1.6 * plane * camera.forward)).numpy()
        assert not masked[tuple((beyond * side).astype(int))]


def ring(count: int, degrees: float = 360.0, height: float = 2.0) -> list[Camera]:
    """Cameras 4 away from the middle of the box, on a part of a circle, which look at it."""
    made = []
    for angle in np.radians(np.arange(count) * degrees / count):
        centre = SPACE.centre + np.array([4 * np.cos(angle), 4 * np.sin(angle), height])
        made.append(Camera("", 64, 48, "SIMPLE_PINHOLE", (60.0, 32.0, 24.0), looking_at(centre, SPACE.centre)))
    return made


def test_what_opposite_views_alone_see_lies_among_the_cameras() -> None:
    points = SPACE.centre + np.array([[3.0, 0.0, 0.5], [-2.0, 2.0, 0.5], [0.0, 0.0, 0.5], [3.0, 0.0, -3.0], [7.0, 0.0, 2.0]])
    all_round = ring(12)
    assert among(points[:2], all_round, SPACE.centre).all()  # between the cameras' places and the subject, below what those there see
    assert not among(points[2:], all_round, SPACE.centre).any()  # the subject, what is far below the cameras, or beyond them
    # Cameras on one side have the wall behind the subject in view, and stand on the other side of it.
    assert not among(SPACE.centre - np.array([[3.0, 0.0, 0.0], [2.0, 0.5, 0.5]]), ring(5, 60.0), SPACE.centre).any()


def test_voxels_among_the_cameras_are_outside_the_box_and_away_from_sparse_points() -> None:
    side, cameras = 32, ring(12)
    cells = cells_among_cameras(SPACE, cameras, side)
    inside = slice(side // 4, 3 * side // 4)
    assert cells.any()
    assert not cells[inside, inside, inside].any()
    middles = SPACE.world(torch.from_numpy((np.argwhere(cells) // 2 * 2 + 1) / side)).numpy()
    assert among(middles, cameras, SPACE.centre).all()
    point = middles[len(middles) // 2]
    near = cells & ~cells_among_cameras(SPACE, cameras, side, point[None])
    assert near[tuple(np.argwhere(cells)[len(middles) // 2])]
    assert 0 < near.sum() <= (2 * (2 * 2 + 1)) ** 3
    assert np.ptp(np.argwhere(near), axis=0).max() < 2 * (2 * 2 + 1)
