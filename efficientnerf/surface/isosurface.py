"""From densities to a surface: marching cubes, cleaned, decimated and coloured; and points on it.

Letters: sigma density per world unit, tau the level of the surface, s the voxel's side; V vertices, F faces, R rays, K directions, S samples.
Everything is in the frame of the volume (`efficientnerf.surface.volume`).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from efficientnerf.surface.filled import dense_voxels, filled_blocks, filled_parts
from efficientnerf.surface.mesh import (
    Mesh,
    PointCloud,
    compact,
    decimate,
    face_areas,
    face_components,
    face_volumes,
    sample,
    separate,
    smooth,
    smooth_normals,
    tidy,
    vertex_normals,
)
from efficientnerf.surface.volume import NdcVolume, Volume

Progress = Callable[[int, int, str], None]
Shown = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]  # vertices, faces, component (F,) -> how much is seen of each component (C,)
ViewDirections = Callable[[np.ndarray, np.ndarray], list[np.ndarray]]
LARGEST_SIDE = 4096  # voxels along a side of a grid that is baked
BLOCK = 64  # voxels a side that are in memory at a time
NORMAL_ROUNDS = 6  # of smoothing normals, at most as many as of smoothing. docs/experiments/surface.md
SHOWN = 1.0  # pixel of all views together that a component has to show
CHUNK = 1 << 16  # points whose colours are looked up at a time


class NoSurface(ValueError):
    """The density nowhere reaches the given level. The message names the level and the highest density."""


def _silent(done: int, total: int, text: str) -> None:
    pass


def _grid(volume: Volume) -> np.ndarray:
    return np.asarray(volume.shape, np.int64) * int(volume.brick)  # (3,) voxels per axis


def pool_of(volume: Volume) -> int:
    """Voxels along a side of the cells in which enclosed space is found: two; more where that were over 256 cells a side, for the memory.

    Of grids beyond the sides that are baked, which may be a line of cells, the least that makes no more than 256^3 cells.
    """
    grid = _grid(volume)
    pool = 2 * max(1, -(-int(grid.max()) // 512))
    if grid.max() > LARGEST_SIDE:
        pool = next(each for each in range(2, pool + 1, 2) if each == pool or np.prod(-(-grid // each)) <= 256**3)
    return pool


def automatic_threshold(volume: Volume, lines: int = 24) -> float:
    """The density of the surface where none is given: what light entering from outside meets.

        tau = min( ln 2 / s,  lower quartile over rays of max_{j <= h} sigma_j ),   h: the voxel where the ray's transmittance falls to 1/2

    Rays run along the axes, both ways, through up to `lines` x `lines` columns of bricks per axis; those that stay half transparent are
    left out. A surface at tau lies at or in front of the depth at which a ray has lost half its light if tau <= the highest density up to
    there; the lower quartile makes that true for three rays in four, so that soft, half-trained densities give a closed surface where a
    fixed level would leave holes or nothing. Where densities are hard, one voxel that swallows half the light is enough (the first term):
    a higher level would eat thin parts.

    Raises NoSurface where no ray loses half its light.
    """
    grid, brick, voxel = _grid(volume), int(volume.brick), float(volume.voxel)
    found, highest = [], 0.0
    for axis in range(3):
        first, second = (other for other in range(3) if other != axis)
        for i in _evenly_spaced(grid[first] // brick, lines):
            for j in _evenly_spaced(grid[second] // brick, lines):
                low, high = np.zeros(3, np.int64), grid.copy()
                low[first], low[second] = i * brick, j * brick
                high[first], high[second] = low[first] + brick, low[second] + brick
                blocks = [np.asarray(volume.density_block(*part)) for part in filled_parts(volume, axis, low, high)]
                if not blocks:
                    continue
                block = np.concatenate(blocks, axis)
                sigma = np.moveaxis(block, axis, -1).reshape(-1, block.shape[axis]).astype(np.float64)  # (R, S)
                highest = max(highest, float(sigma.max()))
                found += [_densities_on_entry(ray, voxel) for ray in (sigma, sigma[:, ::-1])]
    levels = np.concatenate(found) if found else np.zeros(0)
    if not len(levels):
        raise NoSurface(f"no ray through the volume loses half its light; the highest density found is {highest:.3g} per unit and a voxel is {voxel:.3g} wide")
    return float(min(np.log(2) / voxel, np.quantile(levels, 0.25)))


def _evenly_spaced(count: int, most: int) -> np.ndarray:
    """At most `most` of the numbers 0..count-1, evenly spread."""
    return np.unique((np.arange(min(count, most)) + 0.5) * count // min(count, most)).astype(np.int64)


def _densities_on_entry(sigma: np.ndarray, voxel: float) -> np.ndarray:
    """(R, S) densities along rays -> the highest up to the depth of half transmittance, of the rays that have one."""
    depth = np.cumsum(sigma, 1) * voxel  # (R, S) optical depth
    opaque = depth[:, -1] >= np.log(2)
    half = (depth[opaque] < np.log(2)).sum(1)  # (R,) first voxel behind which less than half is left
    return np.maximum.accumulate(sigma[opaque], 1)[np.arange(len(half)), half]


def enclosed_cells(volume: Volume, threshold: float, viewpoints: np.ndarray) -> np.ndarray:
    """Empty space that nobody outside can see, because everything around it is dense: bool, one value per cell of `pool_of`^3 voxels.

    viewpoints  (N, 3) places that are outside by definition, besides the boundary of the volume: a camera may stand in a closed room

    A cell counts as dense if one of its voxels is, so that light does not creep in through pinholes of the size of a voxel.
    """
    from scipy.ndimage import label

    grid, pool = _grid(volume), pool_of(volume)
    cells = -(-grid // pool)
    dense = np.zeros(cells + 2, bool)  # an empty cell all around: the outside
    for voxels in dense_voxels(volume, threshold):
        dense[tuple((voxels // pool + 1).T)] = True
    region = np.empty(dense.shape, np.int32)
    label(~dense, output=region)
    outside = {int(region[0, 0, 0])}
    at = np.floor((viewpoints - np.asarray(volume.bounds_min)) / (float(volume.voxel) * pool)).astype(np.int64)  # (N, 3)
    at = at[((at >= 0) & (at < cells)).all(1)] + 1
    outside |= set(region[tuple(at.T)].tolist())
    return (~dense & ~np.isin(region, list(outside)))[1:-1, 1:-1, 1:-1]


def _filled_block(volume: Volume, low: np.ndarray, high: np.ndarray, threshold: float, enclosed: np.ndarray | None) -> np.ndarray:
    """`volume.density_block` with infinite density in enclosed space.

    What is enclosed grows by a few voxels, as far as nothing dense is in the way: into the corners that its coarse cells left out, and
    into pinholes, which it fills. The margin that is read makes the result the same for both blocks that share a plane.
    """
    from scipy.ndimage import binary_dilation

    if enclosed is None:
        return np.asarray(volume.density_block(low, high))
    margin = pool_of(volume) + 1
    axes = [np.arange(a - margin, b + margin) // pool_of(volume) for a, b in zip(low, high)]
    known = [(axis >= 0) & (axis < count) for axis, count in zip(axes, enclosed.shape)]
    seed = enclosed[np.ix_(*(np.clip(axis, 0, count - 1) for axis, count in zip(axes, enclosed.shape)))]
    seed &= known[0][:, None, None] & known[1][:, None] & known[2]
    if not seed.any():
        return np.asarray(volume.density_block(low, high))
    sigma = np.asarray(volume.density_block(low - margin, high + margin))
    filled = binary_dilation(seed, iterations=margin, mask=sigma < threshold)
    return np.where(filled, np.float32(np.inf), sigma)[margin:-margin, margin:-margin, margin:-margin]


def isosurface(
    volume: Volume, threshold: float, progress: Progress = _silent, *, enclosed: np.ndarray | None = None, block: int = BLOCK
) -> tuple[np.ndarray, np.ndarray]:
    """The closed surface where the density passes `threshold` -> vertices (V, 3) float64, faces (F, 3) int64.

    Blocks of `block` voxels share the samples of the plane between them, and so its vertices; those are joined by the grid edge that they
    lie on, not by their coordinates. Beyond the volume the density is zero, so the surface closes at its boundary. Cells that are `enclosed`
    (of `enclosed_cells`) count as solid.

    Marching cubes (Lewiner's, by scikit-image) runs on the opacity f = 1 - 2^(-sigma / threshold) at level 1/2 instead of on sigma: densities
    jump from nothing to hundreds within a voxel, and vertices interpolated on them would all sit at the same end of their edges.
    """
    from skimage.measure import marching_cubes

    grid = _grid(volume)
    starts = [np.arange(-1, grid[axis], block) for axis in range(3)]
    blocks = filled_blocks(volume, [len(each) for each in starts], block)
    positions, faces, seams, joined, count = [], [], [], [], 0
    for done, number in enumerate(blocks):
        low = number * block - 1
        high = np.minimum(low + block, grid)  # the last sample, included
        opacity = _opacity(_filled_block(volume, low, high + 1, threshold, enclosed), low, threshold)
        progress(done + 1, len(blocks), "marching cubes")
        if opacity.min() > 0.5 or opacity.max() < 0.5:
            continue
        local, triangles, _, _ = marching_cubes(opacity, 0.5, gradient_direction="ascent")  # "ascent" is the one that winds outward here
        local = local.astype(np.float64)  # (V, 3) in voxels from `low`
        rows, keys = _on_seams(local, low, high, grid)
        positions.append(local + low)
        faces.append(triangles.astype(np.int64) + count)
        seams.append(rows + count)
        joined.append(keys)
        count += len(local)
    if not faces:
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    target = np.arange(count)
    rows, keys = np.concatenate(seams), np.concatenate(joined)
    _, first, index = np.unique(keys, return_index=True, return_inverse=True)
    target[rows] = rows[first][index]
    grid_points, triangles = compact(np.concatenate(positions), target[np.concatenate(faces)])
    # Sample i lies at the middle of voxel i. What closes the surface at the boundary must not stand out of the box.
    grid_points = np.clip(grid_points + 0.5, 0, grid)
    return np.asarray(volume.bounds_min, np.float64) + grid_points * float(volume.voxel), triangles


def _opacity(sigma: np.ndarray, low: np.ndarray, threshold: float) -> np.ndarray:
    """Density at voxels from `low` on -> float32 opacity of a layer that is half opaque at the threshold.

    A dither of 0.001, a hash of the voxel's index, is laid over it. Saturated opacities (0 and 1 only) put the same value on all four
    corners of a checkered face, whose ambiguity Lewiner's test then decides differently in different cells: edges with four faces. And no
    value may be the level itself: every vertex must lie inside one grid edge, strictly.
    """
    opacity = (1 - np.exp2(-sigma.astype(np.float64) / threshold)).astype(np.float32)
    first = [np.arange(start, start + count) + 1 for start, count in zip(low, sigma.shape)]
    index = [each.astype(np.uint32) * np.uint32(prime) for each, prime in zip(first, (73856093, 19349663, 83492791))]
    mixed = index[0][:, None, None] ^ index[1][None, :, None] ^ index[2][None, None, :]
    mixed = (mixed ^ (mixed >> np.uint32(15))) * np.uint32(2246822519)
    opacity += (mixed >> np.uint32(16)).astype(np.float32) * np.float32(1e-3 / 65536)
    return np.where(np.abs(opacity - 0.5) < 1e-4, np.float32(0.4999), opacity).astype(np.float32)


def _on_seams(local: np.ndarray, low: np.ndarray, high: np.ndarray, grid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The vertices on a block's sides: their rows, and a number for the grid edge that each lies on."""
    whole = local == np.floor(local)  # (V, 3)
    side = (whole & ((local == 0) | (local == high - low))).any(1)
    rows = np.flatnonzero(side & (whole.sum(1) == 2))
    axis = np.argmin(whole[rows], 1)
    corner = np.floor(local[rows]).astype(np.int64) + low + 1  # >= 0
    return rows, ((corner[:, 0] * (grid[1] + 3) + corner[:, 1]) * (grid[2] + 3) + corner[:, 2]) * 3 + axis


def visible_parts(
    vertices: np.ndarray, faces: np.ndarray, min_component: float, viewpoints: np.ndarray, shown: Shown | None = None
) -> tuple[np.ndarray, np.ndarray, dict[str, int]]:
    """The closed mesh without small components, hollows, and what lies in hollows; or, where views say what they see, without what they do not.

    min_component   components with less than this share of the largest one's area are removed
    shown           how much views show of each component; None: not known
    returns         vertices, faces, and how many components were removed for which reason

    A component that encloses a negative volume is the wall of a hollow inside something solid. It cannot be seen from anywhere outside, and neither can
    the components in it. All of this is kept where one of the
    `viewpoints` (N, 3) lies in a hollow: that is a room, seen from inside.
    """
    label = face_components(faces, len(vertices))
    areas, volumes = face_areas(vertices, faces), face_volumes(vertices, faces)
    area, volume = np.bincount(label, areas), np.bincount(label, volumes)
    if shown is not None:
        seen, enough = shown(vertices, faces, label) >= SHOWN, area >= min_component * area.max()
        removed = {"unseen_removed": int((~seen).sum()), "small_removed": int((seen & ~enough).sum())}
        return *compact(vertices, faces[(seen & enough)[label]]), {"components_found": len(area), **removed}
    hollow = volume <= 0
    large = ~hollow & (area >= min_component * area[~hollow].max())
    walls = vertices[faces[hollow[label]]]  # (F, 3, 3)
    if any(_crossings(viewpoint, walls) % 2 for viewpoint in viewpoints):
        hollow[:] = False
        walls = walls[:0]
        large = area >= min_component * area.max()
    first = np.full(len(area), -1)
    first[label[::-1]] = faces[::-1, 0]
    inside = np.zeros(len(area), bool)
    if len(walls):
        inside[large] = [_crossings(vertices[first[component]], walls) % 2 == 1 for component in np.flatnonzero(large)]
    kept = large & ~inside
    counts = {"small_removed": ~hollow & ~large, "hollows_removed": hollow, "hidden_removed": inside}
    return *compact(vertices, faces[kept[label]]), {"components_found": len(area), **{name: int(which.sum()) for name, which in counts.items()}}


def _crossings(point: np.ndarray, triangles: np.ndarray) -> int:
    """How many of the (F, 3, 3) triangles a ray from `point` along +x passes; a slight tilt keeps it off the grid's edges."""
    shifted = triangles - point
    shifted = shifted[..., 1:] - shifted[..., :1] * np.array([0.0137, 0.0071])  # (F, 3, 2) seen along the ray
    turn = shifted[:, [0, 1, 2], 0] * shifted[:, [1, 2, 0], 1] - shifted[:, [0, 1, 2], 1] * shifted[:, [1, 2, 0], 0]  # (F, 3) also barycentric weights
    hit = (turn > 0).all(1) | (turn < 0).all(1)
    weight = turn[hit] / turn[hit].sum(1, keepdims=True)
    return int(((weight * (triangles[hit, :, 0] - point[0])).sum(1) > 0).sum())


def surface_colours(
    volume: Volume, positions: np.ndarray, normals: np.ndarray, progress: Progress = _silent, view_directions: ViewDirections | None = None, chunk: int = CHUNK
) -> np.ndarray:
    """(N, 3) float32 sRGB of surface points, as seen from outside.

    Along the inward normal, from one voxel in front of the point to two behind it, colours are weighted as a ray would weigh them: a single
    sample on the surface mixes with the colour of empty voxels. Each is the median over six viewing directions, one head on and five at
    45 degrees, so that neither a highlight nor a direction without training views decides; or over those that `view_directions` gives for
    points and normals.
    """
    colours = np.empty((len(positions), 3), np.float32)
    steps = np.linspace(-1.0, 2.0, 7) * float(volume.voxel)  # (S,)
    for start in range(0, len(positions), chunk):
        part = slice(start, start + chunk)
        progress(start, len(positions), "colours")
        point, normal = positions[part], normals[part]
        samples = point[:, None] - steps[:, None] * normal[:, None]  # (N, S, 3)
        sigma = np.asarray(volume.density(samples.reshape(-1, 3)), np.float64).reshape(-1, len(steps))
        depth = np.cumsum(sigma, 1) * (steps[1] - steps[0])
        weight = np.exp(-np.pad(depth, ((0, 0), (1, 0)))[:, :-1]) - np.exp(-depth) + 1e-12 * (sigma + 1e-9)  # (N, S)
        weight /= weight.sum(1, keepdims=True)
        best = np.argsort(-weight, 1, kind="stable")[:, :3]  # three samples carry nearly all
        share = np.take_along_axis(weight, best, 1)
        chosen = np.take_along_axis(samples, best[..., None], 1).reshape(-1, 3)
        views = []
        for direction in _view_directions(normal) if view_directions is None else view_directions(point, normal):
            along = np.repeat(direction, best.shape[1], 0)
            found = np.asarray(volume.colour(chosen, along), np.float64).reshape(-1, best.shape[1], 3)
            views.append((found * share[..., None]).sum(1) / share.sum(1, keepdims=True))
        colours[part] = np.clip(np.median(views, 0), 0, 1)
    progress(len(positions), len(positions), "colours")
    return colours


def _view_directions(normal: np.ndarray) -> list[np.ndarray]:
    """K unit ray directions (N, 3) each, towards a surface with these outward normals."""
    helper = np.where(np.abs(normal[:, 2:]) < 0.9, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0])
    first = np.cross(helper, normal)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(normal, first)
    slanted = [-(normal + np.cos(angle) * first + np.sin(angle) * second) * np.sqrt(0.5) for angle in np.arange(5) * (2 * np.pi / 5)]
    return [-normal, *slanted]


def cleaned_surface(
    volume: Volume, threshold: float | None, min_component: float, rounds: int, viewpoints: np.ndarray, progress: Progress, shown: Shown | None = None
) -> tuple[np.ndarray, np.ndarray, dict[str, object]]:
    """Vertices, faces and facts of the surface before it is decimated; see `surface`."""
    level = automatic_threshold(volume) if threshold is None else float(threshold)
    if not (np.isfinite(level) and level > 0):
        raise NoSurface(f"threshold {level:g}: expected a density above zero")
    enclosed = enclosed_cells(volume, level, viewpoints)
    vertices, faces = isosurface(volume, level, progress, enclosed=enclosed if enclosed.any() else None)
    if not len(faces):
        raise NoSurface(f"the density nowhere reaches {level:.4g} per unit")
    vertices, faces, facts = visible_parts(vertices, faces, min_component, viewpoints, _in_world(volume, shown))
    if not len(faces):
        raise NoSurface(f"no view shows anything of the surface at {level:.4g} per unit")
    vertices = np.clip(smooth(vertices, faces, rounds), vertices.min(0), vertices.max(0))  # flat sides must not bulge out of the box
    return vertices, faces, {"threshold": level, "threshold_chosen": "automatic" if threshold is None else "given", **facts}


def _in_world(volume: Volume, shown: Shown | None) -> Shown | None:
    """What is shown of components of the volume's frame."""
    if shown is None or not isinstance(volume, NdcVolume):
        return shown
    ndc = volume.ndc
    return lambda vertices, faces, component: shown(ndc.world(vertices), faces, component)


_NO_VIEWPOINTS = np.zeros((0, 3))


def surface(
    volume: Volume,
    threshold: float | None = None,
    *,
    faces: int = 200_000,
    min_component: float = 0.01,
    rounds: int = 10,
    viewpoints: np.ndarray = _NO_VIEWPOINTS,
    shown: Shown | None = None,
    progress: Progress = _silent,
) -> Mesh:
    """The volume's surface as a closed, coloured mesh in the training frame.

    threshold      density per world unit of the surface; None: `automatic_threshold`
    faces          budget that it is decimated to
    min_component  components with less than this share of the largest one's area are removed
    rounds         of smoothing, which keeps the volume; as many, up to NORMAL_ROUNDS, of smoothing normals, which keeps edges
    viewpoints     (N, 3) camera positions that may lie inside the volume: what can be seen from there is not filled
    shown          how much views of the world show of components: those that they do not show are removed; None: hollows and what is in them are
    progress       called with (done, total, text); what it raises stops the work

    Of an `NdcVolume` it is the surface in normalised device coordinates (budget, rounds and sizes of components count there), in the world.

    Raises NoSurface.
    """
    ndc = volume if isinstance(volume, NdcVolume) else None
    viewpoints = viewpoints if ndc is None else _NO_VIEWPOINTS  # the cameras are before the near plane, outside of the volume
    vertices, triangles, facts = cleaned_surface(volume, threshold, min_component, rounds, viewpoints, progress, shown)
    facts["faces_before_decimation"] = len(triangles)
    vertices, triangles = separate(*tidy(*decimate(vertices, triangles, faces)))
    vertices, triangles, _ = visible_parts(vertices, triangles, min_component, viewpoints, _in_world(volume, shown))  # what decimation cut off
    if len(triangles):
        vertices = np.clip(smooth_normals(vertices, triangles, min(rounds, NORMAL_ROUNDS)), vertices.min(0), vertices.max(0))
    normals = vertex_normals(vertices, triangles)
    colours = surface_colours(volume, vertices, normals, progress, None if ndc is None else ndc.view_directions)
    mesh = Mesh(vertices, triangles, normals, colours, facts)
    return mesh if ndc is None else ndc.mesh(mesh)


def points(
    volume: Volume,
    count: int = 200_000,
    threshold: float | None = None,
    *,
    min_component: float = 0.01,
    rounds: int = 10,
    viewpoints: np.ndarray = _NO_VIEWPOINTS,
    shown: Shown | None = None,
    seed: int = 0,
    progress: Progress = _silent,
) -> PointCloud:
    """`count` points spread evenly over the surface (before decimation), with normals and colours. Raises NoSurface.

    The same for the same seed; the other arguments as for `surface`. Of an `NdcVolume` they are spread evenly in normalised device
    coordinates, as images show them: sparser in the world the further they are.
    """
    ndc = volume if isinstance(volume, NdcVolume) else None
    viewpoints = viewpoints if ndc is None else _NO_VIEWPOINTS
    vertices, triangles, _ = cleaned_surface(volume, threshold, min_component, rounds, viewpoints, progress, shown)
    cloud = spread(volume, vertices, triangles, count, seed, progress)
    return cloud if ndc is None else ndc.points(cloud)


def spread(volume: Volume, vertices: np.ndarray, triangles: np.ndarray, count: int, seed: int, progress: Progress = _silent) -> PointCloud:
    """`count` points spread evenly over a surface of the volume, in its frame."""
    face, weight = sample(vertices, triangles, count, seed)
    corners = triangles[face]  # (N, 3)
    normals = (vertex_normals(vertices, triangles)[corners] * weight[..., None]).sum(1)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.where(length > 1e-6, normals / np.maximum(length, 1e-6), vertex_normals(vertices, triangles)[corners[:, 0]])
    positions = (vertices[corners] * weight[..., None]).sum(1)
    directions = volume.view_directions if isinstance(volume, NdcVolume) else None
    return PointCloud(positions, normals, surface_colours(volume, positions, normals, progress, directions))
