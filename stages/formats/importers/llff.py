"""LLFF: poses_bounds.npy next to images/, images_4/, images_8/ ...

A row is 3x5 [R | t | (h, w, f)] with camera columns down, right, back, then near and far; rows are in the order of the sorted names.
h, w, f are those of the full images; the images at hand may be smaller, and f is scaled to them.
"""

import io
import re
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

import numpy as np

from efficientnerf.capture.forward_facing import MAX_AXIS_ANGLE
from efficientnerf.geometry.cameras import Camera, pose_from_llff
from pipeline.errors import BadInput
from pipeline.text import printable
from stages.formats.importers import colmap, lenses
from stages.formats.importers.frames import CameraOf, Frame
from stages.formats.importers.listed import Listed, ListFormat
from stages.formats.importers.source import MAX_FRAMES, Source, images_in, name_key
from stages.io.json_file import LARGEST_NUMBER

POSES = "poses_bounds.npy"


def holds_less_than_colmap(folder: Path, allow_outside: bool) -> bool:
    """Whether the folder's COLMAP model has all images of poses_bounds.npy, and they look round about, as in mip-NeRF 360's data.

    The file was made from the model, and has one focal length for its lens and none of its points. For forward-facing captures its depths give the space of
    the training.
    """
    source = Source(folder, allow_outside)
    try:
        rows, named = _rows(source), colmap.image_names(source)
    except BadInput:  # reported where it is read
        return False
    here = [name_key(path.name) for path in images_in(folder / "images")]
    if sorted(name_key(PurePosixPath(name).name) for name in named) != sorted(here) or len(here) != len(rows):
        return False
    axes = rows[:, :15].reshape(-1, 3, 5)[:, :, 2]
    axes /= np.maximum(np.linalg.norm(axes, axis=1, keepdims=True), 1e-12)
    mean = axes.mean(0) / max(float(np.linalg.norm(axes.mean(0))), 1e-12)
    return bool((axes @ mean).min() < np.cos(np.radians(MAX_AXIS_ANGLE)))


def _listed(source: Source, signs: Sequence[Path]) -> Listed:
    rows = _rows(source)
    images, factor, warnings = _images(source, len(rows))
    frames = []
    for index, (row, image) in enumerate(zip(rows, images, strict=True)):
        where = f"{POSES}: row {index} ({source.name_of(image)})"
        frames.append(Frame(image.name, image.parent, where, _camera(row, where), near=float(row[15]), far=float(row[16])))
    facts: dict[str, object] = {"image_folder": printable(images[0].parent.name), "factor": factor}
    return Listed(POSES, frames, signs, warnings=warnings, facts=facts, expected_remarks=("resized",))  # for that the folders are there


def _signs(source: Source) -> list[Path]:
    return [path for path in [source.root / POSES] if path.is_file()]


def _rows(source: Source) -> np.ndarray:
    return read_rows(source.real(source.root / POSES))


def _camera(row: np.ndarray, where: str) -> CameraOf:
    def camera(name: str, size: tuple[int, int]) -> Camera:
        matrix, (near, far) = row[:15].reshape(3, 5), row[15:]
        pose = pose_from_llff(matrix[:, :4])
        pose[:3, :3] = lenses.rotation(pose[:3, :3], where)
        height, width, focal = matrix[:, 4]
        size_stated = lenses.image_size(width, height, where, "Write poses_bounds.npy again.")
        if not 0 < near < far:
            raise BadInput(f"{where}: near {near:g} and far {far:g}; expected 0 < near < far. Write poses_bounds.npy again.")
        return Camera(name, *size_stated, "SIMPLE_PINHOLE", (float(focal), width / 2, height / 2), pose)

    return camera


def read_rows(path: Path) -> np.ndarray:
    """(N, 17) float64, finite, N at most `MAX_FRAMES`; nothing but plain numbers is read from the file. Raises BadInput."""
    try:
        with path.open("rb") as file:
            data = file.read(17 * 8 * MAX_FRAMES + 4097)
    except OSError as error:
        raise BadInput(f"{path}: {error.strerror or 'not a NumPy array'}. Name the folder of an LLFF data set, or choose a format with --as.") from error
    if len(data) > 17 * 8 * MAX_FRAMES + 4096:
        raise BadInput(f"{path}: {path.stat().st_size} bytes; more than {MAX_FRAMES} poses are not read.")
    return rows_of_npy(data, str(path), 17, "3x5 poses, near and far", "Write it again with LLFF's imgs2poses.")


def rows_of_npy(data: bytes, where: str, columns: int, what: str, remedy: str) -> np.ndarray:
    """(N, columns) float64, finite, of a .npy file; nothing but plain numbers is read, and nothing is allocated on its header's word. Raises BadInput."""
    file = io.BytesIO(data)
    try:
        major, _ = np.lib.format.read_magic(file)
        shape, fortran, kind = (np.lib.format.read_array_header_1_0 if major == 1 else np.lib.format.read_array_header_2_0)(file)
    except Exception as error:  # a damaged header is parsed as a Python literal, which raises anything
        reason = printable(next(iter(str(error).splitlines()), type(error).__name__), 80)
        raise BadInput(f"{where}: not a NumPy array of numbers, or truncated ({reason}). {remedy}") from error
    shape = tuple(map(int, shape))  # True is an integer to the parser
    if len(shape) != 2 or shape[1] != columns or kind.kind not in "fiu":
        found = f"{kind} {shape}"
        raise BadInput(f"{where}: {found:.80}; expected numbers of shape (N, {columns}): {what}. {remedy}")
    if not 0 <= shape[0] * columns * kind.itemsize <= len(data) - file.tell():
        raise BadInput(f"{where}: not a NumPy array of numbers, or truncated ({len(data)} bytes for {shape[0]} rows). {remedy}")
    rows = np.frombuffer(data, kind, shape[0] * columns, file.tell()).reshape(shape, order="F" if fortran else "C").astype(np.float64)
    unusable = ~(np.abs(rows) <= LARGEST_NUMBER).all(1)  # nan, too
    if unusable.any():
        raise BadInput(f"{where}: row {int(np.flatnonzero(unusable)[0])} holds numbers that are not finite, or beyond {LARGEST_NUMBER:g}. {remedy}")
    return rows


def _images(source: Source, count: int) -> tuple[list[Path], int, list[str]]:
    """The images in the order of the rows, the reduction factor of their folder, and warnings."""
    folders = {1: source.root / "images"} if images_in(source.root / "images") else {}  # by the reduction factor: images_4/ is 4
    for entry in sorted(source.root.iterdir()):
        match = re.fullmatch(r"images_(\d{1,4})", entry.name)
        if match and int(match[1]) > 0 and images_in(entry):
            folders.setdefault(int(match[1]), entry)
    folders = dict(sorted(folders.items()))
    if not folders:
        raise BadInput(f"{source.root}: {POSES} without images: expected a folder images, images_4, images_8 ... next to it.")
    counts = {factor: len(images_in(folder)) for factor, folder in folders.items()}
    wanted = source.llff_factor
    if wanted != "auto" and wanted not in folders:
        there = ", ".join(folder.name for folder in folders.values())
        raise BadInput(f"{source.root}: no images reduced by {wanted} (poses.llff_factor); there are {there}.")
    usable = list(folders) if wanted == "auto" else [wanted]
    fitting = [factor for factor in usable if counts[factor] == count]
    if not fitting:
        found = ", ".join(f"{folders[factor].name} holds {counts[factor]}" for factor in usable)
        raise BadInput(f"{source.root / POSES}: {count} poses, but {found} images; rows belong to the sorted names. Restore the images it was made from.")
    warnings = []
    if fitting[0] != usable[0]:
        warnings.append(f"{folders[usable[0]].name} holds {counts[usable[0]]} images for {count} poses; {folders[fitting[0]].name} is used instead.")
    return [source.check_inside(image) for image in images_in(folders[fitting[0]])], fitting[0], warnings


FORMAT = ListFormat("llff", f"{POSES} next to a folder images, images_4 or the like", _signs, _listed)
