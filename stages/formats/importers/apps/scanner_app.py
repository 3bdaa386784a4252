"""3D Scanner App's export "All Data" (Laan Labs): frame_00000.jpg next to frame_00000.json, directly in the folder or in the only folder that it holds.

Layout: the readers of PSegs (ios_lidar) and nuwa (from_3dscannerapp). cameraPoseARFrame is ARCamera.transform row by row: camera to world with x right, y up,
looking along -z, for the picture as the sensor has it (landscape); the world is ARKit's: y up, metres. intrinsics are K row by row, in pixels of the picture.
The app writes more poses than pictures. Scans in low resolution have depth_00000.png, millimetres, and conf_00000.png, ARConfidenceLevel: 0, 1 or 2.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from itertools import islice
from pathlib import Path

import numpy as np

from efficientnerf.geometry.cameras import Camera, pose_from_opengl
from pipeline.errors import BadInput
from stages.formats.importers import lenses
from stages.formats.importers.brown import brown_camera
from stages.formats.importers.depth import MILLIMETRE, SENSOR_RANGE, DepthFile, depth_file
from stages.formats.importers.frames import Frame, check_count
from stages.formats.importers.listed import Y_UP, Listed, ListFormat
from stages.formats.importers.source import Source, images_in
from stages.io.json_file import numbers, read_json, read_object

POSE, INTRINSICS = "cameraPoseARFrame", "intrinsics"
LARGEST_FRAME = 1 << 20  # bytes
HIGH = 2  # confidence
OFF_CENTRE = 0.1  # of a side: as far as the principal point of a picture that was neither cropped nor scaled may lie from its middle
_FRAME = re.compile(r"frame_\d+")
_TRIED = 10  # frames that are read to recognise the format, for some may be damaged
_AGAIN = "Export from 3D Scanner App again, as All Data."


def _signs(source: Source) -> Sequence[Path]:
    """The JSON files of the pictures that have one."""
    return [source.check_inside(path.with_suffix(".json")) for path in _pictures(_place(source)) if _is_posed(path)]


def _recognised(source: Source, signs: Sequence[Path]) -> bool:
    for path in signs[:_TRIED]:
        with suppress(BadInput):  # reported where it is read
            document = read_json(source.real(path), _AGAIN, limit=LARGEST_FRAME)
            if isinstance(document, dict) and POSE in document:
                return True
    return False


def _listed(source: Source, signs: Sequence[Path]) -> Listed:
    place = _place(source)
    pictures, where = _pictures(place), source.name_of(place / "frame_*.json")
    posed = [path for path in pictures if _is_posed(path)]
    check_count(len(posed), where)
    poses = sum(1 for path in place.glob("frame_*.json") if _FRAME.fullmatch(path.stem))
    return Listed(
        where,
        [Frame(path.name, place, source.name_of(path.with_suffix(".json")), _camera(source, path.with_suffix(".json"))) for path in posed],
        signs,
        rejected=[(source.name_of(path), "without a pose") for path in pictures if path not in posed],
        up=Y_UP,
        metric=True,
        facts={"poses_without_picture": poses - len(posed)},
        depth=partial(_depth, source, place),
    )


def _depth(source: Source, place: Path, frame: Frame, image: Path) -> DepthFile | None:
    number = image.stem.removeprefix("frame_")
    return depth_file(source, place / f"depth_{number}.png", MILLIMETRE, place / f"conf_{number}.png", HIGH, SENSOR_RANGE)


def _place(source: Source) -> Path:
    """The folder of the frames: the source, or what is in it where that is one folder and nothing else, as the app packs them."""
    inside = list(islice((path for path in source.root.iterdir() if not path.name.startswith((".", "__MACOSX"))), 2))
    return inside[0] if len(inside) == 1 and inside[0].is_dir() and not inside[0].is_symlink() else source.root


def _pictures(place: Path) -> list[Path]:
    return [path for path in images_in(place) if _FRAME.fullmatch(path.stem)]


def _is_posed(picture: Path) -> bool:
    return picture.with_suffix(".json").is_file()


def _camera(source: Source, path: Path) -> Callable[[str, tuple[int, int]], Camera]:
    """The camera of a frame for a picture of a size, which the frame does not state. Raises BadInput, as does what is returned."""
    where = source.name_of(path)
    document = read_object(source.real(path), where, _AGAIN, limit=LARGEST_FRAME)
    matrix = numbers(document.get(POSE), 16, f"{where}: {POSE}", _AGAIN)
    pose = pose_from_opengl(lenses.rigid(np.reshape(matrix, (4, 4)), where))
    k = numbers(document.get(INTRINSICS), 9, f"{where}: {INTRINSICS}", _AGAIN)
    if k[1] or k[3] or k[6] or k[7] or k[8] != 1:
        raise BadInput(f"{where}: {INTRINSICS} are {k}; expected fx 0 cx 0 fy cy 0 0 1 (are they transposed?). {_AGAIN}")

    def at(name: str, size: tuple[int, int]) -> Camera:
        for width, height in (size, size[::-1]):  # a picture that EXIF turns has its camera stated for the pixels as stored
            if abs(k[2] - width / 2) <= OFF_CENTRE * width and abs(k[5] - height / 2) <= OFF_CENTRE * height:
                return brown_camera(name, (width, height), (k[0], k[4]), (k[2], k[5]), pose, where)
        raise BadInput(
            f"{where}: the principal point {k[2]:g}, {k[5]:g} is not near the middle of the picture of {size[0]}x{size[1]}. Was it cropped or scaled? {_AGAIN}"
        )

    return at


FORMAT = ListFormat("3d-scanner-app", "frame_00000.jpg next to frame_00000.json and so on", _signs, _listed, _recognised)
