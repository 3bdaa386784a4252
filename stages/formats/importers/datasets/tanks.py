"""Tanks and Temples: a trajectory (.log) with the photographs in a folder, and the camera's intrinsics beside it.

Layout: the tutorial of tanksandtemples.org and Open3D's "Camera trajectory". Five lines an image: three numbers of which the first is the index of the image
in the order of the names, and the matrix of camera to world, x right, y down, z forward. The trajectory holds no intrinsics: they are read from
intrinsics.txt (a 3x3 or 4x4 matrix, or fx fy cx cy) or from a JSON file as Open3D writes it (width, height, intrinsic_matrix column by column).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipeline.errors import BadInput
from stages.formats.importers import frames, lenses
from stages.formats.importers.datasets.matrices import pinhole_frame
from stages.formats.importers.datasets.nsvf import intrinsics
from stages.formats.importers.source import MAX_FRAMES, ImportSettings, Source, images_in
from stages.formats.importers.texts import head, number, numbers, read_text
from stages.io.capture import Capture
from stages.io.json_file import finite, read_json

IMAGES = ("images", "image", "rgb", "color", ".")
INTRINSICS = ("intrinsics.txt", "intrinsic.txt", "intrinsic.json", "intrinsics.json", "camera_intrinsic.json")
_AGAIN = "Write the trajectory again, or choose another format with --as."


def recognises(folder: Path, allow_outside: bool = False) -> bool:
    return bool(_trajectories(Source(folder, allow_outside)))


def files(folder: Path, settings: ImportSettings) -> list[Path]:
    """The trajectory, the intrinsics, the images and their masks."""
    source = Source(folder, settings.allow_outside)
    file, lens, listed = _read(source)
    return [file, lens, *frames.files_of(source, listed)]


def read(folder: Path, settings: ImportSettings) -> Capture:
    """The capture that the trajectory describes. Raises BadInput."""
    source = Source(folder, settings.allow_outside)
    file, lens, listed = _read(source)
    return frames.capture_of(source, listed, settings, kind="tanks-and-temples", where=source.name_of(file), facts={"intrinsics": source.name_of(lens)})


def _trajectories(source: Source) -> list[Path]:
    """Files that begin with three whole numbers and a matrix."""
    found = []
    for path in sorted(source.root.glob("*.log")):
        words = head(source.real(path)).split()[:19] if path.is_file() else []
        if len(words) == 19 and all(_is_number(word) for word in words) and [float(word) for word in words[15:]] == [0, 0, 0, 1]:
            found.append(path)
    return found


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _read(source: Source) -> tuple[Path, Path, list[frames.Frame]]:
    """The trajectory, the file of intrinsics, and the frames."""
    found = _trajectories(source)
    if len(found) != 1:
        what = "no trajectory (.log)" if not found else f"{len(found)} trajectories"
        raise BadInput(f"{source.root}: {what}; one is expected beside the folder of images. Choose another format with --as, or take the others out.")
    lens = next((source.root / name for name in INTRINSICS if (source.root / name).is_file()), None)
    if lens is None:
        raise BadInput(f"{found[0]}: a trajectory without intrinsics. Write fx fy cx cy, in pixels, into {source.root / INTRINSICS[0]}.")
    k, stated = _intrinsics(source.real(lens))
    images = next((found_images for place in IMAGES if (found_images := images_in(source.root / place))), [])
    where = source.name_of(found[0])
    words = read_text(source.real(found[0])).split()
    if len(words) % 19 or not words:
        raise BadInput(f"{where}: {len(words)} numbers; expected three and a matrix of 4x4 for each image. {_AGAIN}")
    if len(words) > 19 * MAX_FRAMES:
        raise BadInput(f"{where}: {len(words) // 19} cameras; at most {MAX_FRAMES} are read.")
    listed = []
    for row in range(len(words) // 19):
        place = f"{where}: camera {row}"
        index = number(words[19 * row], f"{place}: index")
        if index != int(index) or not 0 <= index < len(images):
            raise BadInput(f"{place}: index {index:g}, and {len(images)} images; indices count the sorted names from 0. Restore the images it was made from.")
        pose = lenses.rigid(numbers(words[19 * row + 3 : 19 * row + 19], 16, place).reshape(4, 4), place)
        image = images[int(index)]
        listed.append(frames.Frame(image.name, image.parent, place, pinhole_frame(k, pose, source.name_of(lens), stated)))
    return found[0], lens, listed


def _intrinsics(path: Path) -> tuple[np.ndarray, tuple[int, int] | None]:
    if path.suffix != ".json":
        return intrinsics(path)
    document = read_json(path, _AGAIN)
    matrix = document.get("intrinsic_matrix") if isinstance(document, dict) else None
    values = [finite(value) for value in matrix] if isinstance(matrix, list) and len(matrix) == 9 else [None]
    sides = [document.get(key) for key in ("width", "height")] if isinstance(document, dict) else []
    if None in values or not all(isinstance(side, int) and 0 < side <= 65535 for side in sides):
        raise BadInput(f"{path.name}: expected width, height and an intrinsic_matrix of 9 numbers, column by column. {_AGAIN}")
    return np.array(values, np.float64).reshape(3, 3).T, (int(sides[0]), int(sides[1]))  # type: ignore[arg-type]
