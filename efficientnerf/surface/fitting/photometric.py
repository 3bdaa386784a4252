"""Vertices of a surface moved along their normals to where photographs agree on them. docs/experiments/surface.md

An asset's density says within a voxel or two where a surface is; photographs from two sides say it within a fraction of a pixel. The patch around a vertex is
compared in the photographs that show it, at offsets along its normal: where they agree best is the surface. Offsets are smoothed where photographs say
little (plain or glossy parts), and what they do not show moves with what is next to it. No single photograph decides: a vertex needs three of them, and
what its neighbours contradict does not count. Vu et al., "High accuracy and
visibility-consistent dense multiview stereo", TPAMI 2012; Goesele et al., "Multi-view stereo for community photo collections", ICCV 2007.

C photographs, V vertices, F faces, K places for photographs of each vertex, S offsets.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from efficientnerf.backends.numba.mesh.photometric import agreement, choose
from efficientnerf.backends.pieces import pieces
from efficientnerf.geometry.cameras import Camera, project
from efficientnerf.surface.mesh import vertex_normals
from efficientnerf.surface.smoothing import settled, vertex_neighbours
from efficientnerf.surface.texturing.photographs import Photograph, shown_vertices

# docs/experiments/surface.md
PLACES = 6  # photographs that a vertex is compared in
OFFSETS = 13
STEP = 0.5  # pixels that the patch moves from an offset to the next in the photograph with the second widest angle
MAX_PIXELS = 2**21  # pixels of a photograph: larger ones are halved
APART, WIDEST = np.radians(8), np.radians(60)  # between views of a vertex: from the first they count in full, up to the second at all
LEAST_PARALLAX = 0.1  # pixels that a patch moves with a pixel along the normal
NOISE = 2.0  # of 255: deviation of a patch that shows nothing
TEXTURED = 4.0  # of 255: deviation of a patch that counts half
PEAK, SCORE = 0.15, (0.3, 0.8)  # how far the best score has to be above the median, and what it has to be, to count in full
STIFF, STAY = 0.5, 0.01  # weights of an edge and of staying
SWEEPS, REWEIGHTED = 40, 3  # of smoothing offsets, and how often outliers are weighted down
FARTHEST = 10.0  # pixels that a vertex moves
AROUND = 8  # seen vertices, that one moves with which no photograph shows
FEWEST = 100  # seen vertices


@dataclass(frozen=True)
class PhotometricRefinement:
    """Vertices moved to where photographs agree."""

    vertices: np.ndarray
    seen: float  # share of them that three photographs show
    # before, after: mean agreement of the photographs (normalised cross-correlation, -1 to 1) where these show anything
    before: float
    after: float
    improved: bool  # whether the vertices were moved


def refined(vertices: np.ndarray, faces: np.ndarray, photographs: Iterable[Photograph], tick: Callable[[], None] = lambda: None) -> PhotometricRefinement:
    """A surface of the world fitted to photographs; as it was where they agree no better on the new one. `tick` is called often; what it raises stops it."""
    normals = vertex_normals(vertices, faces)
    cameras: list[Camera] = []
    grades, greys = [], []
    for photo in photographs:
        photo = photo.reduced(MAX_PIXELS)
        cameras.append(photo.camera)
        grades.append(shown_vertices(vertices, faces, normals, photo, tick))
        red, green, blue = np.moveaxis(photo.colours.astype(np.uint32), -1, 0)
        greys.append(((77 * red + 150 * green + 29 * blue + 128) >> 8).astype(np.uint8))  # luma (ITU-R BT.601)
    unmoved = PhotometricRefinement(vertices, 0.0, 0.0, 0.0, False)
    if len(cameras) < 3:
        return unmoved
    chosen = np.full((len(vertices), PLACES), -1, np.int32)
    choose(vertices, np.array([camera.centre for camera in cameras]), np.array(grades), APART, WIDEST, chosen)
    seen = chosen[:, 2] >= 0
    if seen.sum() < FEWEST:
        return unmoved
    search = _Search(faces, cameras, greys, chosen, tick)
    before, weight = search.agreement(vertices)
    moved = search.moved(vertices)
    after, _ = search.agreement(moved)
    means = [float((each * weight).sum() / max(weight.sum(), 1e-12)) for each in (before, after)]
    improved = means[1] > means[0]
    return PhotometricRefinement(moved if improved else vertices, float(seen.mean()), means[0], means[1], improved)


@dataclass(eq=False)
class _Search:
    """faces (F, 3), cameras (C), greys (C) of (H, W) uint8, and the photographs chosen for each vertex (V, K)."""

    faces: np.ndarray
    cameras: list[Camera]
    greys: list[np.ndarray]
    chosen: np.ndarray
    tick: Callable[[], None]

    def __post_init__(self) -> None:
        self.seen = self.chosen[:, 2] >= 0
        self.starts = np.cumsum([0, *(grey.size for grey in self.greys[:-1])]).astype(np.int64)
        self.shapes = np.array([grey.shape for grey in self.greys], np.int64)
        self.pixels = np.concatenate([grey.ravel() for grey in self.greys])
        self.edges = vertex_neighbours(self.faces, len(self.chosen))

    def agreement(self, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(V,) how well the photographs agree on vertices as they are, and what that counts."""
        places = self._places(vertices, vertex_normals(vertices, self.faces))
        score, weight = self._scores(places, _pixel(places[:, 0]), np.zeros(len(vertices)), 1)
        return score[:, 0], weight

    def moved(self, vertices: np.ndarray) -> np.ndarray:
        """(V, 3) vertices where the photographs agree on them."""
        normals = vertex_normals(vertices, self.faces)
        places = self._places(vertices, normals)
        pixel = _pixel(places[:, 0])
        widest = np.sort(_parallax(places, self.chosen), axis=1)[:, -2]
        known = self.seen & (widest * pixel > LEAST_PARALLAX)
        step = np.where(known, STEP / np.maximum(widest, 1e-12), 0.0)
        score, weight = self._scores(places, pixel, step, OFFSETS)
        weight[~known] = 0.0
        best, confidence = self._best(score, weight)
        offset = self._smoothed(best, confidence) * step
        move = np.clip(offset, -FARTHEST * pixel, FARTHEST * pixel)[:, None] * normals
        rest = ~known
        if known.any() and rest.any():
            distance, near = cKDTree(vertices[known]).query(vertices[rest], k=min(AROUND, int(known.sum())))
            share = 1 / np.maximum(distance.reshape(len(near), -1), 1e-12) ** 2
            move[rest] = (move[known][near.reshape(share.shape)] * share[..., None]).sum(1) / share.sum(1, keepdims=True)
        return np.asarray(vertices + move)

    def _places(self, vertices: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """(V, K, 8) float32 as `agreement` reads them."""
        helper = np.where(np.abs(normals[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
        along = np.cross(normals, helper)
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        axes = normals, along, np.cross(normals, along)
        out = np.zeros((*self.chosen.shape, 8), np.float32)
        for number, camera in enumerate(self.cameras):
            self.tick()
            vertex, place = np.nonzero(self.chosen == number)
            at = vertices[vertex]
            unit = np.linalg.norm(at - camera.centre, axis=1, keepdims=True) / camera.intrinsics["fx"]
            middle = project(camera, at)[0] - 0.5
            changes = [(project(camera, at + unit * axis[vertex])[0] - project(camera, at - unit * axis[vertex])[0]) / (2 * unit) for axis in axes]
            out[vertex, place] = np.concatenate([middle, *changes], axis=1)
        return out

    def _scores(self, places: np.ndarray, pixel: np.ndarray, step: np.ndarray, offsets: int) -> tuple[np.ndarray, np.ndarray]:
        """Scores (V, S), and what each counts (V,)."""
        score, texture = np.zeros((len(places), offsets), np.float32), np.zeros(len(places), np.float32)
        for part in pieces(len(places), first=4096):
            self.tick()
            agreement(
                part.start, part.stop, self.chosen, places, pixel.astype(np.float32), step.astype(np.float32), self.pixels, self.starts, self.shapes,
                np.float32(NOISE), score, texture,
            )  # fmt: skip
        return score, np.where(self.seen & (score.max(axis=1) > 0), texture**2 / (texture**2 + TEXTURED**2), 0.0)

    def _best(self, score: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(V,) the best offset, in steps, of a parabola through the best score and those next to it, and how far it can be trusted: zero at either end."""
        last, rows = score.shape[1] - 1, np.arange(len(score))
        top = score.argmax(axis=1)
        at = np.clip(top, 1, last - 1)
        left, best, right = (score[rows, at + shift] for shift in (-1, 0, 1))
        bend = left - 2 * best + right
        inner = np.divide(0.5 * (left - right), bend, out=np.zeros(len(score)), where=np.abs(bend) > 1e-9)
        trust = np.clip((best - np.median(score, axis=1)) / PEAK, 0, 1) * np.clip((best - SCORE[0]) / (SCORE[1] - SCORE[0]), 0, 1)
        return at - last // 2 + np.clip(inner, -0.5, 0.5), np.where((top > 0) & (top < last), weight * trust**2, 0.0)

    def _smoothed(self, best: np.ndarray, confidence: np.ndarray) -> np.ndarray:
        """(V,) offsets, in steps, near the best where that can be trusted and near those of the neighbours elsewhere; what these contradict counts less
        (Geman-McClure)."""
        out, own = np.zeros(len(best)), confidence
        for _ in range(REWEIGHTED + 1):
            out = settled(out, own * best, own, self.edges, STIFF, STAY, SWEEPS, self.tick)
            own = confidence / (1 + (best - out) ** 2) ** 2
        return out


def _pixel(first: np.ndarray) -> np.ndarray:
    """(V,) side of a pixel on the plane across the normal, from places (V, 8) in the first photograph; zero where there is none."""
    area = np.abs(first[:, 4] * first[:, 7] - first[:, 5] * first[:, 6]).astype(np.float64)
    return np.where(area > 0, 1 / np.sqrt(np.where(area > 0, area, 1)), 0.0)


def _parallax(places: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """(V, K) pixels that each photograph's patch moves against the first one's with a unit along the normal."""
    first = places[:, 0].astype(np.float64)
    area = first[:, 4] * first[:, 7] - first[:, 5] * first[:, 6]
    area = np.where(np.abs(area) > 1e-12, area, 1.0)
    a = (first[:, 2] * first[:, 7] - first[:, 3] * first[:, 6]) / area  # the way across the normal that looks the same in the first
    b = (first[:, 3] * first[:, 4] - first[:, 2] * first[:, 5]) / area
    apart = places[..., 2:4] - a[:, None, None] * places[..., 4:6] - b[:, None, None] * places[..., 6:8]
    return np.where(chosen >= 0, np.linalg.norm(apart, axis=2), 0.0)
