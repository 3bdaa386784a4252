"""Images of meshes in their own colours, unlit: those of a texture, or of the vertices. Plain sampling, several samples a pixel.

H x W pixels, s x s samples in each.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from efficientnerf.backends.numba.mesh.shade import shade
from efficientnerf.backends.pieces import pieces
from efficientnerf.geometry.cameras import Camera, project, resized, rows_of
from efficientnerf.surface.mesh import Mesh, Texture, face_areas, texture_colours
from efficientnerf.surface.rasteriser import MeshImage, mesh_image

SAMPLES = 4  # along each side of a pixel. docs/experiments/textures.md
AT_ONCE = 2**22  # samples: more of an image are drawn in bands of rows
FIRST_ROWS = 16  # in the first piece


@dataclass(frozen=True, eq=False)
class ColouredImage:
    """What a camera sees of a mesh."""

    colour: np.ndarray  # (H, W, 3) float32 sRGB 0-1, premultiplied by the coverage
    covered: np.ndarray  # (H, W) float32, share of each pixel's samples that show the mesh
    depth: np.ndarray  # (H, W) float32 along the view axis of the nearest of them, infinite where there is none


def pyramid_of(texture: Texture) -> tuple[np.ndarray, np.ndarray]:
    """A texture at full size and at halves of it, down to a texel: texels (T, 3) uint8, and of each level first texel, width and height (L, 3). They are
    means of squares of four; at sides of an odd length the last texel counts twice."""
    parts, at = [], np.asarray(texture.colours)
    while True:
        parts.append(at)
        if max(at.shape[:2]) == 1:
            break
        even = np.pad(at, ((0, at.shape[0] % 2), (0, at.shape[1] % 2), (0, 0)), mode="edge")
        total = even[0::2, 0::2].astype(np.uint16)
        for y, x in ((0, 1), (1, 0), (1, 1)):
            total += even[y::2, x::2]
        at = ((total + 2) // 4).astype(np.uint8)
    first = np.cumsum([0, *(part.shape[0] * part.shape[1] for part in parts)])
    levels = [(start, part.shape[1], part.shape[0]) for start, part in zip(first, parts)]
    return np.concatenate([part.reshape(-1, 3) for part in parts]), np.array(levels, np.int64)


NO_TEXTURE = np.zeros((0, 3, 2)), np.zeros((0, 3), np.uint8), np.zeros((0, 3), np.int64)  # as the kernel takes it


class Shader:
    """Draws a mesh from many cameras: from its texture, and from the colours of its vertices."""

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh
        self.colours = np.ascontiguousarray(mesh.colours, np.float32)
        self.faces = np.ascontiguousarray(mesh.faces, np.int64)
        texture = mesh.texture
        self.texture = NO_TEXTURE if texture is None else (np.ascontiguousarray(texture.coordinates, np.float64), *pyramid_of(texture))

    def images(self, camera: Camera, samples: int = SAMPLES) -> tuple[ColouredImage, ColouredImage]:
        """The mesh in the colours of its texture (of its vertices, where it has none), and in those of its vertices."""
        fine = resized(camera, camera.width * samples, camera.height * samples)
        rows = max(1, AT_ONCE // (samples**2 * camera.width)) * samples
        bands, kinds = [], (False,) if self.mesh.texture is None else (False, True)
        for begin in range(0, fine.height, rows):
            band = rows_of(fine, begin, min(begin + rows, fine.height))
            pixels, depth = project(band, self.mesh.vertices)
            seen = mesh_image(self.mesh.vertices, self.faces, band)
            bands.append([self._shaded(seen, pixels, depth, samples, textured=textured) for textured in kinds])
        images = [ColouredImage(*map(np.concatenate, zip(*(vars(band).values() for band in parts), strict=True))) for parts in zip(*bands, strict=True)]
        return images[-1], images[0]

    def _shaded(self, seen: MeshImage, pixels: np.ndarray, depth: np.ndarray, samples: int, *, textured: bool) -> ColouredImage:
        height, width = (side // samples for side in seen.face.shape)
        colour = np.zeros((height, width, 3), np.float32)
        for part in pieces(height, first=FIRST_ROWS):
            shade(pixels, depth, self.faces, *(self.texture if textured else NO_TEXTURE), self.colours, seen.face, part.start, part.stop, colour)
        colour *= np.float32(1 / (samples**2 * (255 if textured else 1)))
        covered = _over_samples(seen.covered, samples)
        nearest = _over_samples(seen.depth, samples)
        return ColouredImage(np.clip(colour, 0, 1), covered.mean(2, dtype=np.float32), nearest.min(2))


def _over_samples(values: np.ndarray, samples: int) -> np.ndarray:
    """(H s, W s) -> (H, W, s * s)."""
    height, width = (side // samples for side in values.shape)
    return values.reshape(height, samples, width, samples).transpose(0, 2, 1, 3).reshape(height, width, -1)


def vertex_colours(mesh: Mesh, parts: int = 3) -> np.ndarray:
    """(V, 3) float32 sRGB colours of the vertices that come nearest to the mesh's texture: its means round each vertex, weighted by area and by how much the
    vertex counts there. Vertices without a face keep theirs. `parts`: places along a side of each face."""
    assert mesh.texture is not None

    area = face_areas(mesh.vertices, mesh.faces)
    sums, total = np.zeros((len(mesh.vertices), 3)), np.zeros(len(mesh.vertices))
    for weight in _places(parts):
        at = np.einsum("k,fkc->fc", weight, mesh.texture.coordinates)
        colour = texture_colours(mesh.texture, at)
        for corner in range(3):
            share = weight[corner] * area
            total += np.bincount(mesh.faces[:, corner], share, minlength=len(total))
            for channel in range(3):
                sums[:, channel] += np.bincount(mesh.faces[:, corner], share * colour[:, channel], minlength=len(total))
    found = sums / np.where(total > 0, total, 1)[:, None]
    return np.where((total > 0)[:, None], found, mesh.colours).astype(np.float32)


def _places(parts: int) -> Iterator[np.ndarray]:
    """Barycentric weights (3,) of the middles of the small triangles that a triangle is cut into, `parts` along a side."""
    for i in range(parts):
        for j in range(parts - i):
            yield np.array([i + 1 / 3, j + 1 / 3, parts - i - j - 2 / 3]) / parts
            if i + j < parts - 1:
                yield np.array([i + 2 / 3, j + 2 / 3, parts - i - j - 4 / 3]) / parts
