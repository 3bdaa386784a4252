"""Vertices of a surface moved to the edges that photographs have along its contours. docs/experiments/surface.md

Fusing, smoothing and decimating round off edges and make thin parts thick, and where one part of a surface hides another no silhouette of the asset shows it.
There a photograph changes from the colours of the one to those of the other: the place where that fits best is sought across the contour. A vertex moves along
its normal by what photographs say, two of them at least, and takes its neighbours along. All stay if contours are no nearer to the edges afterwards.

V vertices, F faces, N vertices on contours of a photograph, S samples across each.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import map_coordinates

from efficientnerf.geometry.cameras import project, resized
from efficientnerf.surface.fitting.photometric import MAX_PIXELS
from efficientnerf.surface.mesh import vertex_normals
from efficientnerf.surface.rasteriser import mesh_image
from efficientnerf.surface.smoothing import settled, vertex_neighbours
from efficientnerf.surface.texturing.photographs import Photograph, colours_seen

# docs/experiments/surface.md
ROUNDS = 2
FINER = 2  # pixels of the surface's image to one of a photograph, along a side
GRAZING = 0.35  # cosine between a normal and a ray, below which a vertex may be on a contour
STEP = 0.5  # pixels from a sample to the next
ACROSS = np.arange(-8, 9) * STEP  # pixels outward from a vertex, where a photograph is sampled
NEAR = 1.5  # pixels from a vertex, within which its contour is sought; and from the contour on either side to where the surface has the colours of that side
JUMP = 0.01  # of the depth, that at least lies between a contour and what it hides
CONTRAST = 20 / 255  # difference between the colours of the two sides that counts half
WITNESSES, LEAST_WEIGHT = 2, 1.2  # photographs that have to show a vertex on a contour, and their weights together
STAY, STIFF, SWEEPS = 2.0, 10.0, 40  # weights of staying and of an edge; sweeps over all vertices


@dataclass(frozen=True)
class ContourFit:
    """Vertices moved to edges of photographs."""

    vertices: np.ndarray
    # before, after: mean distance of contours from the photographs' edges, pixels; nan where there are none
    before: float
    after: float
    improved: bool  # whether the vertices were moved


def fitted_to_contours(
    vertices: np.ndarray, faces: np.ndarray, colours: np.ndarray, photographs: Callable[[], Iterable[Photograph]], tick: Callable[[], None] = lambda: None
) -> ContourFit:
    """A surface of the world with vertices (V, 3) of sRGB colours (V, 3), 0-1, moved so that its contours lie at edges of photographs.

    photographs  gives them one after the other, each time that it is called
    tick         is called before each; what it raises stops the work
    """
    edges = vertex_neighbours(faces, len(vertices))
    face_colours = _photographed(vertices, faces, colours, photographs(), tick)[faces].mean(axis=1)
    fitted, distances = vertices, []
    for number in range(ROUNDS + 1):
        normals = vertex_normals(fitted, faces)
        sums, witnesses, apart = np.zeros((len(vertices), 2)), np.zeros(len(vertices), np.int64), np.zeros(2)
        for photo in photographs():
            tick()
            at, pixels, weight, size = _offsets(fitted, faces, normals, face_colours, photo.reduced(MAX_PIXELS))
            sums[at] += np.stack([weight * pixels * size, weight], 1)
            witnesses[at] += weight > 0
            apart += (weight * np.abs(pixels)).sum(), weight.sum()
        distances.append(float(apart[0] / apart[1]) if apart[1] > 0 else float("nan"))
        if number == ROUNDS or not apart[1] > 0:
            break
        sums[(witnesses < WITNESSES) | (sums[:, 1] < LEAST_WEIGHT)] = 0
        move = settled(np.zeros(len(vertices)), sums[:, 0], sums[:, 1], edges, STIFF, STAY, SWEEPS, tick)
        fitted = fitted + move[:, None] * normals
    improved = distances[-1] < distances[0]
    return ContourFit(fitted if improved else vertices, distances[0], distances[-1], improved)


def _photographed(vertices: np.ndarray, faces: np.ndarray, colours: np.ndarray, photographs: Iterable[Photograph], tick: Callable[[], None]) -> np.ndarray:
    """(V, 3) mean colours that photographs show at vertices; the given ones (V, 3) where none shows any. Those of an asset differ from photographs'."""
    normals, sums, total = vertex_normals(vertices, faces), np.zeros((len(vertices), 3)), np.zeros((len(vertices), 1))
    for photo in photographs:
        at, seen, weight = colours_seen(vertices, faces, normals, photo.reduced(MAX_PIXELS), tick)
        sums[at] += weight[:, None] * seen
        total[at] += weight[:, None]
    return np.where(total > 0, sums / np.maximum(total, 1e-12), colours)


def _offsets(vertices: np.ndarray, faces: np.ndarray, normals: np.ndarray, face_colours: np.ndarray, photo: Photograph) -> tuple[np.ndarray, ...]:
    """Vertices on contours (N,), pixels that the photograph's edge lies outward of each contour, how much that counts, 0 to 1, and the side of a pixel there,
    world units."""
    camera = photo.camera
    pixels, depth = project(camera, vertices)
    towards = vertices - camera.centre
    cosine = (towards * normals).sum(1) / np.linalg.norm(towards, axis=1)
    margin = ACROSS[-1] + 1
    inside = ((pixels >= margin) & (pixels <= [camera.width - margin, camera.height - margin])).all(1)
    at = np.flatnonzero((np.abs(cosine) < GRAZING) & (depth > 0) & inside)
    size = depth[at] / camera.intrinsics["fx"]
    outward = project(camera, vertices[at] + 0.5 * size[:, None] * normals[at])[0] - pixels[at]
    outward = np.nan_to_num(outward / np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-9))  # nan beyond what the lens shows
    places = pixels[at, None] + ACROSS[:, None] * outward[:, None]  # (N, S, 2)
    image = mesh_image(vertices, faces, resized(camera, FINER * camera.width, FINER * camera.height))
    column, row = np.moveaxis((FINER * places).astype(np.int64), -1, 0)
    contour, found = _contours(image.depth[row, column], depth[at])
    at, size, places, contour = at[found], size[found], places[found], contour[found]
    face = image.face[row[found], column[found]]
    between = (places[..., 1] - 0.5, places[..., 0] - 0.5)
    seen = np.stack([map_coordinates(photo.colours[..., channel], between, np.float64, order=1, mode="nearest") for channel in range(3)], -1) / 255
    edge, weight = _edges(seen, np.where((face >= 0)[..., None], face_colours[face], np.nan), contour)
    column, row = np.moveaxis(places.astype(np.int64), -1, 0)
    return at, edge - contour, np.where(photo.usable[row, column].all(axis=1), weight, 0.0), size


def _contours(near: np.ndarray, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(N,) pixels outward from vertices at depths (N,) to contours that they lie on, by the surface's depths across these (N, S); and whether there are any."""
    own, behind = np.abs(near - depth[:, None]) < JUMP * depth[:, None], near > (1 + JUMP) * depth[:, None]
    ends = own[:, :-1] & behind[:, 1:] & (np.abs(ACROSS[:-1]) <= NEAR)
    last = ends.shape[1] - 1 - ends[:, ::-1].argmax(axis=1)
    return ACROSS[last] + STEP / 2, ends.any(axis=1)


def _edges(seen: np.ndarray, surface: np.ndarray, contour: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(N,) pixels outward from vertices to a photograph's edges, and how much each counts, 0 to 1.

    seen     (N, S, 3) colours of the photograph
    surface  (N, S, 3) those of the surface, nan where there is none
    contour  (N,) pixels outward to the contours
    """
    rows, last = np.arange(len(seen)), len(ACROSS) - 1
    inner, outer = (np.clip(np.rint((contour + shift - ACROSS[0]) / STEP).astype(np.int64), 0, last) for shift in (-NEAR, NEAR))
    front, back = surface[rows, inner], surface[rows, outer]
    back = np.where(np.isnan(back), seen[:, -1], back)  # beyond the surface: what the photograph has there
    contrast = np.square(front - back).sum(axis=1)
    away, known = ACROSS - contour[:, None], ~np.isnan(surface[..., 0])
    sides = ((away <= -NEAR, front), (away >= NEAR, back))
    expected = (np.where((there & known)[..., None], surface, colour[:, None]) for there, colour in sides)
    front_error, back_error = (np.minimum(np.square(seen - colour).sum(axis=-1), contrast[:, None]) for colour in expected)
    cost = np.pad(np.cumsum(front_error - back_error, axis=1), ((0, 0), (1, 0)))  # of an edge before each sample, and after the last
    best = cost.argmin(axis=1)
    depth = STEP * (np.minimum(cost[:, 0], cost[:, -1]) - cost[rows, best])
    clear = np.clip(np.divide(depth, contrast, out=np.zeros(len(cost)), where=contrast > 1e-4), 0, 1)
    weight = np.where((best > 0) & (best <= last), clear * contrast / (contrast + CONTRAST**2), 0.0)
    return ACROSS[0] + STEP * (best - 0.5), np.nan_to_num(weight)
