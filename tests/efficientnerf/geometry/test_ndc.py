"""Normalised device coordinates: the appendix's closed form, inverses, straight rays, distances and normals; numpy and torch alike."""

import numpy as np
import pytest
import torch

from efficientnerf.geometry.ndc import BEYOND, Ndc, ndc_distance, world_distance


def some_pose(rng: np.random.Generator) -> np.ndarray:
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    pose = np.eye(4)
    pose[:3, :3] = q * np.sign(np.linalg.det(q))
    pose[:3, 3] = rng.normal(size=3)
    return pose


@pytest.fixture
def ndc() -> Ndc:
    return Ndc(some_pose(np.random.default_rng(3)), 400.0, 504.0, 378.0, 1.5)


def before(ndc: Ndc, rng: np.random.Generator, count: int, low: float = 1.5, high: float = 100.0) -> np.ndarray:
    """World points before the reference camera, at depths between low and high."""
    z = np.exp(rng.uniform(np.log(low), np.log(high), count))
    local = np.stack([rng.uniform(-1, 1, count) * z, rng.uniform(-1, 1, count) * z, z], -1)
    return local @ ndc.world_from_camera[:3, :3].T + ndc.world_from_camera[:3, 3]


def appendix(ndc: Ndc, points: np.ndarray) -> np.ndarray:
    """Equation 21 of the NeRF paper, in its own axes (y up, looking along -z), turned to ours at the end."""
    opengl = (points - ndc.world_from_camera[:3, 3]) @ ndc.world_from_camera[:3, :3] * [1, -1, -1]
    ox, oy, oz = opengl.T
    x = -ndc.focal / (ndc.width / 2) * ox / oz
    y = -ndc.focal / (ndc.height / 2) * oy / oz
    z = 1 + 2 * ndc.near / oz
    return np.stack([x, -y, z], -1)


def test_points_are_the_appendix_s_and_come_back(ndc: Ndc) -> None:
    points = before(ndc, np.random.default_rng(0), 500)
    warped = ndc.points(points)
    np.testing.assert_allclose(warped, appendix(ndc, points), rtol=1e-12, atol=1e-12)
    assert (warped[:, 2] >= -1 - 1e-9).all()
    assert (warped[:, 2] < 1).all()
    np.testing.assert_allclose(ndc.world(warped), points, rtol=1e-9)
    torch.testing.assert_close(ndc.points(torch.from_numpy(points)), torch.from_numpy(warped))
    torch.testing.assert_close(ndc.world(torch.from_numpy(warped)), torch.from_numpy(points))


def rays_of(ndc: Ndc, rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Rays from round the reference camera, and from beyond its near plane, forwards."""
    places = rng.normal(size=(count, 3)) * 0.5
    places[count // 2 :, 2] += 4.0
    local = np.stack([rng.uniform(-0.8, 0.8, count), rng.uniform(-0.8, 0.8, count), np.ones(count)], -1)
    local /= np.linalg.norm(local, axis=1, keepdims=True)
    rotation, centre = ndc.world_from_camera[:3, :3], ndc.world_from_camera[:3, 3]
    return places @ rotation.T + centre, local @ rotation.T


def test_rays_are_straight_and_distances_invert(ndc: Ndc) -> None:
    rng = np.random.default_rng(1)
    origins, directions = rays_of(ndc, rng, 200)
    start, along, begin, ds_dt, dlogz_dt = ndc.rays(origins, directions)
    np.testing.assert_allclose(np.linalg.norm(along, axis=1), 1)
    t = begin + 10.0 ** rng.uniform(-2, 3, len(begin))
    s = ndc_distance(t, begin, ds_dt, dlogz_dt)
    np.testing.assert_allclose(start + s[:, None] * along, ndc.points(origins + t[:, None] * directions), atol=1e-9)
    np.testing.assert_allclose(world_distance(s, begin, ds_dt, dlogz_dt), t, rtol=1e-6)
    assert (ndc_distance(begin - 1.0, begin, ds_dt, dlogz_dt) == 0).all()


def test_rays_are_the_appendix_s_and_end_at_infinity(ndc: Ndc) -> None:
    """o' and o' + d' of equations 25 and 26: from the near plane to the far one."""
    origins, directions = (a[:100] for a in rays_of(ndc, np.random.default_rng(2), 200))
    start, along, begin, ds_dt, dlogz_dt = ndc.rays(origins, directions)
    np.testing.assert_allclose(start[:, 2], -1, atol=1e-12)
    moved = origins + begin[:, None] * directions
    np.testing.assert_allclose(start, appendix(ndc, moved), atol=1e-12)
    local_o = (moved - ndc.world_from_camera[:3, 3]) @ ndc.world_from_camera[:3, :3] * [1, -1, -1]
    local_d = directions @ ndc.world_from_camera[:3, :3] * [1, -1, -1]
    slopes = local_d[:, :2] / local_d[:, 2:] - local_o[:, :2] / local_o[:, 2:]
    d = np.stack([-ndc.slopes[0] * slopes[:, 0], ndc.slopes[1] * slopes[:, 1], -2 * ndc.near / local_o[:, 2]], -1)
    far = ndc_distance(begin + 1e15, begin, ds_dt, dlogz_dt)
    np.testing.assert_allclose(far[:, None] * along, d, atol=1e-6)
    assert (world_distance(far * 1.001, begin, ds_dt, dlogz_dt) == np.inf).all()


def test_normals_are_those_of_the_warped_surface(ndc: Ndc) -> None:
    """Of a plane of the world: its image's normal comes back as the plane's own."""
    rng = np.random.default_rng(4)
    points = before(ndc, rng, 50, 2.0, 20.0)
    normal = rng.normal(size=(50, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    # Two directions in each plane, pushed through the map: their cross product is normal to its image; the map keeps the handedness.
    first = np.cross(normal, np.roll(normal, 1, axis=1))
    second = np.cross(normal, first)
    step = 1e-6
    u, v = ((ndc.points(points + step * each) - ndc.points(points - step * each)) / (2 * step) for each in (first, second))
    image = np.cross(u, v)
    np.testing.assert_allclose(ndc.world_normals(ndc.points(points), image), normal, atol=1e-5)
    assert (ndc.world_normals(ndc.points(points), np.zeros_like(image)) == 0).all()


def test_the_kernels_are_the_functions(ndc: Ndc) -> None:
    """Rays that begin before and beyond the near plane, that never come to it, that look back, or along it; hits near, at infinity, and none."""
    from efficientnerf.backends.numba import rays as kernels

    rng = np.random.default_rng(5)
    origins = ndc.world_from_camera[:3, 3] + rng.normal(size=(10_000, 3)) * 3
    directions = rng.normal(size=(10_000, 3))
    directions[:100] = ndc.world_from_camera[:3, 0]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    expected, found = ndc.rays(origins, directions), kernels.warp_rays(ndc, origins, directions)
    nowhere = expected.origins[:, 2] == BEYOND
    assert 0.1 < nowhere.mean() < 0.9
    for one, other in zip(expected, found, strict=True):
        np.testing.assert_allclose(other, one, rtol=1e-9, atol=1e-11)
    along = rng.uniform(0, 2, 10_000).astype(np.float32)
    along[::7] = np.inf
    normal = rng.normal(size=(10_000, 3)).astype(np.float32)
    normal[::5] = 0
    distance, turned = kernels.unwarp_hits(ndc, found, along, normal)
    hit = np.isfinite(along)
    assert np.isinf(distance[~hit]).all()
    assert (turned[~hit] == 0).all()
    s = along[hit].astype(np.float64)
    far = world_distance(s, *(part[hit] for part in expected[2:]))
    assert 0 < np.isinf(far).mean() < 1
    np.testing.assert_allclose(distance[hit], far.astype(np.float32), rtol=1e-5)
    at = (expected.origins + np.where(hit, along, 0)[:, None].astype(np.float64) * expected.directions)[hit]
    np.testing.assert_allclose(turned[hit], ndc.world_normals(at, normal[hit].astype(np.float64)), atol=1e-5)
