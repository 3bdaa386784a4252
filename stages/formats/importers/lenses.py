"""Checks that every importer makes of a camera: its matrix is a rigid motion, its lens is possible, its size is the image's."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from efficientnerf.geometry.cameras import Camera, Similarity, resized, rotated_clockwise
from pipeline.errors import BadInput
from stages.formats.importers.source import abbreviated
from stages.io.json_file import LARGEST_NUMBER
from stages.io.photo import same_aspect
from stages.io.pictures import Header

SHORTEST_FOCAL = 1e-6  # pixels; its square is a number yet
_QUARTER_TURNS = {1: 0, 6: 1, 3: 2, 8: 3}  # clockwise, from the stored pixels to the upright image; the others are mirrored


def rigid(matrix: Any, where: str) -> np.ndarray:
    """A camera-to-world matrix from a file as (4, 4) float64 with an orthonormal rotation; BadInput names what is wrong.

    Columns may deviate from a rotation by 1e-3, as rounded numbers do.
    """
    try:
        pose = np.array(matrix, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        pose = np.empty(0)
    if pose.shape != (4, 4):
        shape = "x".join(map(str, pose.shape)) if pose.size else "no matrix"
        raise BadInput(f"{where}: expected a 4x4 matrix, camera to world; found {shape}. Write the data set again.")
    if not (np.abs(pose) <= LARGEST_NUMBER).all():  # nor nan
        raise BadInput(
            f"{where}: the matrix holds numbers that are not finite, or beyond {LARGEST_NUMBER:g}. Leave that frame out, or write the data set again."
        )
    if np.abs(pose[3] - (0, 0, 0, 1)).max() > 1e-6:
        raise BadInput(f"{where}: the last row of the matrix is {pose[3].tolist()}, expected 0 0 0 1 (is it transposed?).")
    pose[:3, :3] = rotation(pose[:3, :3], where)
    pose[3] = (0, 0, 0, 1)
    return pose


def rotation(columns: np.ndarray, where: str) -> np.ndarray:
    """(3, 3) that is a rotation up to rounding -> the nearest exact one; BadInput otherwise."""
    lengths = np.linalg.norm(columns, axis=0)
    scale = float(lengths.mean())
    if not np.isfinite(columns).all() or lengths.min() < 1e-9:
        raise BadInput(f"{where}: the matrix is no rotation (axes of length {', '.join(f'{n:.4g}' for n in lengths)}). Write the data set again.")
    if abs(scale - 1) > 1e-3 and np.ptp(lengths) < 1e-3 * scale:
        raise BadInput(f"{where}: the rotation is scaled by {scale:.6g}. Divide the upper left 3x3 of every matrix by it, and leave the positions as they are.")
    if np.abs(columns.T @ columns - np.eye(3)).max() > 2e-3:
        raise BadInput(
            f"{where}: the matrix is no rotation: its axes have lengths {', '.join(f'{n:.4g}' for n in lengths)} or are not at right angles. "
            "Write the data set again, with rotation and scale kept apart."
        )
    if np.linalg.det(columns) < 0:
        raise BadInput(f"{where}: the matrix is left-handed (a mirror image). Negate one axis where the data set was written.")
    left, _, right = np.linalg.svd(columns)
    return np.asarray(left @ right)


def inverse(turn: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """(4, 4) camera to world, of the rotation (3, 3) and the translation (3,) from world to camera."""
    return Similarity(1.0, turn.T, -turn.T @ shift).matrix()


def image_size(width: float, height: float, where: str, remedy: str) -> tuple[int, int]:
    """A size that a file states; BadInput for anything but whole pixels."""
    if not 0 < min(width, height) <= max(width, height) <= 65535 or width != int(width) or height != int(height):
        raise BadInput(f"{where}: image size {width:g}x{height:g}; expected whole pixels. {remedy}")
    return int(width), int(height)


def validated(camera: Camera, where: str) -> Camera:
    """The camera itself; BadInput for a lens or a place that cannot be: a focal length that is not positive, numbers that are not finite."""
    named = camera.intrinsics
    if not all(abs(value) <= LARGEST_NUMBER for value in camera.params):
        raise BadInput(f"{where}: camera parameters {list(camera.params)} are not all finite, or beyond {LARGEST_NUMBER:g}. Write the data set again.")
    if min(named["fx"], named["fy"]) < SHORTEST_FOCAL:
        raise BadInput(f"{where}: focal length {min(named['fx'], named['fy']):g}; expected more than zero pixels. Write the data set again.")
    if not (np.abs(camera.world_from_camera) <= LARGEST_NUMBER).all():
        raise BadInput(f"{where}: the camera's place is not finite, or beyond {LARGEST_NUMBER:g}. Write the data set again.")
    return camera


def fit_to_images(stated: Sequence[tuple[Camera, Header, str]]) -> list[tuple[Camera, str | None]]:
    """`fit_to_image` of all images of a set, as (camera, header, where).

    Turned by 180 degrees, or square, an image does not show for which pixels its camera was stated. Where others of the set show that theirs were stated for
    the pixels as stored, so were these.
    """
    shown = [
        same_aspect((camera.width, camera.height), header.size)
        for camera, header, _ in stated
        if header.orientation >= 5 and not same_aspect(header.size, header.size[::-1])
    ]
    as_stored = bool(shown) and not any(shown)
    return [fit_to_image(camera, header, where, as_stored) for camera, header, where in stated]


def fit_to_image(camera: Camera, header: Header, where: str, as_stored: bool = False) -> tuple[Camera, str | None]:
    """The camera of a file's upright image, from a camera that may have been stated at another size or for the pixels as stored.

    as_stored  whether cameras of the set are known to be stated for the pixels as stored
    returns    the camera and a remark: "resized", "turned", "upright?" (turned by 180 degrees or mirrored, where nothing says for which the camera was stated:
               taken to be the upright image) or None
    Raises BadInput where the aspect does not agree (1 %, or a pixel of rounding).
    """
    width, height = header.size
    stated, stored = (camera.width, camera.height), (header.stored_width, header.stored_height)
    sideways = header.orientation >= 5 and not same_aspect(stated, (width, height)) and same_aspect(stated, stored)
    if sideways and header.orientation not in _QUARTER_TURNS:
        raise BadInput(f"{where}: the image is mirrored by its EXIF orientation ({header.orientation}) and the camera is not. Write the image upright.")
    if sideways or (as_stored and _QUARTER_TURNS.get(header.orientation) and same_aspect(stated, stored)):
        camera = resized(camera, *stored)
        for _ in range(_QUARTER_TURNS[header.orientation]):
            camera = rotated_clockwise(camera)
        return camera, "turned"
    if stated == (width, height):
        return camera, "upright?" if header.orientation != 1 and (header.orientation < 5 or width == height) else None
    if not same_aspect(stated, (width, height)):
        raise BadInput(
            f"{where}: the camera is stated for {camera.width}x{camera.height}, the image is {width}x{height}, of another aspect. "
            "Use the images that the cameras were made for (not cropped ones), or correct w and h."
        )
    return resized(camera, width, height), "resized"


def fit_warnings(where: str, remarks: dict[str, list[str]]) -> list[str]:
    """Sentences about the remarks of `fit_to_image`: remark -> names of the images."""
    sentences = {
        "resized": "are not of the stated size; the intrinsics were scaled to them",
        "turned": "are rotated by EXIF and their cameras stated for the pixels as stored; the cameras were rotated too",
        "upright?": "are rotated by EXIF; their cameras are taken to be those of the rotated images",
    }
    return [f"{where}: {len(names)} images ({abbreviated(names)}) {sentences[kind]}." for kind, names in remarks.items()]
