"""Depths of many views fused: against planes, balls and slabs in closed form; what views see through, what none reaches, and what is thin."""

from dataclasses import replace

import numpy as np
import pytest

from efficientnerf.asset.tree import NerfTree, Region, tree_from_voxels
from efficientnerf.backends.numba.mesh.fusion import CONFIDENCE, FILLED, NEAREST, A, B, W, fit_planes, fuse
from efficientnerf.backends.numba.tree.queries import density_at, distance_back
from efficientnerf.geometry.cameras import Camera, rays
from efficientnerf.geometry.ndc import Ndc
from efficientnerf.surface import fusion as module
from efficientnerf.surface.agreement import AssetView, asset_view
from efficientnerf.surface.fusion import Fusion, front_depth, fused_opacity
from efficientnerf.surface.mesh import Mesh, face_vectors, topology
from efficientnerf.surface.nested import scene_surface
from tests.efficientnerf.threads import on_threads
from tests.efficientnerf.walls import DEPTH, NEAR, looking_along_y, wall

VOXEL, RADIUS = 0.05, 0.5
LENS = np.array([60.0, 62.0, 24.0, 18.0])


def camera(direction: tuple[float, float, float], size: tuple[int, int] = (48, 48)) -> Camera:
    """Three units from the origin, looking at it."""
    back = np.array(direction) / np.linalg.norm(direction)
    right = np.cross([0.1, 0.2, 1.0], back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2], pose[:3, 3] = right, np.cross(-back, right), -back, 3 * back
    return Camera("c", *size, "SIMPLE_PINHOLE", (1.8 * size[0], size[0] / 2, size[1] / 2), pose)


DIRECTIONS = [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1), (1, 1, 1), (-1, 1, -1), (1, -1, -1), (-1, -1, 1)]


def ball_view(view: Camera, radius: float = RADIUS) -> AssetView:
    origins, directions = rays(view)
    along = -(origins * directions).sum(1)
    left = radius**2 - ((origins**2).sum(1) - along**2)
    depth = np.where(left > 0, (along - np.sqrt(np.maximum(left, 0))) * (directions @ view.forward), np.inf).reshape(view.height, view.width)
    return AssetView(view, np.isfinite(depth).astype(np.float32), depth.astype(np.float32))


def fusion_of_views(views: list[AssetView]) -> Fusion:
    lenses = np.array([[view.camera.intrinsics[name] for name in ("fx", "fy", "cx", "cy")] for view in views])
    planes = np.empty((len(views), *views[0].depth.shape, 6), np.float32)
    for view, lens, out in zip(views, lenses, planes, strict=True):
        fit_planes(view.depth, view.opacity, lens, 0, len(view.depth), 2, 2 * VOXEL, False, out)
    return Fusion(planes, np.array([np.linalg.inv(view.camera.world_from_camera) for view in views]), lenses)


def plane_image(normal: tuple[float, float, float], away: float) -> np.ndarray:
    """Depths (36, 48) of the plane normal . x = away."""
    y, x = np.mgrid[:36, :48] + 0.5
    return (away / (normal[0] * (x - LENS[2]) / LENS[0] + normal[1] * (y - LENS[3]) / LENS[1] + normal[2])).astype(np.float32)


def fitted(depth: np.ndarray, opacity: np.ndarray | None = None, band: float = 0.1) -> np.ndarray:
    out = np.zeros((*depth.shape, 6), np.float32)
    fit_planes(depth, np.where(np.isfinite(depth), 1, 0).astype(np.float32) if opacity is None else opacity, LENS, 0, len(depth), 2, band, False, out)
    return out


def test_a_plane_is_found_exactly_and_noise_on_it_is_evened_out() -> None:
    depth = plane_image((0.3, -0.5, 1.0), 2.0)
    exact = fitted(depth)
    np.testing.assert_allclose(exact[..., W], 1 / depth, rtol=2e-6)
    np.testing.assert_allclose(exact[..., A], 0.3 / 60 / 2, rtol=2e-3)
    np.testing.assert_allclose(exact[..., B], -0.5 / 62 / 2, rtol=2e-3)
    np.testing.assert_allclose(exact[2:-2, 2:-2, CONFIDENCE], 1, atol=1e-3)
    noisy = depth + np.random.default_rng(0).normal(scale=0.01, size=depth.shape).astype(np.float32)
    found = fitted(noisy)
    assert np.abs(1 / found[3:-3, 3:-3, W] - depth[3:-3, 3:-3]).mean() < 0.4 * np.abs(noisy - depth)[3:-3, 3:-3].mean()
    assert found[..., CONFIDENCE].mean() < exact[..., CONFIDENCE].mean()


def test_planes_do_not_reach_over_a_step() -> None:
    near, far = plane_image((0, 0, 1), 1.0), plane_image((0.1, 0.2, 1), 2.0)
    depth = np.where(np.arange(48) < 20, near, far)
    found = fitted(depth)
    np.testing.assert_allclose(found[..., W], 1 / depth, rtol=1e-4)
    assert (found[..., CONFIDENCE] > 0).all()
    np.testing.assert_allclose(found[5, 18:23, NEAREST], [1, 1, 1, 1 / far[5, 21], 1 / far[5, 22]], rtol=0.02)


def grid(count: int = 32) -> tuple[np.ndarray, np.ndarray]:
    """Corner of a grid about the origin, and distances (count, count, count) of its voxels' centres from the origin."""
    first = np.full(3, -VOXEL * count / 2)
    at = first + (np.argwhere(np.ones((count,) * 3, bool)) + 0.5) * VOXEL
    return first, np.linalg.norm(at, axis=1).reshape((count,) * 3)


def fused(fusion: Fusion, wanted: int = 1, count: int = 32) -> tuple[np.ndarray, ...]:
    out = tuple(np.zeros((count,) * 3, np.float32) for _ in range(2))
    fuse(grid(count)[0], np.zeros(3, np.int64), VOXEL, 1.0, np.full((count,) * 3, wanted, np.uint8), fusion.planes, fusion.cameras, fusion.lenses, 3.0, *out)
    return out


def test_a_ball_has_its_distances_on_any_number_of_threads() -> None:
    fusion = fusion_of_views([ball_view(camera(direction)) for direction in DIRECTIONS])
    distance, weight = fused(fusion)
    away = (grid()[1] - RADIUS) / VOXEL
    near = np.abs(away) < 1
    assert (weight[near] > 0).all()
    assert np.abs(distance - away)[near].mean() < 0.2
    assert np.abs((distance - away)[near].mean()) < 0.15
    assert (distance[away > 3.5] > 2.5).all()
    assert (weight[away < -4] == 0).all()  # nothing is known of what lies deeper
    assert (fused(fusion, FILLED)[0][away < -4] == -3).all()  # but that it is behind all that views see
    with on_threads(1):
        for one, other in zip(fused(fusion), (distance, weight), strict=True):
            np.testing.assert_array_equal(one, other)


def test_views_carve_what_they_see_through_and_nothing_else() -> None:
    fusion = fusion_of_views([ball_view(camera(direction)) for direction in DIRECTIONS])
    away, opacity = (grid()[1] - RADIUS) / VOXEL, np.zeros((32,) * 3, np.float32)
    opacity[away <= 0] = 1
    opacity[1:6, 1:6, 1:6] = 1  # a floater
    first, low = grid()[0], np.zeros(3, np.int64)
    found = fused_opacity(fusion, opacity, low, first, VOXEL)
    assert (found[:7, :7, :7] < 0.5).all()
    assert (found[(away < -0.7) & (away > -5)] > 0.5).all()
    assert (found[away > 0.7] < 0.5).all()
    elsewhere = replace(fusion, cameras=fusion.cameras - 100 * np.outer([1, 1, 1, 0], [0, 0, 0, 1]))  # all of it behind the cameras
    alone = fused_opacity(elsewhere, opacity, low, first, VOXEL)
    assert ((alone > 0.5) == (opacity > 0.5))[3:-3, 3:-3, 3:-3].mean() > 0.98


def test_a_wire_of_a_voxel_stays() -> None:
    opacity = np.zeros((32,) * 3, np.float32)
    opacity[16, 16, 4:28] = 0.9
    middle = grid()[0] + 16.5 * VOXEL
    views = []
    for direction in DIRECTIONS[:4]:
        view = camera(direction)
        origins, directions = rays(view)
        across = directions[:, :2] / np.linalg.norm(directions[:, :2], axis=1, keepdims=True)  # seen from above the wire is a point
        to = middle[:2] - origins[:, :2]
        along, beside = (to * across).sum(1), np.abs(to[:, 0] * across[:, 1] - to[:, 1] * across[:, 0])
        hit = (beside < VOXEL / 2).reshape(48, 48)
        depth = np.where(hit, (along / np.linalg.norm(directions[:, :2], axis=1) * (directions @ view.forward)).reshape(48, 48), np.inf)
        views.append(AssetView(view, hit.astype(np.float32), depth.astype(np.float32)))
    found = fused_opacity(fusion_of_views(views), opacity, np.zeros(3, np.int64), grid()[0], VOXEL)
    assert (found[16, 16, 6:26] > 0.5).all()
    assert (found[:14] < 0.5).all()
    assert (found[19:] < 0.5).all()


def slab(sigma: float) -> NerfTree:
    """Uniform density at x > 0 in a box of 0.8 a side; trilinear, so that it begins within a voxel."""
    index = np.argwhere(np.ones((16,) * 3, bool))
    index = index[index[:, 0] >= 8]
    values = np.full(len(index), sigma, np.float32), np.zeros((len(index), 1, 3), np.float32)
    return tree_from_voxels((4, 4, 4), VOXEL, np.full(3, -0.4), index, *values, brick=4)


@pytest.mark.parametrize("sigma", [5.0, 40.0])
def test_the_way_back_through_a_slab_is_that_of_its_density(sigma: float) -> None:
    points, along = np.tile([0.3, 0.01, -0.02], (3, 1)), np.array([[1.0, 0, 0], [0, 1.0, 0], [-1.0, 0, 0]])
    np.testing.assert_allclose(distance_back(slab(sigma), points, along, 0.5, 10 * VOXEL)[:2], 0.5 / sigma, rtol=1e-4)
    assert distance_back(slab(sigma), points, along, 100.0, 4 * VOXEL) == pytest.approx([4 * VOXEL] * 3)


def soft_ball(noise: float = 0.0) -> NerfTree:
    """Density that rises over several voxels inside of RADIUS, each voxel times a random factor."""
    at = -1 + (np.argwhere(np.ones((40,) * 3, bool)) + 0.5) * VOXEL
    deep = (RADIUS - np.linalg.norm(at, axis=1)) / VOXEL
    index = np.argwhere(np.ones((40,) * 3, bool))[deep > -1]
    deep = deep[deep > -1]
    factor = np.exp(np.random.default_rng(0).normal(scale=noise, size=len(deep)))
    sigma = (60 * np.clip(deep / 2 + 0.5, 0, 1) * factor).astype(np.float32)
    return tree_from_voxels((10,) * 3, VOXEL, np.full(3, -1.0), index, sigma, np.zeros((len(index), 1, 3), np.float32), brick=4)


def test_fused_depths_lie_where_little_of_the_light_is_gone() -> None:
    tree, view = soft_ball(), camera((1, 0, 0))
    seen = asset_view(tree, view)
    front, hit = front_depth(tree, seen), np.isfinite(seen.depth)
    assert (np.isfinite(front) == hit).all()
    origins, directions = rays(view)
    kept = (hit & (ball_view(view, 0.8 * RADIUS).opacity > 0)).ravel()
    steps = np.linspace(0, 1, 400)
    along = (front.ravel() / (directions @ view.forward))[kept, None] * steps  # from the camera to the front
    sigma = density_at(tree, (origins[kept, None] + along[..., None] * directions[kept, None]).reshape(-1, 3)).reshape(along.shape)
    gone = 1 - np.exp(-(sigma.sum(1) * along[:, -1] / 399))
    np.testing.assert_allclose(gone, module.ABSORBED, atol=0.04)


def mesh_of(tree: NerfTree, threshold: float, views: list[AssetView], faces: int = 4000, rounds: int = 5, region: Region | None = None) -> Mesh:
    more = {"viewpoints": np.zeros((0, 3)), "progress": lambda *_: None}
    return scene_surface(tree, threshold, faces=faces, min_component=0.01, rounds=rounds, views=views, region=region, **more)


def test_a_noisy_ball_is_smooth_and_where_it_is() -> None:
    tree = soft_ball(noise=1.0)
    views = [asset_view(tree, camera(direction, (80, 80))) for direction in DIRECTIONS]

    def errors(fused: list[AssetView]) -> tuple[float, float]:
        mesh = mesh_of(tree, 25.0, fused)
        assert topology(mesh.vertices, mesh.faces).watertight
        vectors, outward = face_vectors(mesh.vertices, mesh.faces), mesh.vertices[mesh.faces].mean(1)
        cosine = (vectors * outward).sum(1) / np.linalg.norm(vectors, axis=1) / np.linalg.norm(outward, axis=1)
        return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean()), float(np.abs(np.linalg.norm(mesh.vertices, axis=1) - RADIUS).mean() / VOXEL)

    (angle, away), (angle_before, away_before) = errors(views), errors([])
    assert angle < 0.5 * angle_before
    assert angle < 6
    assert away < min(0.55, 0.6 * away_before)


def test_a_region_cuts_cleanly() -> None:
    tree = soft_ball()
    region = Region(np.array([[-0.9, -0.9, -0.9], [0.9, 0.9, 0.2]]), 0.0, 0.04)
    views = [asset_view(tree, camera(direction)) for direction in DIRECTIONS]
    for fused in (views, []):
        mesh = mesh_of(tree, 25.0, fused, rounds=0, region=region)
        lid = mesh.vertices[np.linalg.norm(mesh.vertices[:, :2], axis=1) < 0.35]
        lid = lid[lid[:, 2] > 0]
        assert topology(mesh.vertices, mesh.faces).watertight
        np.testing.assert_allclose(lid[:, 2], 0.2 - 0.02, atol=0.15 * VOXEL)


def wall_camera(x: float, z: float) -> Camera:
    """100 x 75 pixels before the walls of `tests.efficientnerf.walls`."""
    pose = looking_along_y()
    pose[:3, 3] += [x, 0, z]
    return Camera("c", 100, 75, "SIMPLE_PINHOLE", (100.0, 50.0, 37.5), pose)


WALL_CAMERAS = [wall_camera(x, z) for x in (-0.5, 0.0, 0.5) for z in (-0.3, 0.3)]


def wall_view(view: Camera, slant: float) -> AssetView:
    """Depth = DEPTH + slant x, in the axes of the reference camera."""
    ndc = Ndc(looking_along_y(), 100.0, 100.0, 100.0, NEAR)
    origins, directions = rays(view)
    start, along = ((part @ ndc.world_from_camera[:3, :3]) for part in (origins - ndc.world_from_camera[:3, 3], directions))
    distance = (DEPTH + slant * start[:, 0] - start[:, 2]) / (along[:, 2] - slant * along[:, 0])
    depth = (distance * (directions @ view.forward)).reshape(view.height, view.width)
    return AssetView(view, np.ones_like(depth, np.float32), depth.astype(np.float32))


def test_distances_in_normalised_device_coordinates_are_those_of_the_warped_plane() -> None:
    tree, slant = wall(0.3), 0.3
    views = [wall_view(view, slant) for view in WALL_CAMERAS]
    world = fusion_of_views(views)
    fusion = Fusion(world.planes, world.cameras @ tree.ndc.world_from_ndc, world.lenses, 0.5 / NEAR)  # type: ignore[union-attr]
    voxel, count, low = float(tree.voxel), 16, np.array([-0.25, -0.25, 0.0])
    at = low + (np.argwhere(np.ones((count, count, 32), bool)) + 0.5) * voxel
    distance, weight = (np.zeros((count, count, 32), np.float32) for _ in range(2))
    wanted = np.ones(distance.shape, np.uint8)
    fuse(low, np.zeros(3, np.int64), voxel, 0.5 / NEAR, wanted, fusion.planes, fusion.cameras, fusion.lenses, 3.0, distance, weight)
    # The plane through three points of the wall, in normalised device coordinates.
    x, y = np.array([-1.0, 1.0, 0.3]), np.array([0.2, -0.4, 0.7])
    corners = np.stack([x, y, DEPTH + slant * x], 1) @ looking_along_y()[:3, :3].T + looking_along_y()[:3, 3]
    a, b, c = tree.ndc.points(corners)  # type: ignore[union-attr]
    normal = np.cross(b - a, c - a)
    away = ((at - a) @ (normal / np.linalg.norm(normal)) / voxel).reshape(distance.shape)
    away *= -np.sign(normal[2])  # positive before the wall
    near = np.abs(away) < 2
    assert near.sum() > 500
    assert (weight[near] > 0).all()
    np.testing.assert_allclose(distance[near], away[near], atol=0.02)
    assert (distance[away > 3.5] == 3).all()
    assert (weight[away < -4] == 0).all()


def test_a_noisy_wall_before_a_reference_camera_is_smooth() -> None:
    tree = wall(0.3, voxels=48, hard=0.3)
    noise = np.exp(np.random.default_rng(0).normal(scale=0.8, size=len(tree.density_values))).astype(np.float32)
    tree = replace(tree, density_values=tree.density_values * noise, metadata={"spiral": {"radii": [0.5, 0.3, 0.1], "far": 40.0}})
    views = [asset_view(tree, view) for view in WALL_CAMERAS]
    forward = tree.ndc.world_from_camera[:3, 2]  # type: ignore[union-attr]

    def angle(fused: list[AssetView]) -> float:
        mesh = mesh_of(tree, 0.5 / float(tree.voxel), fused, faces=20_000)
        at = (mesh.vertices - tree.ndc.world_from_camera[:3, 3]) @ tree.ndc.world_from_camera[:3, :3]  # type: ignore[union-attr]
        vectors, middle = face_vectors(mesh.vertices, mesh.faces), at[mesh.faces].mean(1)
        front = (np.abs(middle[:, :2]) < 1.5).all(1) & (vectors @ forward < 0) & (np.abs(middle[:, 2] - DEPTH - 0.3 * middle[:, 0]) < 1)
        true = looking_along_y()[:3, :3] @ np.array([0.3, 0, -1]) / np.hypot(0.3, 1)
        cosine = vectors[front] @ true / np.linalg.norm(vectors[front], axis=1)
        assert front.sum() > 300
        return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean())

    found, before = angle(views), angle([])
    assert found < 0.5 * before
    assert found < 9.1
