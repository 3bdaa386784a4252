"""Meshes, cameras round them, and photographs of them in colours that are known."""

from collections.abc import Callable

import numpy as np
import trimesh

from efficientnerf.geometry.cameras import Camera, rays
from efficientnerf.surface.mesh import vertex_normals
from efficientnerf.surface.rasteriser import MeshImage, mesh_image
from efficientnerf.surface.texturing.atlas import Atlas, atlas_of
from efficientnerf.surface.texturing.photographs import Photograph, PhotographTexture, exposed_alike, survey
from tests.poses import looking_at

Colours = Callable[[np.ndarray], np.ndarray]


def ball(subdivisions: int = 3) -> tuple[np.ndarray, np.ndarray]:
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions)
    return np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)


def box(extents: tuple[float, float, float] = (1.4, 1.0, 0.8)) -> tuple[np.ndarray, np.ndarray]:
    """With corners of their own for each side, so that normals at vertices are those of the sides."""
    mesh = trimesh.creation.box(extents)
    side = np.abs(mesh.face_normals).argmax(1) * 2 + (mesh.face_normals.sum(1) > 0)
    rows = np.concatenate([np.repeat(side, 3)[:, None], np.asarray(mesh.triangles).reshape(-1, 3)], 1)
    corners, faces = np.unique(rows, axis=0, return_inverse=True)
    return corners[:, 1:].copy(), faces.reshape(12, 3).astype(np.int64)


def pattern(points: np.ndarray) -> np.ndarray:
    """(N, 3) sRGB 0-1, smooth."""
    return 0.5 + 0.35 * np.sin(4 * points + [0.3, 1.1, 2.0])


def cameras(count: int = 8, size: int = 96, distance: float = 3.2) -> list[Camera]:
    out = []
    for number in range(count):
        turn, height = 2.4 * number, 2 * (number + 0.5) / count - 1
        centre = distance * np.array([np.sqrt(1 - height**2) * np.cos(turn), np.sqrt(1 - height**2) * np.sin(turn), height])
        out.append(Camera(f"{number}", size, size, "SIMPLE_RADIAL", (1.1 * size, size / 2, size / 2, -0.03), looking_at(centre)))
    return out


def shown_points(image: MeshImage, camera: Camera) -> np.ndarray:
    """(M, 3) world points of the pixels that show a face, row by row."""
    y, x = np.nonzero(image.covered)
    origins, directions = rays(camera, np.stack([x, y], -1) + 0.5)
    return np.asarray(origins + (image.depth[image.covered] / (directions @ camera.forward))[:, None] * directions)


def photographed(vertices: np.ndarray, faces: np.ndarray, camera: Camera, colours: Colours = pattern, behind: float = 1.0) -> Photograph:
    """What a camera sees of a mesh whose colours depend on the place."""
    image = mesh_image(vertices, faces, camera)
    pixels = np.full((camera.height, camera.width, 3), behind)
    pixels[image.covered] = colours(shown_points(image, camera))
    return Photograph(camera, np.round(255 * pixels).astype(np.uint8), np.ones(image.face.shape, bool))


def textured(
    vertices: np.ndarray, faces: np.ndarray, photos: list[Photograph], size: int = 128, expected: tuple[int, int, int] | None = None
) -> tuple[Atlas, np.ndarray, np.ndarray]:
    """The atlas, colours (T, 3) of its texels 0-1 and how much of each is from photographs. What is expected: the pattern, dull; gains against the pattern."""
    normals = vertex_normals(vertices, faces)
    surveys = exposed_alike([survey(vertices, faces, normals, pattern(vertices), photo) for photo in photos])
    atlas = atlas_of(vertices, faces, np.inf, size)
    density = np.max([each.density for each in surveys], axis=0)
    texels = PhotographTexture(vertices, faces, normals, atlas, density, float(np.median([each.sharpness for each in surveys])))
    for photo, each in zip(photos, surveys, strict=True):
        texels.look(photo, each)
    prior = np.round(64 + 127 * pattern(atlas.texels.values(vertices, faces))) if expected is None else np.array(expected)
    colours, known = texels.colours(np.ascontiguousarray(np.broadcast_to(prior, (len(atlas.texels.place), 3)), np.uint8))
    return atlas, colours / 255, known
