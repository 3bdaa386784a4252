"""DTU and other scenes as IDR, NeuS and VolSDF have them: cameras_sphere.npz or cameras.npz, image/ and mask/.

Layout: DATA_CONVENTION.md of lioryariv/idr. `world_mat_<i>` is K [R t] with a row 0 0 0 1, for the i-th image in the order of the names; the centre of the
first pixel is at 0, 0. `scale_mat_<i>` maps the unit sphere to the one that holds the object: its box is taken for the scene's bounds. Nothing but plain
numbers is read from the archive.
"""

from __future__ import annotations

import re
import zipfile
import zlib
from pathlib import Path

import numpy as np

from pipeline.errors import BadInput
from pipeline.text import printable
from stages.formats.importers import frames
from stages.formats.importers.datasets.matrices import decomposed, pinhole_frame
from stages.formats.importers.llff import npy_header
from stages.formats.importers.source import MAX_FRAMES, ImportSettings, Source, images_in
from stages.io.capture import Capture
from stages.io.json_file import LARGEST_NUMBER

FILES = ("cameras_sphere.npz", "cameras.npz", "cameras_large.npz", "cameras_linear_init.npz")
IMAGES, MASKS = ("image", "images", "rgb"), ("mask", "masks")
LARGEST_ENTRY = 4096  # bytes of a matrix of 4x4 numbers with its header
LARGEST_FILE = 256 << 20  # bytes
_AGAIN = "Write it again with IDR's preprocess_cameras.py."


def recognises(folder: Path, allow_outside: bool = False) -> bool:
    return Source(folder, allow_outside).first_of(FILES) is not None


def files(folder: Path, settings: ImportSettings) -> list[Path]:
    """The archive of cameras, the images and their masks."""
    source = Source(folder, settings.allow_outside)
    file, listed, _ = _read(source)
    return [file, *frames.files_of(source, listed)]


def read(folder: Path, settings: ImportSettings) -> Capture:
    """The capture that the archive describes. Raises BadInput."""
    source = Source(folder, settings.allow_outside)
    file, listed, bounds = _read(source)
    return frames.capture_of(source, listed, settings, kind="idr", where=source.name_of(file), bounds=bounds, facts={"cameras": source.name_of(file)})



def _read(source: Source) -> tuple[Path, list[frames.Frame], np.ndarray | None]:
    """The archive, its frames, and the box round the object."""
    file = source.first_of(FILES)
    if file is None:
        raise BadInput(f"{source.root}: no cameras of IDR: expected {' or '.join(FILES[:2])}. Choose another format with --as.")
    where = source.name_of(file)
    matrices = read_matrices(source.real(file), where)
    images = next((found for place in IMAGES if (found := images_in(source.root / place))), [])
    masks = next((found for place in MASKS if (found := images_in(source.root / place))), [])
    count = sum(name.startswith("world_mat_") for name in matrices)
    frames.check_count(count, where)
    if len(images) != count:
        raise BadInput(f"{where}: {count} cameras, but {len(images)} images in image/; they belong to the sorted names. Restore the images it was made from.")
    if masks and len(masks) != count:
        raise BadInput(f"{where}: {count} cameras, but {len(masks)} masks in mask/; they belong to the sorted names. Restore them, or take the folder out.")
    listed = []
    for index, image in enumerate(images):
        place = f"{where}: world_mat_{index}"
        if f"world_mat_{index}" not in matrices:
            raise BadInput(f"{place}: not there, with {count} cameras. {_AGAIN}")
        k, pose = decomposed(matrices[f"world_mat_{index}"][:3], place)
        k = k + np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
        mask = source.check_inside(masks[index]) if masks else None
        listed.append(frames.Frame(image.name, image.parent, place, pinhole_frame(k, pose, place), mask=mask))
    return file, listed, _bounds(matrices, where)


def _bounds(matrices: dict[str, np.ndarray], where: str) -> np.ndarray | None:
    """(2, 3) the box round the sphere of the object; None where the archive names none."""
    matrix = matrices.get("scale_mat_0")
    if matrix is None:
        return None
    radius = float(np.cbrt(abs(np.linalg.det(matrix[:3, :3]))))
    if not 1e-9 < radius < LARGEST_NUMBER:
        raise BadInput(f"{where}: scale_mat_0 scales by {radius:g}; expected a positive number. {_AGAIN}")
    return np.stack([matrix[:3, 3] - radius, matrix[:3, 3] + radius])


def read_matrices(path: Path, where: str) -> dict[str, np.ndarray]:
    """world_mat_<i> and scale_mat_<i>, (4, 4) float64, of an archive. Raises BadInput."""
    found: dict[str, np.ndarray] = {}
    if path.stat().st_size > LARGEST_FILE:
        raise BadInput(f"{where}: larger than {LARGEST_FILE >> 20} MiB. {_AGAIN}")
    try:
        with zipfile.ZipFile(path) as archive:
            for info in archive.infolist():
                match = re.fullmatch(r"((?:world|scale)_mat_[0-9]{1,6})\.npy", info.filename)
                if not match:
                    continue
                if len(found) >= 2 * MAX_FRAMES:
                    raise BadInput(f"{where}: more than {MAX_FRAMES} cameras; that many are not read.")
                with archive.open(info) as entry:
                    found[match[1]] = _matrix(entry.read(LARGEST_ENTRY + 1), f"{where}: {match[1]}")
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, ValueError) as error:
        raise BadInput(f"{where}: not a NumPy archive, or truncated ({printable(error, 80)}). {_AGAIN}") from None
    return found


def _matrix(data: bytes, where: str) -> np.ndarray:
    if len(data) > LARGEST_ENTRY:
        raise BadInput(f"{where}: more than {LARGEST_ENTRY} bytes; expected a 4x4 matrix. {_AGAIN}")
    shape, fortran, kind, start = npy_header(Path(where), data)
    if shape != (4, 4) or kind.kind not in "fiu" or len(data) - start < 16 * kind.itemsize:
        what = f"{kind} {shape}"
        raise BadInput(f"{where}: {what:.80}; expected numbers of shape (4, 4). {_AGAIN}")
    matrix = np.frombuffer(data, kind, 16, start).reshape(4, 4, order="F" if fortran else "C").astype(np.float64)
    if not (np.abs(matrix) <= LARGEST_NUMBER).all():  # nor nan
        raise BadInput(f"{where}: numbers that are not finite, or beyond {LARGEST_NUMBER:g}. {_AGAIN}")
    return matrix
