"""Normal maps: the relief of a dense mesh, on the texture of the mesh that was decimated from it.

Each texel looks along the normal of its mesh, to either side, for the dense mesh; the normal there stands in the map, in the tangent frame of
`efficientnerf.surface.texturing.tangents`: x where u grows, y where v grows (up, as in glTF, OpenGL and USD), z outward.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from efficientnerf.backends.numba.mesh.normals import count_in_cells, normals_met, put_in_cells
from efficientnerf.backends.pieces import pieces
from efficientnerf.surface.mesh import Mesh, Texture
from efficientnerf.surface.smoothing import smoothed_face_normals
from efficientnerf.surface.texturing.atlas import Atlas, Texels
from efficientnerf.surface.texturing.corners import split_at_seams
from efficientnerf.surface.texturing.filling import texture_from
from efficientnerf.surface.texturing.tangents import tangents

REACH = 8.0  # mean edges of the dense mesh, up to which it may be off
ROUNDS = 80  # of bilateral smoothing of its normals. docs/experiments/textures.md
SHARPNESS = 0.6  # difference of two unit normals beyond which faces hardly count for each other
CELL, MOST_CELLS = 2.0, 256  # mean edges on the side of a cell, in which its faces are found; cells along the longest side, at most
LEAST = 0.05  # of a normal's part along that of the mesh: else it would look into the surface


@dataclass(frozen=True, eq=False)
class Dense:
    """A mesh as it was before decimation: vertices (V, 3) of the training frame, faces (F, 3)."""

    vertices: np.ndarray
    faces: np.ndarray


def with_normal_map(mesh: Mesh, dense: Dense, tick: Callable[[], None] = lambda: None) -> Mesh:
    """A mesh with a texture, its normal map baked from a dense mesh of the same surface, and facts on that. `tick` is called often; an exception
    from it stops the work."""
    assert mesh.texture is not None
    size = len(mesh.texture.colours)
    places = mesh.texture.coordinates
    corners = np.stack([places[..., 0] * size, (1 - places[..., 1]) * size], -1)
    atlas = Atlas(corners, np.zeros(len(corners), np.int64), size, 1.0)
    pixels, met = normals_in_tangent_space(mesh, atlas.texels, dense, tick)
    facts = {"normal_map_met": float(f"{met.mean() if len(met) else 0.0:.4g}")}
    return replace(mesh, texture=Texture(places, mesh.texture.colours, texture_from(atlas, pixels)), facts=mesh.facts | facts)


def normals_in_tangent_space(mesh: Mesh, texels: Texels, dense: Dense, tick: Callable[[], None]) -> tuple[np.ndarray, np.ndarray]:
    """(T, 3) uint8 of the texels, and whether each has met the dense mesh (T,) bool; those that have not are flat."""
    split, frame = corner_frames(mesh)
    grid = _Grid.of(dense, tick)
    normals = dense_normals(dense, tick)
    out, met = np.empty((len(texels.place), 3), np.uint8), np.zeros(len(texels.place), bool)
    for part in pieces(len(out), first=4096):
        tick()
        point, normal = texels.values(mesh.vertices, mesh.faces, part), texels.values(mesh.normals, mesh.faces, part)
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        towards = normal / np.maximum(length, 1e-12)
        found = np.empty((len(point), 3))
        normals_met(point, towards, grid.reach, dense.vertices, dense.faces, normals, grid.low, grid.cell, grid.shape, grid.first, grid.held, found)
        met[part] = (found * towards).sum(1) > LEAST
        tangent = texels.values(frame[:, :3], split, part)
        sign = frame[split[texels.face[part], 0], 3:]
        matrix = np.stack([tangent, sign * np.cross(normal, tangent), normal], 2)  # (T, 3, 3): from tangent space
        inside = _solved(matrix, np.where(met[part, None], found, normal))
        out[part] = np.round(np.clip(0.5 + 0.5 * inside, 0, 1) * 255).astype(np.uint8)
    return out, met


def _solved(matrix: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """(N, 3) unit x with matrix @ x along the vectors, by Cramer's rule; straight up where the matrix is singular."""
    rows = [np.cross(matrix[:, :, 1], matrix[:, :, 2]), np.cross(matrix[:, :, 2], matrix[:, :, 0]), np.cross(matrix[:, :, 0], matrix[:, :, 1])]
    volume = (matrix[:, :, 0] * rows[0]).sum(1)
    found = np.stack([(row * vectors).sum(1) for row in rows], 1) * np.sign(volume)[:, None]
    length = np.linalg.norm(found, axis=1, keepdims=True)
    good = (np.abs(volume) > 1e-9)[:, None] & (length > 1e-12)
    return np.where(good, found / np.where(good, length, 1), [0.0, 0.0, 1.0])


def corner_frames(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Faces (F, 3) of vertices that are split where they have several texture coordinates, and their tangents with signs (N, 4)."""
    assert mesh.texture is not None
    split = split_at_seams(mesh)
    return split.faces, tangents(mesh.vertices[split.vertex], mesh.normals[split.vertex], split.coordinates.astype(np.float64), split.faces)


def dense_normals(dense: Dense, tick: Callable[[], None]) -> np.ndarray:
    """(V, 3) unit normals of the dense mesh's vertices: means of those of its faces, which are smoothed first."""
    faces = dense.faces
    normals, area = smoothed_face_normals(dense.vertices, faces, ROUNDS, SHARPNESS, tick)
    weighted = area[:, None] * normals
    total = np.stack([np.bincount(faces.ravel(), np.repeat(weighted[:, axis], 3), minlength=len(dense.vertices)) for axis in range(3)], 1)
    return np.asarray(total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-300))


@dataclass(frozen=True, eq=False)
class _Grid:
    """Cells of a dense mesh, and the faces whose boxes reach into each."""

    low: np.ndarray
    cell: float
    shape: np.ndarray
    first: np.ndarray
    held: np.ndarray
    reach: float

    @classmethod
    def of(cls, dense: Dense, tick: Callable[[], None]) -> _Grid:
        vertices, faces = dense.vertices, dense.faces
        edge = float(np.linalg.norm(vertices[faces[:, 1]] - vertices[faces[:, 0]], axis=1).mean())
        low, extent = vertices.min(0), np.ptp(vertices, 0)
        cell = max(CELL * edge, float(extent.max()) / MOST_CELLS)
        low, shape = low - 0.5 * cell, np.floor(extent / cell).astype(np.int64) + 2  # points on its border are inside
        first = np.zeros(int(shape.prod()) + 2, np.int64)
        for part in pieces(len(faces), first=4096):
            tick()
            count_in_cells(vertices, faces, part.start, part.stop, low, cell, shape, first)
        np.cumsum(first, out=first)
        held = np.empty(int(first[-1]), np.int32)
        for part in pieces(len(faces), first=4096):
            tick()
            put_in_cells(vertices, faces, part.start, part.stop, low, cell, shape, first, held)
        return cls(low, cell, shape, first, held, REACH * edge)
