"""Vertices of a surface moved to where views of its asset end. docs/experiments/surface.md

Fusing and smoothing round off edges and thin parts, so that the silhouettes of a surface lie inside of those of its asset. At a vertex on the surface's
silhouette in a view, the two differ by some pixels. The vertex moves by the mean of that over the views along its normal, where the surface is
sharply curved: where it is flat the depths of views are more accurate.

V vertices, F faces, H x W pixels.
"""

from collections.abc import Callable, Sequence

import cv2
import numpy as np
from scipy.ndimage import map_coordinates

from efficientnerf.geometry.cameras import Camera, project, resized
from efficientnerf.surface.agreement import OPAQUE, AssetView
from efficientnerf.surface.mesh import vertex_normals
from efficientnerf.surface.rasteriser import mesh_image
from efficientnerf.surface.smoothing import vertex_neighbours

# docs/experiments/surface.md
ROUNDS = 2
FINER = 2  # pixels of silhouettes to one of the views, along a side
NEAR = 1.0  # pixels of a view from the surface's silhouette, up to which a vertex is on it
REACH = 3.0  # pixels from the asset's, up to which the two are the same edge
GRAZING = 0.35  # cosine between a normal and a ray, below which a vertex may be on a silhouette
SPREAD = 12  # rounds of averaging over neighbours
STAY_WEIGHT = 1.0  # weight of staying, in views
CURVED = (0.97, 0.85)  # length of the mean normal around a vertex: down to the first it is flat and stays, from the second on it is sharply curved


def fitted_to_silhouettes(
    vertices: np.ndarray, faces: np.ndarray, views: Sequence[AssetView], tick: Callable[[], None] = lambda: None
) -> np.ndarray:
    """(V, 3) the vertices (V, 3) of the world of faces (F, 3), moved to the silhouettes that views by pinhole cameras have of their asset. `tick` is called
    before each view; an exception from it stops the work."""
    edges = [(view.camera, edge) for view in views if (edge := _asset_edge(view)) is not None]
    if not edges or not len(faces):
        return vertices
    neighbours, degree = vertex_neighbours(faces, len(vertices))

    def spread(values: np.ndarray) -> np.ndarray:
        for _ in range(SPREAD):
            values = 0.5 * values + 0.5 * (neighbours @ values) / degree
        return values

    for _ in range(ROUNDS):
        normals = vertex_normals(vertices, faces)
        sums = np.zeros((len(vertices), 2))  # of moves, and of views
        for camera, edge in edges:
            tick()
            at, move = _moves(vertices, faces, normals, camera, edge)
            sums[at] += np.stack([move, np.ones(len(at))], 1)
        curved = np.clip((CURVED[0] - np.linalg.norm(spread(normals), axis=1)) / (CURVED[0] - CURVED[1]), 0, 1)
        move, weight = spread(sums).T
        vertices = vertices + (curved * move / (weight + STAY_WEIGHT))[:, None] * normals
    return vertices


def _moves(vertices: np.ndarray, faces: np.ndarray, normals: np.ndarray, camera: Camera, edge: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices on the surface's silhouette in a view, and how far outward (N,) the asset's lies there, in units of the world. `edge`: of `_asset_edge`."""
    pixels, depth = project(camera, vertices)
    towards = vertices - camera.centre
    cosine = (towards * normals).sum(1) / np.linalg.norm(towards, axis=1)
    inside = ((pixels >= 1) & (pixels <= [camera.width - 1, camera.height - 1])).all(1)
    at = np.flatnonzero((np.abs(cosine) < GRAZING) & (depth > 0) & inside)
    own = distance_inside(mesh_image(vertices, faces, resized(camera, FINER * camera.width, FINER * camera.height)).covered)
    if own is None or not len(at):
        return at[:0], np.zeros(0)
    places = (FINER * pixels[at, ::-1] - 0.5).T
    mine, others = (map_coordinates(distance, places, order=1, mode="nearest") / FINER for distance in (own, edge))
    same = (np.abs(mine) <= NEAR) & (np.abs(others) <= REACH)
    return at[same], (others - mine)[same] * depth[at[same]] / camera.intrinsics["fx"]


def _asset_edge(view: AssetView) -> np.ndarray | None:
    """`distance_inside` of the asset's silhouette, FINER times as many pixels along a side: its opacity is interpolated between pixels."""
    rows, columns = ((np.arange(FINER * side) + 0.5) / FINER - 0.5 for side in view.opacity.shape)
    return distance_inside(map_coordinates(view.opacity, np.meshgrid(rows, columns, indexing="ij"), order=1, mode="nearest") >= OPAQUE)


def distance_inside(mask: np.ndarray) -> np.ndarray | None:
    """(H, W) float32 pixels from the edge of a silhouette, positive inside; None where it has no edge."""
    if mask.all() or not mask.any():
        return None
    inside, outside = (cv2.distanceTransform(part.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE) for part in (mask, ~mask))
    # OpenCV's roots differ in the last bit from call to call; their squares are whole.
    distance = np.sqrt(np.rint(np.square(inside + outside, dtype=np.float64)))  # one of the two is zero
    return np.where(mask, distance - 0.5, 0.5 - distance).astype(np.float32)
