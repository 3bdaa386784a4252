"""Shared by all exporters: the frame that a file's numbers are in, the checks before, and writing."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from efficientnerf.geometry.cameras import Similarity
from efficientnerf.geometry.orbit import stated_up
from efficientnerf.surface.mesh import Mesh, PointCloud
from pipeline.errors import BadInput
from pipeline.files import atomic, atomic_together

MOST_TEXELS = 16384  # along a side of a texture: what graphics cards show
_ROWS = 50_000  # lines of text made at a time


@dataclass(frozen=True, eq=False)
class SourceFrame:
    """The capture's frame, in which meshes and points are handed to exporters."""

    world_from_capture: Similarity  # to the training frame
    metric: bool = False  # whether a unit is known to be a metre
    set_up: np.ndarray | None = None  # (3,) unit, the direction that someone set to be up; None: the training frame's z

    @property
    def up(self) -> np.ndarray:
        """(3,) unit, the direction in the capture's frame that is up."""
        return self.world_from_capture.rotation.T @ np.array([0.0, 0.0, 1.0]) if self.set_up is None else self.set_up

    @property
    def unit(self) -> str:
        return "metre" if self.metric else "unknown"

    @property
    def comment(self) -> str:
        """For files that have a place for one."""
        return f"frame of the capture; up {' '.join(f'{value:.9g}' for value in self.up + 0.0)}; unit {self.unit}"


CAPTURE_IS_Z_UP = SourceFrame(Similarity.identity())


def source_frame(metadata: Mapping[str, Any]) -> SourceFrame:
    """The capture's frame as an asset's metadata records it."""
    recorded, similarity = metadata.get("world_from_capture"), Similarity.identity()
    if recorded is not None:
        similarity = Similarity(float(recorded["scale"]), np.asarray(recorded["rotation"], np.float64), np.asarray(recorded["translation"], np.float64))
    return SourceFrame(similarity, bool(metadata.get("metric", False)), stated_up(metadata.get("up")))


def check_mesh(mesh: Mesh, path: Path) -> None:
    """Raise BadInput for a mesh that would make a broken file: no faces, numbers that are not finite, faces that name no vertex."""
    if not len(mesh.faces):
        raise BadInput(f"{path}: the mesh has no faces. Lower the threshold (`--set mesh.density_threshold=...`) or train longer.")
    _check_finite({"vertices": mesh.vertices, "normals": mesh.normals, "colours": mesh.colours}, path)
    _check_texture(mesh, path)
    if mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.vertices):
        raise BadInput(f"{path}: faces name vertices {mesh.faces.min()} to {mesh.faces.max()}, expected 0 to {len(mesh.vertices) - 1}. Make the mesh again.")


def _check_texture(mesh: Mesh, path: Path) -> None:
    texture = mesh.texture
    if texture is None:
        return
    if texture.coordinates.shape != (len(mesh.faces), 3, 2):
        raise BadInput(f"{path}: texture coordinates of shape {texture.coordinates.shape}, expected {(len(mesh.faces), 3, 2)}. Make the texture again.")
    corners = texture.coordinates.reshape(-1, 2)
    _check_finite({"texture coordinates": corners}, path)
    if corners.min() < 0 or corners.max() > 1:
        raise BadInput(f"{path}: texture coordinates from {corners.min():g} to {corners.max():g}, expected 0 to 1. Make the texture again.")
    picture = texture.colours
    if picture.dtype != np.uint8 or picture.ndim != 3 or picture.shape[2] != 3 or not 1 <= min(picture.shape[:2]) <= max(picture.shape[:2]) <= MOST_TEXELS:
        raise BadInput(
            f"{path}: a texture of {picture.dtype} in shape {picture.shape}, expected (H, W, 3) uint8 of at most {MOST_TEXELS} a side. Make the texture again."
        )


def check_points(points: PointCloud, path: Path) -> None:
    """Raise BadInput for a cloud that would make a broken file: empty, or with numbers that are not finite."""
    if not len(points.positions):
        raise BadInput(f"{path}: the point cloud is empty. Lower the threshold (`--set mesh.density_threshold=...`) or train longer.")
    _check_finite({"positions": points.positions, "normals": points.normals, "colours": points.colours}, path)


def _check_finite(arrays: dict[str, np.ndarray], path: Path) -> None:
    for name, values in arrays.items():
        with np.errstate(over="ignore"):
            bad = ~np.isfinite(values.astype(np.float32)).all(1)
        if bad.any():
            found = f"{int(bad.sum())} of {len(values)} {name} are not finite in single precision, the first is row {int(bad.argmax())}"
            raise BadInput(f"{path}: {found}. Bake the asset again.")


def bytes_from_srgb(colours: np.ndarray) -> np.ndarray:
    """sRGB 0-1 -> uint8, rounded."""
    return np.round(np.clip(colours, 0, 1) * 255).astype(np.uint8)


def text_rows(form: str, rows: np.ndarray) -> Iterator[bytes]:
    """A line of text for each row."""
    for start in range(0, len(rows), _ROWS):
        part = rows[start : start + _ROWS]
        yield (form * len(part) % tuple(part.ravel().tolist())).encode("ascii")


def write_parts(path: Path, parts: Iterable[bytes | memoryview]) -> None:
    """Write a file of parts made one after the other, atomically."""
    with atomic(path) as temporary, open(temporary, "wb") as file:
        file.writelines(parts)


def write_files(files: Mapping[Path, Iterable[bytes | memoryview]]) -> None:
    """Write files of one folder that belong together, each of parts; the last, which refers to the others, appears last. See `atomic_together`."""
    with atomic_together([*files]) as temporaries:
        for temporary, parts in zip(temporaries, files.values(), strict=True):
            with open(temporary, "wb") as file:
                file.writelines(parts)
