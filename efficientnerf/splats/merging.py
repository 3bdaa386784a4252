"""Voxels that show, merged into Gaussians.

Voxels lie in cells of 1, 2, 4, ... voxels a side. The loss of a cell whose voxels become one is the sum, over the pixels that show them, of the squared
differences of their colours and places from the mean. It never falls from a cell to its parent: so the cells that lose at most some bound, each the
largest of its place, are a partition, and the bound follows from the number of Gaussians allowed.

A Gaussian has the mean of its voxels, weighted by the pixels that show them, their covariance across the density's normal, and little depth along it. Its
opacity follows from the optical thickness of the voxels, which it keeps. Colours are their mean, converted: an asset's are the sigmoid of a sum of harmonics,
a Gaussian's the sum itself.

N voxels, C cells or Gaussians, K harmonics.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from efficientnerf.asset.cascades import cascades_of, voxel_cascades, voxel_coordinates, voxel_sides
from efficientnerf.asset.region import voxel_centres
from efficientnerf.asset.tree import NerfTree
from efficientnerf.backends.numba.tree import contributions, queries
from efficientnerf.backends.numba.tree.cells import cells_of as tree_cells
from efficientnerf.backends.pieces import pieces
from efficientnerf.geometry.cameras import Camera, rays
from efficientnerf.geometry.directions import across
from efficientnerf.geometry.ndc import Ndc
from efficientnerf.rendering import environment
from efficientnerf.rendering.colour import sigmoid
from efficientnerf.rendering.harmonics import C0, basis_numpy
from efficientnerf.splats.gaussians import MAX_DEGREE, Gaussians, quaternions_from

# docs/experiments/splats.md
RAYS = 2**19  # of all views together that find out which voxels show
LEAST_WEIGHT = 0.02  # of a voxel in the pixel that shows it most
PLACE = 0.05  # difference of colour that a distance of one pixel between merged voxels is worth
WIDEN = 1.8  # standard deviations of a cell's voxels across the normal, times this: neighbours have to overlap
THICKER = 3.0  # optical thickness of a Gaussian over that of its voxels: between means there is less, and light leaks
THIN = 0.3  # least depth along the normal, voxels
DIRECTIONS = 32  # that a colour is converted at
LEVELS = (*range(0, 57, 3), 62)  # of cells: bits of the keys that they leave out, of the last all
SHELL_SHARE, SHELL_MOST, SHELL_DISTANCE = 0.05, 10_000, 30.0  # Gaussians for the environment; their distance in half diagonals of the outermost cascade
DEEPEST = 3.0  # longest standard deviation over the next one, of Gaussians of normalised device coordinates: along rays voxels are far longer than across
AT_ONCE = 2**17  # voxels whose coefficients are decoded together
VIEWS = 32  # that the size of voxels in pixels is taken from


@dataclass(frozen=True, eq=False)
class Shown:
    """The voxels that show, in Morton order within their cascade."""

    voxels: np.ndarray  # (N,) their numbers
    keys: np.ndarray  # (N,) int64: cascade, then Morton code
    centres: np.ndarray  # (N, 3), the tree's frame
    sides: np.ndarray  # (N,)
    pixels: np.ndarray  # (N,) of the views, about, that show each
    width: np.ndarray  # (N,) of each in pixels


def greatest_weights(tree: NerfTree, cameras: Sequence[Camera], count: int = RAYS) -> np.ndarray:
    """(N,) the greatest contribution of each voxel to one of about `count` pixels, spread evenly over the pictures."""
    grid, found = tree_cells(tree), np.zeros((contributions.contribution_shares(), len(tree.density_values)), np.float32)
    stride = max(1.0, np.sqrt(sum(camera.width * camera.height for camera in cameras) / count))
    for number, camera in enumerate(cameras):
        # Each picture's raster begins elsewhere, so that together they meet more voxels.
        x, y = (np.arange((number * share) % 1 * stride, size, stride) for share, size in ((0.618, camera.width), (0.414, camera.height)))
        pixels = np.stack(np.meshgrid(np.floor(x) + 0.5, np.floor(y) + 0.5), axis=-1).reshape(-1, 2)
        for part in pieces(len(pixels), first=2048):
            warped = tree.frame.rays(*rays(camera, pixels[part]))
            start = np.ascontiguousarray((warped.origins - tree.bounds_min) / tree.voxel)
            along = np.ascontiguousarray(warped.directions)
            contributions.max_contributions(grid, start, along, tree.density_values, np.ones(len(start), np.float32), found)
    return np.asarray(found.max(axis=0))


def shown_voxels(tree: NerfTree, cameras: Sequence[Camera]) -> Shown:
    """The voxels that the cameras see."""
    weight = greatest_weights(tree, cameras)
    voxels = np.flatnonzero(weight > LEAST_WEIGHT)
    keys = morton_codes(voxel_coordinates(tree)[voxels].astype(np.int64)) | voxel_cascades(tree)[voxels].astype(np.int64) << 57
    voxels = voxels[np.argsort(keys, kind="stable")]
    centres, sides = voxel_centres(tree)[voxels], voxel_sides(tree)[voxels].astype(np.float64)
    width = _pixel_widths(tree, cameras, centres, sides)
    return Shown(voxels, np.sort(keys), centres, sides, np.maximum(weight[voxels] * width**2, 1e-9), width)


def morton_codes(at: np.ndarray) -> np.ndarray:
    """(N,) Morton codes of coordinates (N, 3) below 2^19."""
    code = np.zeros(len(at), np.int64)
    for bit in range(19):
        for axis in range(3):
            code |= (at[:, axis] >> bit & 1) << (3 * bit + 2 - axis)
    return code


def _pixel_widths(tree: NerfTree, cameras: Sequence[Camera], centres: np.ndarray, sides: np.ndarray) -> np.ndarray:
    """(N,) of voxels in pixels: the root mean square over views, wherever they look."""
    chosen = [cameras[int(n)] for n in np.unique(np.linspace(0, len(cameras) - 1, min(VIEWS, len(cameras))).round())]
    square, side = np.zeros(len(centres)), sides
    if tree.ndc is not None:
        side = sides * np.linalg.norm(_jacobians(tree.ndc, centres)[:, :, 0], axis=1)
    columns, area = np.ascontiguousarray(tree.frame.world(centres).T), side**2
    for camera in chosen:
        k, (x, y, z) = camera.intrinsics, columns - camera.centre[:, None]
        square += k["fx"] * k["fy"] * area / np.maximum(x * x + y * y + z * z, area)
    return np.sqrt(square / len(chosen))


def _jacobians(ndc: Ndc, points: np.ndarray) -> np.ndarray:
    """(N, 3, 3) derivative of the world by normalised device coordinates at points (N, 3) there."""
    a, b = ndc.slopes
    z = 2 * ndc.near / np.maximum(1 - points[:, 2], 1e-9)
    local = np.zeros((len(points), 3, 3))
    local[:, 0, 0], local[:, 1, 1] = z / a, z / b
    local[:, :, 2] = np.stack([points[:, 0] / a, points[:, 1] / b, np.ones(len(points))], axis=-1) * (z * z / (2 * ndc.near))[:, None]
    return np.asarray(np.einsum("ij,njk->nik", ndc.world_from_camera[:3, :3], local))


def cells_of(shown: Shown, colours: np.ndarray, most: int) -> np.ndarray:
    """(C + 1,) where the voxels of each cell begin, at most `most` cells, and one at least.

    colours  (N, 3) of the voxels, sRGB
    """
    at = shown.centres / shown.sides[:, None]
    at = at - at.mean(axis=0)
    # Sums over the voxels of a cell of w, w x and w |x|^2: of colours, and of places.
    weights = [shown.pixels, shown.pixels * np.square(PLACE * shown.width)]
    sums = [values * weight[:, None] for values, weight in zip((colours, at), weights, strict=True)]
    squares = [np.square(values).sum(axis=1) * weight for values, weight in zip((colours, at), weights, strict=True)]
    begin = np.arange(len(shown.keys))
    losses, begins, parents = [np.zeros(len(begin))], [begin], []
    for level in LEVELS[1:]:
        keys = shown.keys[begin] >> level
        first = np.flatnonzero(np.concatenate([[True], np.diff(keys) != 0]))
        parents.append(np.cumsum(np.concatenate([[0], np.diff(keys) != 0])))
        begin = begin[first]
        weights, squares = [np.add.reduceat(each, first) for each in weights], [np.add.reduceat(each, first) for each in squares]
        sums = [np.add.reduceat(each, first, axis=0) for each in sums]
        lost = sum(square - np.square(total).sum(axis=1) / weight for square, total, weight in zip(squares, sums, weights, strict=True))
        # A cell holds those in it; rounding must not let it lose less than they do.
        within = np.maximum.reduceat(losses[-1], first)
        losses.append(np.maximum(lost, within))
        begins.append(begin)

    def chosen(bound: float) -> list[np.ndarray]:
        """The cells of each level that lose at most `bound`, while their parent loses more."""
        alone = [around[parent] > bound for around, parent in zip(losses[1:], parents, strict=True)]
        return [(lost <= bound) & most_of_all for lost, most_of_all in zip(losses, [*alone, np.ones(1, bool)], strict=True)]

    low, high = 0.0, float(losses[-1].max(initial=0)) + 1e-12
    if sum(int(level.sum()) for level in chosen(low)) > most:
        for _ in range(50):
            middle = np.sqrt(max(low, 1e-18) * high)
            low, high = (low, middle) if sum(int(level.sum()) for level in chosen(middle)) <= most else (middle, high)
    else:
        high = low
    cells = chosen(high)
    begin = np.sort(np.concatenate([of_level[kept] for of_level, kept in zip(begins, cells, strict=True)]))
    return np.concatenate([begin, [len(shown.keys)]])


def merged(tree: NerfTree, cameras: Sequence[Camera], most: int, degree: int) -> Gaussians:
    """At most `most` Gaussians for the voxels that cameras see; none where they see nothing."""
    shell = environment_shell(tree, min(int(SHELL_SHARE * most), SHELL_MOST), degree)
    shown = shown_voxels(tree, cameras)
    if not len(shown.voxels):
        return shell
    parts = (shown.voxels[begin : begin + AT_ONCE] for begin in range(0, len(shown.voxels), AT_ONCE))
    base = sigmoid(C0 * np.concatenate([tree.coefficients(part)[:, 0] for part in parts]).astype(np.float64))
    begin = cells_of(shown, base, most - len(shell))
    gaussians = _gaussians_of_cells(tree, shown, begin, min(degree, tree.degree, MAX_DEGREE))
    return joined(gaussians, shell)


def _gaussians_of_cells(tree: NerfTree, shown: Shown, begin: np.ndarray, degree: int) -> Gaussians:
    first = begin[:-1]
    weight = np.add.reduceat(shown.pixels, first)
    mean = np.add.reduceat(shown.centres * shown.pixels[:, None], first, axis=0) / weight[:, None]
    side = np.maximum.reduceat(shown.sides, first)
    off = shown.centres - np.repeat(mean, np.diff(begin), axis=0)
    spread = np.empty((len(mean), 3, 3))
    for i in range(3):
        for j in range(i + 1):
            spread[:, i, j] = spread[:, j, i] = np.add.reduceat(off[:, i] * off[:, j] * shown.pixels, first) / weight
    spread += np.eye(3) * (side**2 / 12)[:, None, None]
    axes, scales = flattened(spread, np.asarray(queries.normal_at(tree, mean), np.float64), side)
    thickness = THICKER * np.add.reduceat(tree.density_values[shown.voxels] * shown.sides**3, first) / (2 * np.pi * scales[:, 0] * scales[:, 1])
    opacities = np.clip(-np.expm1(-thickness), 0.02, 0.98)
    if tree.ndc is not None:
        mean, axes, scales = _in_the_world(tree.ndc, mean, axes, scales)
    harmonics = np.empty((len(mean), (degree + 1) ** 2, 3), np.float32)
    _convert(tree, shown, begin, weight, harmonics, degree)
    parts = mean, scales, quaternions_from(axes), opacities, harmonics
    return Gaussians(*(np.ascontiguousarray(part, np.float32) for part in parts))


def flattened(spread: np.ndarray, normals: np.ndarray, side: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Axes (C, 3, 3), columns, the last along the normal, and standard deviations (C, 3) of Gaussians that cover cells of such covariances (C, 3, 3).

    normals  (C, 3) unit, or zero: then the axis that the voxels spread least along
    side     (C,) of the voxels
    """
    own = np.linalg.eigh(spread).eigenvectors  # by ascending variance
    normal = np.where((np.square(normals).sum(axis=1) > 0.5)[:, None], normals, own[:, :, 0])
    # The widest direction across the normal: the covariance within that plane, as two numbers and an angle.
    first, second = across(normal)

    def along(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.asarray(np.einsum("ni,nij,nj->n", a, spread, b))

    angle = 0.5 * np.arctan2(2 * along(first, second), along(first, first) - along(second, second))
    cosine, sine = np.cos(angle)[:, None], np.sin(angle)[:, None]
    first, second = cosine * first + sine * second, cosine * second - sine * first
    widths = [WIDEN * np.sqrt(np.maximum(along(axis, axis), 0)) for axis in (first, second)]
    deep = np.maximum(np.sqrt(np.maximum(along(normal, normal) - side**2 / 12, 0)), THIN * side)
    return np.stack([first, second, normal], axis=-1), np.stack([*widths, deep], axis=-1)


def _in_the_world(ndc: Ndc, mean: np.ndarray, axes: np.ndarray, scales: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Gaussians of normalised device coordinates in the world: means, axes and standard deviations."""
    root = np.einsum("nij,njk->nik", _jacobians(ndc, mean), axes * scales[:, None, :])
    variance, turned = np.linalg.eigh(np.einsum("nij,nkj->nik", root, root))
    turned[:, :, 0] *= np.sign(np.linalg.det(turned))[:, None]
    world = ndc.world(mean)
    far = np.linalg.norm(world - ndc.world_from_camera[:3, 3], axis=1, keepdims=True)
    scales = np.sqrt(np.maximum(variance, (1e-6 * far) ** 2))  # ascending
    scales[:, 2] = np.minimum(scales[:, 2], DEEPEST * scales[:, 1])
    return world, turned, scales


def _convert(tree: NerfTree, shown: Shown, begin: np.ndarray, weight: np.ndarray, out: np.ndarray, degree: int) -> None:
    """Mean colours of cells into `out` (C, K, 3), as Gaussians have them."""
    directions = _directions(DIRECTIONS)
    basis = basis_numpy(directions, tree.degree)
    back = np.linalg.pinv(basis_numpy(directions, degree)).astype(np.float32)
    for cells in pieces(len(begin) - 1, first=4096, most=2**15):
        part = slice(begin[cells.start], begin[cells.stop])
        mixed = tree.coefficients(shown.voxels[part]) * shown.pixels[part, None, None].astype(np.float32)
        mixed = np.add.reduceat(mixed, begin[cells] - part.start, axis=0) / weight[cells, None, None].astype(np.float32)
        out[cells] = 0
        for n in range(len(directions)):  # not by BLAS, whose sums depend on its threads
            raw = sum(np.float32(basis[n, k]) * mixed[:, k] for k in range(basis.shape[1]))
            colour = sigmoid(np.asarray(raw)) - np.float32(0.5)
            for k in range(out.shape[1]):
                out[cells, k] += back[k, n] * colour


def _directions(count: int) -> np.ndarray:
    """(count, 3) unit, spread evenly: a Fibonacci lattice."""
    n = np.arange(count) + 0.5
    z, azimuth = 1 - 2 * n / count, np.pi * (1 + np.sqrt(5)) * n
    ring = np.sqrt(1 - z * z)
    return np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), z], axis=-1)


def environment_shell(tree: NerfTree, count: int, degree: int, distance: float = SHELL_DISTANCE) -> Gaussians:
    """So many far Gaussians in the colours of a tree's environment map, in half diagonals of its outermost cascade; none without one."""
    if tree.environment is None:
        count = 0
    bounds = cascades_of(tree)[-1].bounds(tree.brick)
    distance *= float(np.linalg.norm(bounds[1] - bounds[0])) / 2
    directions = _directions(count) if count else np.zeros((0, 3))
    axes = np.stack([*across(directions), directions], axis=-1)
    spacing = distance * np.sqrt(4 * np.pi / max(count, 1))
    harmonics = np.zeros((count, (degree + 1) ** 2, 3))
    if count and tree.environment is not None:
        harmonics[:, 0] = (environment.lookup(tree.environment, directions) - 0.5) / C0
    scales = np.tile([0.6 * spacing, 0.6 * spacing, 0.1 * spacing], (count, 1))
    parts = bounds.mean(axis=0) + distance * directions, scales, quaternions_from(axes), np.full(count, 0.98), harmonics
    return Gaussians(*(np.ascontiguousarray(part, np.float32) for part in parts))


def joined(*sets: Gaussians) -> Gaussians:
    """All Gaussians of some sets, in order; harmonics that a set lacks are zero."""
    terms = max(each.harmonics.shape[1] for each in sets)
    harmonics = [np.pad(each.harmonics, ((0, 0), (0, terms - each.harmonics.shape[1]), (0, 0))) for each in sets]
    means, scales, rotations, opacities = (np.concatenate([getattr(each, name) for each in sets]) for name in ("means", "scales", "rotations", "opacities"))
    return Gaussians(means, scales, rotations, opacities, np.concatenate(harmonics))
