"""Colours of texels from photographs: each texel keeps its colours in the photographs that show it best, and gets the one that most of these agree on.

A photograph shows a texel where the mesh's depth says so, away from depth edges, masked pixels and the photograph's borders: the mesh is
never exact, and colours behind an edge must not bleed onto it. Its grade there is the area of its pixels that a texel covers (so that oblique, distant
and coarse photographs count less), times the cosine to the normal, its sharpness and its distance from these edges; colours are weighted by its square
root. docs/experiments/textures.md
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from efficientnerf.backends.numba.mesh.photographs import blend, mark_edges, observe, sweep_down
from efficientnerf.backends.pieces import pieces
from efficientnerf.geometry.cameras import Camera, project
from efficientnerf.rendering.halving import halved
from efficientnerf.surface.mesh import Mesh, face_areas
from efficientnerf.surface.rasteriser import MeshImage, mesh_image
from efficientnerf.surface.texturing.asset import interpolated
from efficientnerf.surface.texturing.atlas import Atlas, Texels
from efficientnerf.surface.texturing.filling import carried_on

MAX_PHOTOGRAPHS = 12  # photographs that a texel remembers
SCALE = 60.0  # of 255, by which colours differ of which one is an outlier. docs/experiments/textures.md
VOTE = 1.5  # of the colour that the asset has, on which of the photographs is right, against the best of them
MIN_GRADE = 0.01  # grade of the colour that is expected. docs/experiments/textures.md
REACH = 6.0  # pixels from an edge at which a photograph counts in full
BORDER = 0.03  # of the longer side of a photograph, over which it fades out
JUMP = 0.01  # of the inverse depth, at a depth edge
SLACK = 0.001  # of its depth that a texel may lie behind what the mesh shows there
PIXEL_SHIFT = 1.0  # pixels that it may be from where that depth was taken: it lies deeper by as much as the surface slopes
FACING, CLEAR = 0.3, 3.0  # cosine to the normal, and pixels from edges, from which a photograph shows a vertex
FAINT = 250  # alpha under which a pixel shows something else, too
FINER = 1.25  # texels on the side of a pixel
FINEST = 2.0  # pixels of a photograph on the side of a texel from which it is reduced to half
SMALLEST_PHOTOGRAPH = 16  # pixels along a side, to which it is reduced
SHARP = 2.0  # times its sharpness over the median of all, at most 1, is what a photograph counts
MIN_SAMPLES = 200  # vertices that a photograph has to show for its gains to be known
GAIN = 0.12  # logarithm up to which gains are left out: differences with the direction of view look the same. docs/experiments/textures.md
MOST_GAIN = 0.7


def _untold() -> None:
    """Work that is not stopped."""


@dataclass(frozen=True, eq=False)
class Photograph:
    """camera (of the mesh's frame), colours (H, W, 3) uint8 sRGB, usable (H, W) bool."""

    camera: Camera
    colours: np.ndarray
    usable: np.ndarray

    def halved(self) -> Photograph:
        """At half its size; usable where all four pixels are."""
        camera, colours, usable = halved(self.camera, self.colours, self.usable)
        assert usable is not None
        return Photograph(camera, colours, usable)

    def reduced(self, most: int) -> Photograph:
        """Halved until it has no more than so many pixels."""
        return self if self.usable.size <= most else self.halved().reduced(most)


def photograph(camera: Camera, image: np.ndarray, mask: np.ndarray | None = None) -> Photograph:
    """A photograph as in files: uint8 (H, W, 3), or (H, W, 4) with straight alpha; mask (H, W) bool, True: use."""
    usable = np.ones(image.shape[:2], bool) if mask is None else np.array(mask, bool)
    if image.shape[2] == 4:
        usable[image[..., 3] < FAINT] = False
    return Photograph(camera, np.ascontiguousarray(image[..., :3]), usable)


@dataclass(frozen=True)
class Survey:
    """Statistics of a photograph on the mesh, before any texel sees it."""

    density: np.ndarray  # (F,) float32 pixels on the side of the square that a face is half of, where one of its vertices shows; zero elsewhere
    sharpness: float  # of its pixels of the mesh: how much of their detail is fine
    gains: np.ndarray  # (3,) factors that bring its colours to those of the vertices; nan where it shows too few


def survey(vertices: np.ndarray, faces: np.ndarray, normals: np.ndarray, colours: np.ndarray, photo: Photograph, tick: Callable[[], None] = _untold) -> Survey:
    """Statistics of a photograph on a mesh with normals (V, 3) and colours (V, 3) sRGB 0-1. `tick` is called often; an exception from it stops the work."""
    seen = _seen(vertices, faces, normals, photo, tick)
    p = seen.pixels[faces]
    edge, other = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
    area = np.abs(edge[:, 0] * other[:, 1] - edge[:, 1] * other[:, 0])
    at, column, row = _shown(seen, photo)
    visible = np.zeros(len(vertices), bool)
    visible[at] = True
    density = np.where(visible[faces].any(1), np.sqrt(area), 0.0)
    values = photo.colours[row, column].astype(np.float64) / 255
    return Survey(np.nan_to_num(density).astype(np.float32), _sharpness(photo, seen.clear, tick), _gains(values, colours[at].astype(np.float64)))


def shown_vertices(vertices: np.ndarray, faces: np.ndarray, normals: np.ndarray, photo: Photograph, tick: Callable[[], None] = _untold) -> np.ndarray:
    """(V,) float32 how well a photograph shows each vertex away from edges: pixels of a unit of area there; zero where it does not."""
    seen = _seen(vertices, faces, normals, photo, tick)
    at, _, _ = _shown(seen, photo)
    out = np.zeros(len(vertices), np.float32)
    out[at] = seen.facing[at] * (photo.camera.intrinsics["fx"] / np.linalg.norm(photo.camera.centre - vertices[at], axis=1)) ** 2
    return out


def colours_seen(
    vertices: np.ndarray, faces: np.ndarray, normals: np.ndarray, photo: Photograph, tick: Callable[[], None] = _untold
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Numbers of the vertices that a photograph shows, also near edges, their colours (N, 3), 0-1, and how much these count: less near edges."""
    seen = _seen(vertices, faces, normals, photo, tick)
    at, column, row = _shown(seen, photo, least=1.0)
    return at, photo.colours[row, column].astype(np.float64) / 255, np.minimum(seen.clear[row, column].astype(np.float64) / CLEAR, 1) ** 2 * seen.facing[at]


def _shown(seen: _Seen, photo: Photograph, least: float = CLEAR) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Numbers of the vertices that a photograph shows, not too obliquely and `least` pixels away from edges, and columns and rows of their pixels."""
    at = np.flatnonzero(np.isfinite(seen.pixels).all(1) & (seen.depth > 0) & (seen.facing > FACING))
    column, row = np.floor(np.clip(seen.pixels[at], -1, 1e9)).astype(np.int64).T
    inside = (column >= 0) & (row >= 0) & (column < photo.camera.width) & (row < photo.camera.height)
    at, column, row = at[inside], column[inside], row[inside]
    slack = SLACK + _pixel_shift(photo) * np.sqrt(np.maximum(1 - seen.facing[at] ** 2, 0)) / seen.facing[at]
    shown = (seen.depth[at] * seen.near[row, column] <= 1 + slack) & (seen.clear[row, column] >= least)
    return at[shown], column[shown], row[shown]


def _pixel_shift(photo: Photograph) -> float:
    """PIXEL_SHIFT pixels of a photograph, as a share of the depth."""
    intrinsics = photo.camera.intrinsics
    return PIXEL_SHIFT / min(float(intrinsics["fx"]), float(intrinsics["fy"]))


def texels_wanted(vertices: np.ndarray, faces: np.ndarray, density: np.ndarray) -> float:
    """Texels for each unit of a mesh of which one covers a pixel of the photograph that shows a face best; infinite where none shows any.

    density  (F,) the greatest of all photographs
    """
    areas = face_areas(vertices, faces)
    known = (density > 0) & (areas > 0)
    each = density[known] / np.sqrt(2 * areas[known])
    return float(FINER * _weighted_median(each, areas[known])) if known.any() else np.inf


def _weighted_median(values: np.ndarray, weights: np.ndarray) -> float:
    if not weights.sum() > 0:
        return 0.0
    order = np.argsort(values, kind="stable")
    sums = np.cumsum(weights[order])
    return float(values[order[np.searchsorted(sums, 0.5 * sums[-1])]])


def _gains(values: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """(3,) factors from values (N, 3) to those expected (N, 3): medians of ratios, without nearly black or white ones; nan where too few are left."""
    good = ((values > 0.08) & (values < 0.92) & (expected > 0.08) & (expected < 0.92)).all(1)
    return np.asarray(np.exp(np.median(np.log(expected[good] / values[good]), axis=0))) if good.sum() >= MIN_SAMPLES else np.full(3, np.nan)


def exposed_alike(surveys: Sequence[Survey]) -> list[Survey]:
    """The same surveys with gains that bring each photograph to the median of all: what all differ by from the mesh's own colours is those colours' fault.
    Ones where gains are small or unknown."""
    found = np.log([each.gains for each in surveys])
    known = np.isfinite(found).all(axis=1)
    relative = np.zeros_like(found)
    if known.any():
        relative[known] = found[known] - np.median(found[known], axis=0)
    gains = np.exp(np.clip(relative, -MOST_GAIN, MOST_GAIN))
    gains[np.abs(relative).max(axis=1) <= GAIN] = 1.0
    return [replace(each, gains=own) for each, own in zip(surveys, gains, strict=True)]


def _sharpness(photo: Photograph, clear: np.ndarray, tick: Callable[[], None]) -> float:
    """Variance of the Laplacian of what shows the mesh away from edges, over that of the photograph at half its size: the variance itself would tell what is
    shown rather than how sharply."""
    grey: np.ndarray = np.empty(photo.usable.shape, np.float32)
    for part in pieces(len(grey), first=256):
        tick()
        grey[part] = photo.colours[part].astype(np.float32).mean(axis=2)
    height, width = grey.shape[0] // 2 * 2, grey.shape[1] // 2 * 2
    half = grey[:height, :width].reshape(height // 2, 2, width // 2, 2).mean((1, 3))
    tick()
    fine, coarse = _laplacian_variance(grey, clear), _laplacian_variance(half, clear[:height:2, :width:2])
    return fine / coarse if coarse > 0 else 0.0


def _laplacian_variance(grey: np.ndarray, clear: np.ndarray) -> float:
    if min(grey.shape) < 3:
        return 0.0
    laplacian = grey[:-2, 1:-1] + grey[2:, 1:-1] + grey[1:-1, :-2] + grey[1:-1, 2:] - 4 * grey[1:-1, 1:-1]
    inner = clear[1:-1, 1:-1] >= 4
    return float(laplacian[inner].var()) if inner.any() else 0.0


@dataclass(frozen=True, eq=False)
class _Seen:
    """pixels (V, 2) and depth (V,) of vertices, cosines (V,) of their normals, inverse depth (H, W) of the mesh, distance (H, W) from edges."""

    pixels: np.ndarray
    depth: np.ndarray
    facing: np.ndarray
    near: np.ndarray
    clear: np.ndarray


def _seen(vertices: np.ndarray, faces: np.ndarray, normals: np.ndarray, photo: Photograph, tick: Callable[[], None]) -> _Seen:
    tick()
    image: MeshImage = mesh_image(vertices, faces, photo.camera)
    near = (np.float32(1) / image.depth).astype(np.float32)
    clear = edge_distance(photo.usable, near, tick)
    row, column = (np.minimum(np.arange(side, dtype=np.float32), np.arange(side, dtype=np.float32)[::-1]) for side in near.shape)  # pixels from a border
    clear = np.minimum(clear, np.minimum(row[:, None], column) * (REACH / max(BORDER * max(near.shape), REACH)))
    pixels, depth = project(photo.camera, vertices)
    away = photo.camera.centre - vertices
    away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-300)
    return _Seen(pixels, depth, (away * normals).sum(1).astype(np.float32), near, np.ascontiguousarray(clear, np.float32))


def edge_distance(usable: np.ndarray, near: np.ndarray, tick: Callable[[], None] = _untold) -> np.ndarray:
    """(H, W) float32 pixels from unusable ones (H, W) bool, and from jumps in the inverse depth (H, W) float32; 4 REACH at most."""
    clear = np.where(usable, np.float32(4 * REACH), np.float32(0))
    rows = len(clear)
    for part in pieces(rows, first=64):
        tick()
        mark_edges(near, JUMP, part.start, part.stop, clear)
    for image in (clear, clear[::-1, ::-1]):
        for part in pieces(rows, first=64):
            tick()
            sweep_down(part.start, part.stop, image)
    return clear


@dataclass(eq=False)
class PhotographTexture:
    """Texels of a mesh that look at photographs, one after the other: `look` at each, then `colours`."""

    # vertices, faces, normals: of the mesh, normals at its vertices
    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    atlas: Atlas
    density: np.ndarray  # (F,) pixels on the side of each face, of the photograph that has most
    sharpness: float  # of each photograph, median
    seen: np.ndarray = field(init=False)
    weights: np.ndarray = field(init=False)
    halvings: int = field(init=False)  # of photographs, before texels look at them: several of whose pixels lie in a texel

    def __post_init__(self) -> None:
        count = len(self.texels.place)
        self.seen = np.zeros((count, MAX_PHOTOGRAPHS, 3), np.uint8)
        self.weights = np.zeros((count, MAX_PHOTOGRAPHS), np.uint16)
        self.density = np.ascontiguousarray(self.density, np.float32)
        ratio = self.texels_per_pixel()
        self.halvings = max(0, int(np.floor(np.log(1 / ratio) / np.log(FINEST) + 1e-9))) if ratio > 0 else 0

    @property
    def texels(self) -> Texels:
        return self.atlas.texels

    def texels_per_pixel(self) -> float:
        """Texels on the side of a pixel, of the photograph that shows a face best; median over the surface that any shows, zero where none does."""
        areas = face_areas(self.vertices, self.faces)
        ratio = np.divide(self.atlas.scale * np.sqrt(2 * areas), self.density, out=np.zeros(len(areas)), where=self.density > 0)
        return float(f"{_weighted_median(ratio, np.where(self.density > 0, areas, 0)):.4g}")

    def look(self, photo: Photograph, found: Survey, tick: Callable[[], None] = _untold) -> None:
        """Let all texels see a photograph."""
        done = 0
        while done < self.halvings and min(photo.usable.shape) >= 2 * SMALLEST_PHOTOGRAPH:
            photo, done = photo.halved(), done + 1
        seen = _seen(self.vertices, self.faces, self.normals, photo, tick)
        sharpness = np.float32(np.clip(SHARP * found.sharpness / self.sharpness, 0.05, 1.0)) if self.sharpness > 0 else np.float32(1)
        gains = np.ascontiguousarray(found.gains, np.float32)
        density = self.density / np.float32(2**done)
        for part in pieces(len(self.faces), first=4096):
            tick()
            observe(
                part.start, part.stop, self.texels.begin, self.texels.share, self.faces, seen.pixels, seen.depth, seen.facing, seen.near, seen.clear,
                photo.colours, gains, np.float32(REACH), np.float32(SLACK), np.float32(_pixel_shift(photo)), density, sharpness, self.seen, self.weights,
            )  # fmt: skip

    def finished(self, mesh: Mesh, tick: Callable[[], None] = _untold) -> tuple[np.ndarray, np.ndarray]:
        """Colours (T, 3) uint8 of the texels, and what share of each is from photographs (T,). `mesh`: this one, with the colours that the asset has at its
        vertices, which tell outliers at first."""
        expected = interpolated(mesh, self.atlas, tick)
        around = carried_on(mesh, self.atlas, *self.colours(expected, tick=tick), expected, tick)
        return self.colours(interpolated(replace(mesh, colours=around), self.atlas, tick), tick=tick)

    def colours(self, expected: np.ndarray, tick: Callable[[], None] = _untold) -> tuple[np.ndarray, np.ndarray]:
        """Colours of the texels (T, 3) uint8, and what share of each is from photographs (T,); `expected` (T, 3) uint8 where they show nothing."""
        out, known = np.empty((len(self.seen), 3), np.uint8), np.empty(len(self.seen), np.float32)
        for part in pieces(len(self.seen), first=4096):
            tick()
            blend(part.start, part.stop, self.seen, self.weights, SCALE, expected, VOTE, MIN_GRADE, out, known)
        return out, known
