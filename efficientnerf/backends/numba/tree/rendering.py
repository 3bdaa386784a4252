"""Rendering of interpolated trees on the CPU (numba, all cores): from trees and cameras to the arrays of the kernels.

Images and rays are rendered from the tree's packed form by `tree.image` and `tree.packets`; nearest-lookup trees by `tree.nearest`. The torch reference is
`tests.efficientnerf.tree_reference`.
"""

import functools
import itertools
from typing import NamedTuple

import numpy as np

from efficientnerf.asset.cascades import cascades_of
from efficientnerf.asset.tree import NerfTree
from efficientnerf.backends.numba.rays import ndc_numbers
from efficientnerf.backends.numba.runtime import numba
from efficientnerf.backends.numba.tree.image import TILE, WORK, beginning, downsample, render_batch
from efficientnerf.backends.numba.tree.march import LOG2E
from efficientnerf.backends.numba.tree.packed import VOXELS_PER_CALL, packed_of
from efficientnerf.backends.numba.tree.ray_batch import DIRECTION_TABLE, PINHOLE, RayBatch, given_rays
from efficientnerf.backends.numba.tree.surroundings import add_environment
from efficientnerf.backends.numba.tree.view_colours import View, compute_view_colours
from efficientnerf.geometry.cameras import Camera, rays

PINHOLES = ("SIMPLE_PINHOLE", "PINHOLE")
# Distance, in voxels per unit of `Packed.colour_slope`, from which a voxel's colour is summed once for a view: docs/experiments/renderer.md
VOXELS_PER_SLOPE = 500.0
VOXELS_PER_SLOPE_NDC = 250.0
EVERYWHERE = np.zeros(5)  # as a cone
DIRECTIONS_PER_BAND = 2**22  # directions of cameras with distortion that are cached between images: 48 MB


def _allocate(height: int, width: int, *, normals: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Empty colour, opacity, depth, normal."""
    shape = (height, width)
    normal = np.empty((*shape, 3) if normals else (0, 0, 3), np.float32)
    return np.empty((*shape, 3), np.float32), np.empty(shape, np.float32), np.empty(shape, np.float32), normal


class ViewColours(NamedTuple):
    """Colours of a tree's voxels for a view, see `compute_view_colours`, between two rows (N + 2, 4) uint16, and where they may be used, see `View`."""

    view: View
    colours: np.ndarray
    key: bytes  # all that the colours depend on besides the tree; empty for none


def _cone(camera: Camera) -> np.ndarray:
    """The `cone` of `compute_view_colours` in which all rays of a camera lie."""
    if camera.model not in PINHOLES:
        return EVERYWHERE
    corners = np.array([[x, y] for x in (0, camera.width) for y in (0, camera.height)], np.float64)
    cosine = min(1.0, float((rays(camera, corners)[1] @ camera.forward).min()))
    return np.array([*camera.forward, cosine, np.sqrt(1 - cosine**2)])


def _view_colours(tree: NerfTree, view_direction: np.ndarray, cone: np.ndarray = EVERYWHERE) -> ViewColours:
    """Of all cascades, as far as the cone reaches; the direction is that of cascade 0. Those of the image before, if it was of the same view."""
    view, key = _view(tree, view_direction, _near_distance(tree, view_direction)), view_direction.tobytes() + cone.tobytes()
    colours, before = _colour_buffer(tree)
    if key != before:
        packed = packed_of(tree)
        for cascade, (begin, end) in enumerate(itertools.pairwise(packed.first_voxel.tolist())):
            for first in range(begin, end, VOXELS_PER_CALL):
                given = view.direction[cascade], cone, view.density_scale[cascade], tree.degree
                compute_view_colours(first, min(end, first + VOXELS_PER_CALL), packed, *given, colours[1:])
    return ViewColours(view, colours, key)


def _colour_buffer(tree: NerfTree) -> tuple[np.ndarray, bytes]:
    """An array for view colours, and which view they are of: that of an earlier image if none uses it."""
    kept = tree.derived.setdefault("view_colours", [])
    try:
        return kept.pop()
    except IndexError:
        return np.zeros((len(tree.density_values) + 2, 4), np.uint16), b""  # finite, for what is not computed may be read and weighed by zero


def _keep_buffer(tree: NerfTree, colours: ViewColours) -> None:
    """Leaves the array of view colours, which nothing refers to any more, to the next image."""
    kept = tree.derived.setdefault("view_colours", [])
    if not kept and len(colours.colours) == len(tree.density_values) + 2:
        kept.append((colours.colours, colours.key))


def _view(tree: NerfTree, view_direction: np.ndarray, min_distance: np.ndarray) -> View:
    """The view of all cascades, from the direction of cascade 0."""
    ratio, shift = packed_of(tree).places[:, 0], packed_of(tree).places[:, 1:]
    matrix = np.broadcast_to(view_direction[:, :3], (len(ratio), 3, 3))  # directions may have any length: per voxel of each cascade
    at_zero = view_direction[:, 3] / ratio[:, None] - np.einsum("ij,lj->li", view_direction[:, :3], shift)
    scale = np.array([np.float32(tree.step_size * cascade.voxel * LOG2E) for cascade in cascades_of(tree)], np.float32)
    direction = np.concatenate([matrix, at_zero[..., None]], axis=2)
    return View(direction, float(np.linalg.norm(view_direction[:, :3], 2)), min_distance, scale, float(tree.step_size), tree.degree)


def _min_distance(tree: NerfTree) -> np.ndarray:
    """`View.min_distance` of each cascade, voxels."""
    return (VOXELS_PER_SLOPE if tree.ndc is None else VOXELS_PER_SLOPE_NDC) * packed_of(tree).colour_slope


def _near_distance(tree: NerfTree, view_direction: np.ndarray) -> np.ndarray:
    """`_min_distance` of each cascade, minus infinity where its box is farther than that from the point that the view is from."""
    least = _min_distance(tree)
    if tree.ndc is not None:
        return least
    packed = packed_of(tree)
    for n, (ratio, *shift) in enumerate(packed.places):
        eye = -view_direction[:, 3] / ratio + shift
        beside = np.maximum(np.maximum(-eye, eye - packed.grids[n, :3] * tree.brick), 0)
        if np.linalg.norm(beside) >= least[n] + 2 * tree.brick + 4:
            least[n] = -np.inf
    return least


def _render(tree: NerfTree, batch: RayBatch, colours: ViewColours, background: np.ndarray, tile: tuple[int, int], out: tuple[np.ndarray, ...]) -> None:
    threads = numba.get_num_threads()
    progress = beginning(threads)
    # In pieces: signals are answered between calls.
    while not render_batch(
        batch, background, packed_of(tree), tree.brick, colours.colours, colours.view, float(tree.voxel), tile, threads, WORK, progress, *out
    ):
        pass


def render_rays(
    tree: NerfTree, origins: np.ndarray, directions: np.ndarray, sh_directions: np.ndarray | None = None, eye: np.ndarray | None = None,
    columns: int | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Colour (R, 3) premultiplied, opacity (R,), distance (R,), normal (R, 3) of rays; see `Rendering`.

    origins, directions  (R, 3) in the tree's frame, unit directions
    sh_directions        (R, 3) unit directions of the same rays in the world, where that is another frame; harmonics are evaluated along them
    eye                  (3,) world: common point of all rays, if there is one; a voxel's harmonics may then be summed once
    columns              rays in a row, if they are rows of an image: neighbouring rays meet the same voxels
    """
    if columns is not None and (columns < 1 or len(origins) % columns):
        raise ValueError(f"{len(origins)} rays in rows of {columns}: they have to fill the rows")
    rows, columns = (1, len(origins)) if columns is None else (len(origins) // columns, columns)
    shape = (rows, columns, 3)
    starts = ((np.asarray(origins, np.float64) - tree.bounds_min) / tree.voxel).reshape(shape)
    directions = np.ascontiguousarray(directions, np.float64).reshape(shape)
    along = None if sh_directions is None else np.ascontiguousarray(sh_directions, np.float32).reshape(shape)
    view_direction = np.eye(3, 4) if eye is None else _view_direction(tree, eye)
    batch = given_rays(np.ascontiguousarray(starts), directions, along)
    out = _allocate(rows, columns, normals=True)
    if len(origins):
        shared = eye is not None and _any_far(tree, view_direction)
        never = np.full(len(packed_of(tree).grids), np.inf)
        colours = _view_colours(tree, view_direction) if shared else ViewColours(_view(tree, view_direction, never), np.zeros((2, 4), np.uint16), b"")
        _render(tree, batch, colours, np.zeros(3, np.float32), (1, TILE * TILE) if rows == 1 else (TILE, TILE), out)
        if shared:
            _keep_buffer(tree, colours)
    colour, opacity, depth, normal = out
    return colour.reshape(-1, 3), opacity.reshape(-1), depth.reshape(-1), normal.reshape(-1, 3)


def _any_far(tree: NerfTree, view_direction: np.ndarray) -> bool:
    """Whether any voxel is at least `_min_distance` away."""
    grids, least = packed_of(tree).grids, _min_distance(tree)
    view = _view(tree, view_direction, least)
    for n, direction in enumerate(view.direction):
        corners = np.stack(np.meshgrid(*((0, cells * tree.brick) for cells in grids[n, :3]), indexing="ij"), -1).reshape(-1, 3)
        farthest = np.linalg.norm(corners @ direction[:, :3].T + direction[:, 3], axis=1).max()  # the length is convex: greatest at a corner
        if farthest > least[n] * view.direction_rate:
            return True
    return False


def _view_direction(tree: NerfTree, eye: np.ndarray) -> np.ndarray:
    """`View.direction` from a point of the world."""
    if tree.ndc is None:
        return np.concatenate([np.eye(3), (tree.bounds_min - np.asarray(eye, np.float64))[:, None] / tree.voxel], axis=1)
    matrix = tree.ndc.view_direction_matrix(np.asarray(eye, np.float64))
    return np.concatenate([matrix[:, :3] * tree.voxel, (matrix[:, :3] @ tree.bounds_min + matrix[:, 3])[:, None]], axis=1)


@functools.lru_cache(maxsize=1)
def _camera_directions(model: str, params: tuple[float, ...], width: int, height: int, supersample: int, top: int, low: int) -> np.ndarray:
    """Camera-frame directions of the rays of rows top to low: ((low - top) * supersample, width * supersample, 3) float32."""
    camera = Camera("", width, height, model, params, np.eye(4))
    y, x = np.mgrid[top * supersample : low * supersample, 0 : width * supersample]
    pixels = (np.stack([x.ravel(), y.ravel()], axis=-1) + 0.5) / supersample
    return rays(camera, pixels)[1].astype(np.float32).reshape(*x.shape, 3)


def _camera_batch(tree: NerfTree, camera: Camera, supersample: int, top: int, low: int) -> RayBatch:
    """The rays of rows top to low of a camera's image."""
    kind, table, none = PINHOLE, np.zeros((0, 0, 3), np.float32), np.zeros((0, 0, 3))
    if camera.model not in PINHOLES:
        kind, table = DIRECTION_TABLE, _camera_directions(camera.model, camera.params, camera.width, camera.height, supersample, top, low)
    fx, fy, cx, cy = (float(camera.intrinsics[name]) for name in ("fx", "fy", "cx", "cy"))
    rotation, centre = np.ascontiguousarray(camera.world_from_camera[:3, :3], np.float64), np.array(camera.centre, np.float64)
    x, y, z = (centre if tree.ndc is not None else (centre - tree.bounds_min) / tree.voxel).tolist()
    ndc = np.zeros(0) if tree.ndc is None else np.concatenate([ndc_numbers(tree.ndc), tree.bounds_min, [tree.voxel]])
    return RayBatch(
        kind, table.shape[1], fx, fy, cx, cy, 1 / supersample, top * supersample, rotation, x, y, z, table, none, none,
        False, none.astype(np.float32), tree.ndc is not None, ndc,
    )  # fmt: skip


def render_image(
    tree: NerfTree, camera: Camera, supersample: int, background: np.ndarray | None, *, normals: bool, rays_per_band: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Colour (H, W, 3), opacity (H, W), depth (H, W) along the view axis, normal (H, W, 3) of a camera's pixels.

    background     (3,) that colours are composited over; None: the tree's environment, or nothing where it has none
    normals        whether they are wanted; else they are (0, 0, 3)
    rays_per_band  rays of a supersampled image that are rendered before they are averaged
    """
    height, width = camera.height, camera.width
    environment = tree.environment if background is None else None
    behind = np.zeros(3, np.float32) if background is None else np.ascontiguousarray(background, np.float32)
    image = _allocate(height, width, normals=normals)
    most = rays_per_band if supersample > 1 else height * width
    if camera.model not in PINHOLES:
        most = min(most, DIRECTIONS_PER_BAND)
    step = max(1, most // max(1, width * supersample**2))
    cone = _cone(camera) if tree.ndc is None else EVERYWHERE  # a voxel is not as long along one axis as along another
    colours = _view_colours(tree, _view_direction(tree, camera.centre), cone)
    for top in range(0, height, step):
        low = min(top + step, height)
        part = tuple(whole[top:low] if len(whole) else whole for whole in image)
        batch = _camera_batch(tree, camera, supersample, top, low)
        fine = part if supersample == 1 else _allocate((low - top) * supersample, width * supersample, normals=normals)
        _render(tree, batch, colours, behind, (TILE, TILE), fine)
        if environment is not None:
            add_environment(environment, batch, fine[1], fine[0])
        if supersample > 1:
            downsample(supersample, *fine, *part)
    _keep_buffer(tree, colours)
    return image
