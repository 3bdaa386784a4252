"""Matrices of cameras in text files, JSON and NumPy archives, and what a 3x4 projection holds."""

import re
import zipfile
import zlib
from pathlib import Path

import numpy as np

from efficientnerf.geometry.cameras import Camera, Similarity
from pipeline.errors import BadInput
from pipeline.text import printable
from stages.formats.importers import lenses
from stages.formats.importers.brown import brown_camera, without_skew
from stages.formats.importers.frames import CameraOf
from stages.formats.importers.llff import rows_of_npy
from stages.formats.importers.source import MAX_FRAMES
from stages.formats.importers.texts import numbers, read_text
from stages.io import json_file

MAX_CAMERA_BYTES = 1 << 16  # of a text file with one camera
MAX_ARCHIVE_BYTES, MAX_MATRIX_BYTES = 256 << 20, 4096
REMEDY = "Write or download the data set again, or choose another format with --as."


def _pinhole(name: str, size: tuple[int, int], k: np.ndarray, pose: np.ndarray, where: str) -> Camera:
    """A camera from its (3, 3) matrix K, the centre of the first pixel being at 0.5, 0.5. Raises BadInput."""
    if abs(k[2] - (0, 0, 1)).max() > 1e-6 or k[1, 0]:
        raise BadInput(f"{where}: no matrix of a camera: rows {k[1].tolist()} and {k[2].tolist()}, expected 0 fy cy and 0 0 1. {REMEDY}")
    camera = brown_camera(name, size, (k[0, 0], k[1, 1]), (k[0, 2], k[1, 2]), pose, where)
    lenses.validated(camera, where)
    without_skew(k[0, 1], k[1, 1], size, k[1, 2], "a skew of", where)
    for centre, side in ((k[0, 2], size[0]), (k[1, 2], size[1])):
        if not 0.1 * side < centre < 0.9 * side:
            raise BadInput(
                f"{where}: the principal point {k[0, 2]:g}, {k[1, 2]:g} is not near the middle of an image of {size[0]}x{size[1]}; the camera belongs to"
                " images of another size. Use those that it was written for."
            )
    return camera


def pinhole_frame(k: np.ndarray, pose: np.ndarray, where: str, stated: tuple[int, int] | None = None) -> CameraOf:
    """For a frame: the camera of K and a pose, at the stated (width, height) or else at the image's."""
    return lambda name, size: _pinhole(name, stated or size, k, pose, where)


def decomposed(projection: np.ndarray, where: str) -> tuple[np.ndarray, np.ndarray]:
    """(3, 4) K [R t] -> K (3, 3) with a positive diagonal and 1 at its end, and the pose (4, 4), camera to world. Raises BadInput."""
    left = projection[:, :3]
    if not abs(np.linalg.det(left)) > 1e-12 * max(np.abs(left).max(), 1e-30) ** 3:
        raise BadInput(f"{where}: no projection matrix (its left part is singular). {REMEDY}")
    if np.linalg.det(left) < 0:
        projection, left = -projection, -left  # P and -P project alike
    q, r = np.linalg.qr(left[::-1].T)  # RQ by QR of the reversed rows
    k, turn = r.T[::-1, ::-1], q.T[::-1]
    signs = np.sign(np.diag(k))
    k, turn = k * signs, turn * signs[:, None]
    return k / k[2, 2], Similarity(1.0, lenses.rotation(turn, where).T, -np.linalg.solve(left, projection[:, 3])).matrix()


def intrinsics_of(path: Path) -> tuple[np.ndarray, tuple[int, int] | None]:
    """K (3, 3), and (width, height) where the file states it. Raises BadInput."""
    where = path.name
    if path.suffix == ".json":
        # of Open3D: width, height, and intrinsic_matrix, column by column
        document = json_file.read_object(path, where, REMEDY)
        matrix = json_file.numbers(document.get("intrinsic_matrix"), 9, f"{where}: intrinsic_matrix, column by column,", REMEDY)
        width, height = (json_file.number(document, key, where, REMEDY) for key in ("width", "height"))
        return np.array(matrix).reshape(3, 3).T, lenses.image_size(width, height, where, REMEDY)
    found = read_text(path, MAX_CAMERA_BYTES).split()
    if len(found) in (9, 16):
        side = 3 if len(found) == 9 else 4
        return numbers(found, len(found), where).reshape(side, side)[:3, :3], None
    if len(found) == 4:
        fx, fy, cx, cy = numbers(found, 4, where)
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), None
    if len(found) < 6:
        raise BadInput(f"{where}: {len(found)} numbers; expected a matrix of 3x3 or 4x4, fx fy cx cy, or f cx cy first and height, width last. {REMEDY}")
    focal, cx, cy = numbers(found[:3], 3, where)
    height, width = numbers(found[-2:], 2, where)
    return np.array([[focal, 0, cx], [0, focal, cy], [0, 0, 1]]), lenses.image_size(width, height, where, REMEDY)


def archive_matrices(path: Path, where: str) -> dict[str, np.ndarray]:
    """world_mat_<i> and scale_mat_<i>, (4, 4) float64, of an archive, of which nothing but plain numbers is read. Raises BadInput."""
    found: dict[str, np.ndarray] = {}
    if path.stat().st_size > MAX_ARCHIVE_BYTES:
        raise BadInput(f"{where}: larger than {MAX_ARCHIVE_BYTES >> 20} MiB. {REMEDY}")
    try:
        with zipfile.ZipFile(path) as archive:
            for info in archive.infolist():
                match = re.fullmatch(r"((?:world|scale)_mat_[0-9]{1,6})\.npy", info.filename)
                if not match:
                    continue
                if len(found) >= 2 * MAX_FRAMES:
                    raise BadInput(f"{where}: more than {MAX_FRAMES} cameras; that many are not read.")
                with archive.open(info) as entry:
                    data, place = entry.read(MAX_MATRIX_BYTES + 1), f"{where}: {match[1]}"
                if len(data) > MAX_MATRIX_BYTES:
                    raise BadInput(f"{place}: more than {MAX_MATRIX_BYTES} bytes; expected a 4x4 matrix. {REMEDY}")
                found[match[1]] = rows_of_npy(data, place, 4, "4x4 matrices", REMEDY)
                if len(found[match[1]]) != 4:
                    raise BadInput(f"{place}: {len(found[match[1]])} rows; expected a 4x4 matrix. {REMEDY}")
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, ValueError) as error:
        raise BadInput(f"{where}: not a NumPy archive, or truncated ({printable(error, 80)}). {REMEDY}") from None
    return found
