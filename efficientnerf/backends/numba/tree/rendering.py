"""Rendering and querying a NerfTree on the CPU (numba, all cores): from trees and cameras to the kernels' arrays.

Pictures and rays go through `cpu_picture` and `cpu_march` over the tree's `packed` form; single points are looked up in the tree as it lies. Rays through
trees that are not interpolated have a kernel of their own, `cpu_nearest`.
The torch reference is `efficientnerf.asset.rendering.render_reference`.
"""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from efficientnerf.backends.numba.runtime import numba
from efficientnerf.backends.numba.tree.blocks import LEAST_BLOCKS, POOL_BYTES, paint
from efficientnerf.backends.numba.tree.march import LOG2E, STEP
from efficientnerf.backends.numba.tree.packed import packed_of
from efficientnerf.backends.numba.tree.picture import TILE, Shot, merge, trace
from efficientnerf.geometry.cameras import Camera, rays
from efficientnerf.rendering.harmonics import basis_numpy

if TYPE_CHECKING:
    from efficientnerf.asset.tree import NerfTree

PINHOLES = ("SIMPLE_PINHOLE", "PINHOLE")
# How far voxels are at least whose colours are summed once for a picture. The direction to a voxel is not that to the samples beside it; they differ by at
# most a voxel, and what that does to colours cancels out where neighbours have like harmonics. Where neighbours have nothing in common, and surfaces are
# opaque, colours are off by at most 0.45 slopes over the distance in voxels (random trees of degree 1 to 4): by 1e-3 at this one.
VOXELS_PER_SLOPE = 500.0
# In normalised device coordinates, where a voxel is pixels wide at any depth, half of that distance: 2e-3 at most, half a step of eight bits. Turntables of
# fern, whose voxels are 220 of them away or more, come out within 1.1e-3, on average 2e-5, in a third of the time.
VOXELS_PER_SLOPE_NDC = 250.0
SIGHTS_PER_BAND = 2**22  # directions of cameras with distortion that are kept from one picture to the next: 48 MB


@numba.njit(cache=True, inline="always", error_model="numpy")
def stored_voxel(i, j, k, brick, brick_index, voxel_index):  # type: ignore[no-untyped-def]
    """Index of the stored voxel (i, j, k), or -1."""
    if i < 0 or j < 0 or k < 0:
        return -1
    a, b, c = i // brick, j // brick, k // brick
    if a >= brick_index.shape[0] or b >= brick_index.shape[1] or c >= brick_index.shape[2]:
        return -1
    owner = brick_index[a, b, c]
    if owner < 0:
        return -1
    return voxel_index[owner, ((i - a * brick) * brick + (j - b * brick)) * brick + (k - c * brick)]


@numba.njit(cache=True, error_model="numpy")
def _corners(u, v, w, brick, brick_index, voxel_index, index, weight):  # type: ignore[no-untyped-def]
    """The eight stored voxels round a point in voxel coordinates, and their trilinear weights."""
    x, y, z = u - np.float32(0.5), v - np.float32(0.5), w - np.float32(0.5)
    i, j, k = int(np.floor(x)), int(np.floor(y)), int(np.floor(z))
    fx, fy, fz = x - np.float32(i), y - np.float32(j), z - np.float32(k)
    one = np.float32(1)
    li, lj, lk = i % brick, j % brick, k % brick
    if i >= 0 and j >= 0 and k >= 0 and li < brick - 1 and lj < brick - 1 and lk < brick - 1:
        # All eight lie in one brick, as they do for nearly half of the points: one look at the coarse level.
        a, b, c = i // brick, j // brick, k // brick
        owner = np.int32(-1)
        if a < brick_index.shape[0] and b < brick_index.shape[1] and c < brick_index.shape[2]:
            owner = brick_index[a, b, c]
        first = (li * brick + lj) * brick + lk
        for n in range(8):
            dx, dy, dz = n >> 2, (n >> 1) & 1, n & 1
            index[n] = voxel_index[owner, first + (dx * brick + dy) * brick + dz] if owner >= 0 else -1
            weight[n] = (fx if dx else one - fx) * (fy if dy else one - fy) * (fz if dz else one - fz)
        return
    for n in range(8):
        dx, dy, dz = n >> 2, (n >> 1) & 1, n & 1
        index[n] = stored_voxel(i + dx, j + dy, k + dz, brick, brick_index, voxel_index)
        weight[n] = (fx if dx else one - fx) * (fy if dy else one - fy) * (fz if dz else one - fz)


@numba.njit(cache=True, error_model="numpy")
def _density(u, v, w, brick, brick_index, voxel_index, density, index, weight):  # type: ignore[no-untyped-def]
    """Density at a point in voxel coordinates; zero in an empty coarse cell. Leaves the corners in `index` and `weight`."""
    # Compared before they become integers: what is no number, or too large for one, must not become an index.
    if not (0 <= u < brick_index.shape[0] * brick and 0 <= v < brick_index.shape[1] * brick and 0 <= w < brick_index.shape[2] * brick):
        return np.float32(0)
    if brick_index[int(u) // brick, int(v) // brick, int(w) // brick] < 0:
        return np.float32(0)
    _corners(u, v, w, brick, brick_index, voxel_index, index, weight)
    total = np.float32(0)
    for n in range(8):
        if index[n] >= 0:
            total += weight[n] * density[index[n]]
    return total


@numba.njit(cache=True, error_model="numpy")
def _gradient(u, v, w, brick, brick_index, voxel_index, density, index, weight, out):  # type: ignore[no-untyped-def]
    """Unit normal (down the gradient, central differences of one voxel) into `out`."""
    h = np.float32(1)
    gx = _density(u + h, v, w, brick, brick_index, voxel_index, density, index, weight)
    gx -= _density(u - h, v, w, brick, brick_index, voxel_index, density, index, weight)
    gy = _density(u, v + h, w, brick, brick_index, voxel_index, density, index, weight)
    gy -= _density(u, v - h, w, brick, brick_index, voxel_index, density, index, weight)
    gz = _density(u, v, w + h, brick, brick_index, voxel_index, density, index, weight)
    gz -= _density(u, v, w - h, brick, brick_index, voxel_index, density, index, weight)
    length = np.sqrt(gx * gx + gy * gy + gz * gz)
    if length > 0:
        out[0], out[1], out[2] = -gx / length, -gy / length, -gz / length
    else:
        out[0] = out[1] = out[2] = np.float32(0)


@numba.njit(cache=True, error_model="numpy")
def _colour(index, weight, sh, basis, out):  # type: ignore[no-untyped-def]
    """Sigmoid of the harmonics' sum, coefficients interpolated over the corners that are stored."""
    r = g = b = total = np.float32(0)
    for n in range(8):
        voxel = index[n]
        if voxel < 0:
            continue
        share = weight[n]
        total += share
        vr = vg = vb = np.float32(0)
        for k in range(basis.shape[0]):
            y = basis[k]
            vr += y * sh[voxel, k, 0]
            vg += y * sh[voxel, k, 1]
            vb += y * sh[voxel, k, 2]
        r += share * vr
        g += share * vg
        b += share * vb
    if total > 0:
        r, g, b = r / total, g / total, b / total
    one = np.float32(1)
    out[0] = one / (one + np.exp(-r))
    out[1] = one / (one + np.exp(-g))
    out[2] = one / (one + np.exp(-b))


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _density_at(points, brick, brick_index, voxel_index, density, out):  # type: ignore[no-untyped-def]
    blocks = (points.shape[0] + 1023) // 1024
    for block in numba.prange(blocks):
        index = np.empty(8, np.int32)
        weight = np.empty(8, np.float32)
        for n in range(block * 1024, min(points.shape[0], block * 1024 + 1024)):
            out[n] = _density(points[n, 0], points[n, 1], points[n, 2], brick, brick_index, voxel_index, density, index, weight)


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _normal_at(points, brick, brick_index, voxel_index, density, out):  # type: ignore[no-untyped-def]
    blocks = (points.shape[0] + 1023) // 1024
    for block in numba.prange(blocks):
        index = np.empty(8, np.int32)
        weight = np.empty(8, np.float32)
        for n in range(block * 1024, min(points.shape[0], block * 1024 + 1024)):
            _gradient(points[n, 0], points[n, 1], points[n, 2], brick, brick_index, voxel_index, density, index, weight, out[n])


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _colour_at(points, bases, brick, brick_index, voxel_index, sh, out):  # type: ignore[no-untyped-def]
    blocks = (points.shape[0] + 1023) // 1024
    for block in numba.prange(blocks):
        index = np.empty(8, np.int32)
        weight = np.empty(8, np.float32)
        for n in range(block * 1024, min(points.shape[0], block * 1024 + 1024)):
            _corners(points[n, 0], points[n, 1], points[n, 2], brick, brick_index, voxel_index, index, weight)
            _colour(index, weight, sh, bases[n], out[n])


def _grid_points(tree: NerfTree, points: np.ndarray) -> np.ndarray:
    """World points to voxel coordinates, float32; to the centres of their voxels, where interpolation leaves these alone, if the lookup is nearest."""
    at = np.ascontiguousarray((np.asarray(points, np.float64) - tree.bounds_min) / tree.voxel, np.float32)
    return np.floor(at) + np.float32(0.5) if tree.lookup == "nearest" else at


def _pixels(height: int, width: int, *, normals: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Room for colour, opacity, depth, normal."""
    shape = (height, width)
    normal = np.empty((*shape, 3) if normals else (0, 0, 3), np.float32)
    return np.empty((*shape, 3), np.float32), np.empty(shape, np.float32), np.empty(shape, np.float32), normal


class Paint(NamedTuple):
    """How voxels are seen: `stretch` and `nearest` as in `cpu_blocks.View`, and `painted` as `cpu_picture.trace` takes it."""

    stretch: float
    nearest: float
    painted: np.ndarray


def _paint(tree: NerfTree, toward: np.ndarray) -> Paint:
    """Colours of all voxels, each as it is seen along the direction that `toward` gives it."""
    painted = np.empty((len(tree.density_values) + 1, 4), np.float32)
    paint(packed_of(tree), tree.brick, toward, _scale(tree), tree.degree, painted)
    return Paint(float(np.linalg.norm(toward[:, :3], 2)), _nearest_painted(tree), painted)


def _nearest_painted(tree: NerfTree) -> float:
    """How far voxels are at least whose colours are summed once; see VOXELS_PER_SLOPE."""
    return (VOXELS_PER_SLOPE if tree.ndc is None else VOXELS_PER_SLOPE_NDC) * packed_of(tree).slope


def _scale(tree: NerfTree) -> np.float32:
    """What the kernels multiply densities with."""
    return np.float32(STEP * tree.voxel * LOG2E)


def _trace(
    tree: NerfTree, shot: Shot, colours: Paint, behind: np.ndarray, tile: tuple[int, int], out: tuple[np.ndarray, ...], work: np.ndarray | None = None
) -> None:
    work = np.zeros((0, 0, 4), np.int32) if work is None else work
    trace(
        shot, behind, packed_of(tree), colours.painted, tree.brick, colours.nearest, colours.stretch, _scale(tree), tree.degree, float(tree.voxel), tile,
        numba.get_num_threads(), _capacity(tree), *out, work,
    )  # fmt: skip


def _capacity(tree: NerfTree) -> int:
    """Blocks in a thread's pool."""
    return min(max(1, len(tree.voxel_index)), max(LEAST_BLOCKS, POOL_BYTES // (16 * (tree.brick + 2) ** 3)))


def scratch_bytes(tree: NerfTree) -> int:
    """What painted voxels and the threads' pools take while a picture is drawn."""
    each = 4 * len(tree.voxel_index) + (_capacity(tree) + 1) * (16 * (tree.brick + 2) ** 3 + 5)
    return 16 * (len(tree.density_values) + 1) + numba.get_num_threads() * each


def render_rays(
    tree: NerfTree,
    origins: np.ndarray,
    directions: np.ndarray,
    looking: np.ndarray | None = None,
    eye: np.ndarray | None = None,
    columns: int | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Colour (R, 3) premultiplied, opacity (R,), distance (R,), normal (R, 3) of rays; see `Rendering`.

    origins, directions  (R, 3) in the frame of the tree's bounds, unit directions
    looking              (R, 3) unit directions of the same rays in the world, where that is another frame: what the harmonics are asked for
    eye                  (3,) world: the point that all rays come from, if they do; harmonics may then be summed once for a voxel
    columns              rays in a row, if they are rows of a picture, of which neighbours look at the same voxels
    """
    if columns is not None and (columns < 1 or len(origins) % columns):
        raise ValueError(f"{len(origins)} rays in rows of {columns}: they have to fill the rows")
    rows, columns = (1, len(origins)) if columns is None else (len(origins) // columns, columns)
    shape, nothing = (rows, columns, 3), np.zeros((0, 0, 3), np.float32)
    starts = ((np.asarray(origins, np.float64) - tree.bounds_min) / tree.voxel).reshape(shape)
    alongs = np.ascontiguousarray(directions, np.float64).reshape(shape)
    looks = nothing if looking is None else np.ascontiguousarray(looking, np.float32).reshape(shape)
    toward = np.eye(3, 4) if eye is None else _sights_of_voxels(tree, eye)
    shot = Shot(np.zeros(4), 1.0, 0, np.eye(3), np.zeros(3), toward, nothing, np.ascontiguousarray(starts), alongs, looks)
    out = _pixels(rows, columns, normals=True)
    if len(origins):
        colours = _paint(tree, toward) if eye is not None and _any_far(tree, toward) else Paint(1.0, np.inf, np.zeros((1, 4), np.float32))
        _trace(tree, shot, colours, np.zeros(3, np.float32), (1, TILE * TILE) if rows == 1 else (TILE, TILE), out)
    colour, opacity, depth, normal = out
    return colour.reshape(-1, 3), opacity.reshape(-1), depth.reshape(-1), normal.reshape(-1, 3)


def _any_far(tree: NerfTree, toward: np.ndarray) -> bool:
    """Whether any voxel is far enough away for its colour to be summed once."""
    corners = np.stack(np.meshgrid(*((0, n) for n in tree.resolution), indexing="ij"), -1).reshape(-1, 3)
    farthest = np.linalg.norm(corners @ toward[:, :3].T + toward[:, 3], axis=1).max()  # the length is convex: greatest at a corner
    return bool(farthest > _nearest_painted(tree) * np.linalg.norm(toward[:, :3], 2))


def _sights_of_voxels(tree: NerfTree, eye: np.ndarray) -> np.ndarray:
    """The directions along which points are seen from one of the world, as `cpu_blocks.View` takes them."""
    if tree.ndc is None:
        return _toward((np.asarray(eye, np.float64) - tree.bounds_min) / tree.voxel)
    sights = tree.ndc.view_direction_matrix(np.asarray(eye, np.float64))
    return np.concatenate([sights[:, :3] * tree.voxel, (sights[:, :3] @ tree.bounds_min + sights[:, 3])[:, None]], axis=1)


@functools.lru_cache(maxsize=1)
def _sights(model: str, params: tuple[float, ...], width: int, height: int, supersample: int, top: int, low: int) -> np.ndarray:
    """Directions in the camera's frame of the rays through rows top to low: ((low - top) * supersample, width * supersample, 3) float32."""
    camera = Camera("", width, height, model, params, np.eye(4))
    y, x = np.mgrid[top * supersample : low * supersample, 0 : width * supersample]
    pixels = (np.stack([x.ravel(), y.ravel()], axis=-1) + 0.5) / supersample
    return rays(camera, pixels)[1].astype(np.float32).reshape(*x.shape, 3)


def _place(tree: NerfTree, camera: Camera) -> np.ndarray:
    """Where a camera stands, voxel coordinates."""
    return (np.asarray(camera.centre, np.float64) - tree.bounds_min) / tree.voxel


def _toward(centre: np.ndarray) -> np.ndarray:
    """The directions to points from one (3,), all voxel coordinates, as `cpu_blocks.View` takes them."""
    return np.concatenate([np.eye(3), -centre[:, None]], axis=1)


def _shot(tree: NerfTree, camera: Camera, supersample: int, top: int, low: int) -> Shot:
    """The rays through rows top to low of a camera's picture."""
    k, none = camera.intrinsics, np.zeros((0, 0, 3), np.float32)
    centre = _place(tree, camera)
    return Shot(
        lens=np.array([k["fx"], k["fy"], k["cx"], k["cy"]]),
        pitch=1 / supersample,
        first=top * supersample,
        turn=np.ascontiguousarray(camera.world_from_camera[:3, :3], np.float64),
        centre=centre,
        toward=_toward(centre),
        sights=none if camera.model in PINHOLES else _sights(camera.model, camera.params, camera.width, camera.height, supersample, top, low),
        starts=none.astype(np.float64),
        alongs=none.astype(np.float64),
        looking=none,
    )


def render_image(
    tree: NerfTree, camera: Camera, supersample: int, behind: np.ndarray, *, normals: bool, rays_per_band: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Colour (H, W, 3) over `behind`, opacity (H, W), depth (H, W) along the view axis, normal (H, W, 3) of a camera's pixels.

    normals        whether they are wanted; else they come back as (0, 0, 3)
    rays_per_band  of supersampled pictures, whose rays are kept until they are merged
    """
    height, width = camera.height, camera.width
    behind = np.ascontiguousarray(behind, np.float32)
    picture = _pixels(height, width, normals=normals)
    most = rays_per_band if supersample > 1 else height * width
    if camera.model not in PINHOLES:
        most = min(most, SIGHTS_PER_BAND)
    step = max(1, most // max(1, width * supersample**2))
    colours = _paint(tree, _toward(_place(tree, camera)))
    for top in range(0, height, step):
        low = min(top + step, height)
        part = tuple(whole[top:low] if len(whole) else whole for whole in picture)
        shot = _shot(tree, camera, supersample, top, low)
        if supersample == 1:
            _trace(tree, shot, colours, behind, (TILE, TILE), part)
        else:
            fine = _pixels((low - top) * supersample, width * supersample, normals=normals)
            _trace(tree, shot, colours, behind, (TILE, TILE), fine)
            merge(supersample, *fine, *part)
    return picture


def image_work(tree: NerfTree, camera: Camera) -> np.ndarray:
    """What each pixel's ray takes: cells looked at, samples tested, samples interpolated, colours looked up; (H, W, 4) int32."""
    work = np.zeros((camera.height, camera.width, 4), np.int32)
    out = _pixels(camera.height, camera.width, normals=False)
    shot = _shot(tree, camera, 1, 0, camera.height)
    _trace(tree, shot, _paint(tree, shot.toward), np.zeros(3, np.float32), (TILE, TILE), out, work)
    return work


def density_at(tree: NerfTree, points: np.ndarray) -> np.ndarray:
    out = np.empty(len(points), np.float32)
    _density_at(_grid_points(tree, points), tree.brick, tree.brick_index, tree.voxel_index, tree.density_values, out)
    return out


def normal_at(tree: NerfTree, points: np.ndarray) -> np.ndarray:
    out = np.empty((len(points), 3), np.float32)
    _normal_at(_grid_points(tree, points), tree.brick, tree.brick_index, tree.voxel_index, tree.density_values, out)
    return out


def colour_at(tree: NerfTree, points: np.ndarray, directions: np.ndarray | None) -> np.ndarray:
    if directions is None:
        bases = np.zeros((len(points), tree.harmonics_count), np.float32)
        bases[:, 0] = basis_numpy(np.array([0, 0, 1], np.float32), 0)[0]
    else:
        bases = basis_numpy(np.ascontiguousarray(directions, np.float32), tree.degree)
    out = np.empty((len(points), 3), np.float32)
    _colour_at(_grid_points(tree, points), np.ascontiguousarray(bases), tree.brick, tree.brick_index, tree.voxel_index, tree.sh, out)
    return out
