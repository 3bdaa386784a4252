"""Preview of a mesh: orthographic views from four sides, coloured above, shaded grey below. And where it differs from the asset."""

from collections.abc import Sequence

import numpy as np

from efficientnerf.surface.agreement import AssetView, differences
from efficientnerf.surface.mesh import Mesh, face_vectors, sample
from efficientnerf.surface.rasteriser import MeshImage

_PAPER = np.array([0.93, 0.93, 0.93])
_SAMPLES = 600_000
SIZE = 420  # pixels of a side of `render_sides`
_MISSED, _ADDED = np.array([0.85, 0.15, 0.1]), np.array([0.1, 0.35, 0.9])
ROUND = (0.0, 90.0, 180.0, 270.0)
IN_FRONT = (-36.0, -12.0, 12.0, 36.0)  # of forward-facing captures


def render_sides(mesh: Mesh, *, heading: float, elevation: float, turns: Sequence[float] = ROUND, shown: float = 1.0) -> np.ndarray:
    """Orthographic views of a mesh in a frame with z up, from several sides.

    heading    degrees around z that the turns are counted from, from +x
    elevation  degrees above the horizon
    turns      degrees around z of each view
    shown      share of the vertices, nearest to the middle, that the views are fitted to
    returns    (2 SIZE, SIZE times the number of views, 3) uint8 sRGB

    The surface is splatted as a dense point cloud with a depth buffer.
    """
    face, weight = sample(mesh.vertices, mesh.faces, _SAMPLES, seed=0)
    corners = mesh.faces[face]  # (N, 3)
    positions = np.einsum("nci,nc->ni", mesh.vertices[corners], weight)
    normals = np.einsum("nci,nc->ni", mesh.normals[corners], weight)
    colours = np.einsum("nci,nc->ni", mesh.colours[corners], weight)
    if shown < 1:
        centre = np.median(mesh.vertices, axis=0)
        reach = float(np.quantile(np.linalg.norm(mesh.vertices - centre, axis=1), shown))
    else:
        centre = (mesh.vertices.min(0) + mesh.vertices.max(0)) / 2
        reach = float(np.linalg.norm(mesh.vertices - centre, axis=1).max())
    local = (positions - centre) / max(reach, 1e-12)
    near = (local**2).sum(axis=1) <= 1 + 1e-9
    columns = []
    for turn in turns:
        right, up, back = _axes(heading + turn, elevation)
        facing = np.flatnonzero((normals @ back > -0.2) & near)
        visible = local[facing]
        picked = _front_samples(visible @ right, visible @ up, visible @ back)  # (SIZE, SIZE), -1 where nothing is
        picked = np.where(picked >= 0, facing[picked], -1) if len(facing) else picked
        light = back + 0.5 * up - 0.4 * right
        shade = np.clip(normals @ (light / np.linalg.norm(light)), 0, 1) * 0.7 + 0.2
        hit = picked[..., None] >= 0
        columns.append(np.concatenate([np.where(hit, colours[picked], _PAPER), np.where(hit, shade[picked][..., None], _PAPER)]))
    return np.round(np.clip(np.concatenate(columns, 1), 0, 1) * 255).astype(np.uint8)


def _axes(heading: float, elevation: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Right, up and back (towards the viewer) of a view from this direction."""
    a, e = np.radians(heading), np.radians(elevation)
    right = np.array([-np.sin(a), np.cos(a), 0.0])
    back = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    return right, np.cross(back, right), back


def _front_samples(x: np.ndarray, y: np.ndarray, height: np.ndarray) -> np.ndarray:
    """(SIZE, SIZE) index of the sample nearest to the viewer in each pixel, of those with x and y in -1..1; -1: none."""
    order = np.argsort(height, kind="stable")
    column = ((x * 0.97 + 1) / 2 * (SIZE - 1)).astype(np.int64)[order]
    row = ((1 - y * 0.97) / 2 * (SIZE - 1)).astype(np.int64)[order]
    front = np.full((SIZE, SIZE), -1)
    # A sample covers two by two pixels, against holes where samples are sparse.
    for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)):
        last = np.full((SIZE, SIZE), -1)
        last[row + i, column + j] = np.arange(len(order))  # of several samples in a pixel the last stays
        front = np.maximum(front, last)
    return np.where(front >= 0, order[front], -1) if len(order) else front


def difference_row(mesh: Mesh, view: AssetView, image: MeshImage) -> np.ndarray:
    """(H, 3 W, 3) uint8 sRGB: the asset's opacity, the mesh under a light at the camera, and both with what is missed in red and what is added in blue."""
    vectors = face_vectors(mesh.vertices, mesh.faces)
    facing = np.abs(vectors @ view.camera.forward) / np.maximum(np.linalg.norm(vectors, axis=1), 1e-300)
    shade = np.where(image.covered, 0.15 + 0.75 * facing[image.face] if len(facing) else 0.0, _PAPER[0])[..., None].repeat(3, axis=2)
    opacity = (_PAPER[0] * (1 - view.opacity) + 0.2 * view.opacity)[..., None].repeat(3, axis=2)
    missed, added = differences(view, image)
    marked = np.where(missed[..., None], _MISSED, np.where(added[..., None], _ADDED, 0.5 + 0.5 * shade))
    return np.round(np.clip(np.concatenate([opacity, shade, marked], axis=1), 0, 1) * 255).astype(np.uint8)
