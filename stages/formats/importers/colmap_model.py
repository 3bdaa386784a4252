"""COLMAP's files cameras, images and points3D, binary and text, read strictly.

Every count is checked against the size of the file before anything is allocated; a file that ends early, or goes on after its end, is
refused. Newer models also hold `rigs` and `frames`; `images` has every pose, so they are not needed.
Formats: the COLMAP documentation, "Output format".
"""

import math
import re
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from efficientnerf.geometry.cameras import MODELS, Camera
from pipeline.errors import BadInput
from pipeline.text import printable
from stages.formats.importers.lenses import image_size
from stages.io.capture import SparsePoints

# The camera models by their numbers in binary files.
MODEL_NAMES = (
    "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "FOV", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE",
    "THIN_PRISM_FISHEYE",
)  # fmt: skip
# COLMAP's models of fewer parameters that are OPENCV_FISHEYE with the others zero: how many k they have, after f, cx, cy.
FISHEYE = {"SIMPLE_RADIAL_FISHEYE": 1, "RADIAL_FISHEYE": 2}
MAX_FILE = 8 << 30  # bytes
MAX_IMAGES = 100_000
MAX_NAME = 200  # characters of a name that a message shows
MAX_COORDINATE = 1e60  # of points: those of nearly parallel rays lie far away, and squares of squares are numbers yet
_REMEDY = "Copy the model again, or export it anew."


@dataclass(frozen=True)
class PosedImage:
    """An image of images.bin|txt: world to camera as quaternion w x y z and translation."""

    name: str
    camera: int
    quaternion: tuple[float, float, float, float]
    translation: tuple[float, float, float]


@dataclass(frozen=True)
class Model:
    """cameras: at the origin"""

    folder: Path
    cameras: dict[int, Camera]
    images: dict[int, PosedImage]


def model_files(folder: Path) -> list[Path] | None:
    """The files of the model in a folder (binary before text), points3D last where it is there; None where there is no model."""
    for suffix in (".bin", ".txt"):
        needed = [folder / f"cameras{suffix}", folder / f"images{suffix}"]
        if all(path.is_file() for path in needed):
            points = folder / f"points3D{suffix}"
            return [*needed, points] if points.is_file() else needed
    return None


def count_images(found: Sequence[Path]) -> int:
    """The number of images that a model of these files states, from its header; 0 where it cannot be read."""
    path = found[1]
    if path.suffix == ".bin":
        with path.open("rb") as file:
            head = file.read(8)
        return struct.unpack("<Q", head)[0] if len(head) == 8 else 0
    return sum(1 for _ in _image_lines(path))


def read_model(folder: Path, found: Sequence[Path]) -> Model:
    """The model in a folder, whose files are opened as they are `found`, in the order of `model_files`. Raises BadInput."""
    for path in found:
        if path.stat().st_size > MAX_FILE:
            raise BadInput(f"{path}: {path.stat().st_size >> 30} GiB; at most {MAX_FILE >> 30} GiB are read.")
    binary = found[0].suffix == ".bin"
    cameras = (_cameras_bin if binary else _cameras_txt)(found[0])
    images = (_images_bin if binary else _images_txt)(found[1])
    for image in images.values():
        if image.camera not in cameras:
            raise BadInput(
                f"{found[1]}: image {printable(image.name, MAX_NAME)} refers to camera {image.camera}, which {found[0].name} does not hold. {_REMEDY}"
            )
    return Model(folder, cameras, images)


def read_points(found: Sequence[Path]) -> SparsePoints | None:
    """The points of a model that was read from these files; tracks hold the numbers of the images that observe each, sorted, each once. Raises BadInput."""
    if len(found) < 3:
        return None
    return (_points_bin if found[2].suffix == ".bin" else _points_txt)(found[2])


class _Bytes:
    """A binary file read from front to back; never beyond its end."""

    def __init__(self, path: Path) -> None:
        self.path, self.data, self.at = path, path.read_bytes(), 0

    def take(self, layout: str) -> tuple[Any, ...]:
        size = struct.calcsize(layout)
        self.need(size)
        values = struct.unpack_from(layout, self.data, self.at)
        self.at += size
        return values

    def need(self, size: int) -> None:
        if size > len(self.data) - self.at:
            raise BadInput(f"{self.path}: truncated: {len(self.data)} bytes, at least {self.at + size} expected. {_REMEDY}")

    def skip(self, size: int) -> None:
        self.need(size)
        self.at += size

    def count(self, least_each: int, what: str, most: int | None = None) -> int:
        (count,) = self.take("<Q")
        if most is not None and count > most:
            raise BadInput(f"{self.path}: states {count} {what}; at most {most} are read. Is it a COLMAP model?")
        self.need(count * least_each)
        return int(count)

    def text(self) -> str:
        end = self.data.find(b"\0", self.at, self.at + 4096)
        if end < 0:
            raise BadInput(f"{self.path}: truncated: a name without an end at byte {self.at}. {_REMEDY}")
        raw, self.at = self.data[self.at : end], end + 1
        return raw.decode("utf-8", "surrogateescape")

    def finish(self) -> None:
        if self.at != len(self.data):
            raise BadInput(f"{self.path}: {len(self.data) - self.at} bytes after its end. Is it a COLMAP model? {_REMEDY}")


def count_parameters(model: str) -> int | None:
    """Of a camera model that is read; None for others."""
    return 3 + FISHEYE[model] if model in FISHEYE else len(MODELS[model]) if model in MODELS else None


def as_traced(model: str, params: tuple[float, ...]) -> tuple[str, tuple[float, ...]]:
    """A model of COLMAP and its parameters as one of those that rays are traced through."""
    if model not in FISHEYE:
        return model, params
    focal, cx, cy, *radial = params
    return "OPENCV_FISHEYE", (focal, focal, cx, cy, *radial, *([0.0] * (4 - len(radial))))


def _lens(path: Path, number: int, model: str, width: int, height: int, params: tuple[float, ...]) -> Camera:
    if (expected := count_parameters(model)) is None:
        supported = ", ".join([*MODELS, *FISHEYE])
        raise BadInput(f"{path}: camera {number} is a {printable(model, 40)}; supported are {supported}. Undistort with `colmap image_undistorter` first.")
    if len(params) != expected:
        raise BadInput(f"{path}: camera {number}: {model} has {expected} parameters, found {len(params)}. {_REMEDY}")
    width, height = image_size(width, height, f"{path}: camera {number}", _REMEDY)
    return Camera("", width, height, *as_traced(model, params), np.eye(4))


def _posed(path: Path, name: str, camera: int, numbers: tuple[float, ...]) -> PosedImage:
    quaternion, translation, shown = numbers[:4], numbers[4:], printable(name, MAX_NAME)
    if not all(map(math.isfinite, numbers)) or abs(math.hypot(*quaternion) - 1) > 1e-2:
        found = f"quaternion {list(quaternion)}, translation {list(translation)}"
        raise BadInput(f"{path}: image {shown}: {found}; expected a unit quaternion and finite numbers. {_REMEDY}")
    if not name:
        raise BadInput(f"{path}: an image without a name. {_REMEDY}")
    return PosedImage(name, camera, quaternion, translation)  # type: ignore[arg-type]


def _cameras_bin(path: Path) -> dict[int, Camera]:
    file, cameras = _Bytes(path), {}
    for _ in range(file.count(24, "cameras", MAX_IMAGES)):
        number, model_number, width, height = file.take("<IiQQ")
        model = MODEL_NAMES[model_number] if 0 <= model_number < len(MODEL_NAMES) else f"model of number {model_number}"
        cameras[number] = _lens(path, number, model, width, height, file.take(f"<{count_parameters(model) or 0}d"))
    file.finish()
    return cameras


def _images_bin(path: Path) -> dict[int, PosedImage]:
    file, images = _Bytes(path), {}
    for _ in range(file.count(73, "images", MAX_IMAGES)):
        number, *pose, camera = file.take("<I7dI")
        images[number] = _posed(path, file.text(), camera, tuple(pose))
        file.skip(24 * file.count(24, "points of an image"))  # x, y, id of the point: not needed
    file.finish()
    return images


def _points_bin(path: Path) -> SparsePoints:
    file = _Bytes(path)
    count = file.count(51, "points")
    xyz, rgb, error = np.empty((count, 3)), np.empty((count, 3), np.uint8), np.empty(count)
    tracks = []
    for i in range(count):
        _, x, y, z, r, g, b, off = file.take("<Q3d3Bd")
        xyz[i], rgb[i], error[i] = (x, y, z), (r, g, b), off
        length = file.count(8, "observations of a point")
        track = struct.unpack_from(f"<{2 * length}I", file.data, file.at)
        file.skip(8 * length)
        tracks.append(tuple(sorted(set(track[::2]))))
    file.finish()
    return _finite(path, SparsePoints(xyz, rgb, error, tuple(tracks)))


def _finite(path: Path, points: SparsePoints) -> SparsePoints:
    unusable = ~(np.abs(points.xyz) <= MAX_COORDINATE).all(1)  # nan, too
    if unusable.any():
        raise BadInput(f"{path}: {int(unusable.sum())} points are not finite. {_REMEDY}")
    return points


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    with path.open(encoding="utf-8", errors="surrogateescape", newline="\n") as file:
        for number, line in enumerate(file, 1):
            yield number, line.rstrip("\r\n")


def _check_count(path: Path, what: str, found: int) -> None:
    """Against the count that COLMAP writes into a comment at the top."""
    for number, line in _lines(path):
        if number > 10 or not line.startswith("#"):
            return
        stated = re.match(rf"# Number of {what}:\s*([0-9]{{1,19}})\s*(,|:|$)", line)
        if stated and int(stated[1]) > found:
            raise BadInput(f"{path}: truncated: its first lines say {stated[1]} {what}, it holds {found}. {_REMEDY} (Or correct that comment.)")


def _numbers(path: Path, line: int, words: list[str]) -> list[float]:
    try:
        return [float(word) for word in words]
    except ValueError as error:
        raise BadInput(f"{path}: line {line}: {printable(error, 100)}. {_REMEDY}") from error


def _integer(path: Path, line: int, word: str) -> int:
    if not re.fullmatch("-?[0-9]{1,19}", word):
        raise BadInput(f"{path}: line {line}: {word[:40]!r} is not a whole number. {_REMEDY}")
    return int(word)


def _cameras_txt(path: Path) -> dict[int, Camera]:
    cameras = {}
    for line, text in _lines(path):
        words = text.split()
        if not words or words[0].startswith("#"):
            continue
        if len(words) < 5:
            raise BadInput(f"{path}: line {line}: {len(words)} words, expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS. {_REMEDY}")
        number = _integer(path, line, words[0])
        params = tuple(_numbers(path, line, words[4:]))
        cameras[number] = _lens(path, number, words[1], _integer(path, line, words[2]), _integer(path, line, words[3]), params)
    _check_count(path, "cameras", len(cameras))
    return cameras


def _image_lines(path: Path) -> Iterator[tuple[int, str, str | None]]:
    """(line number, first line, second line or None at the end of the file) of each image; the second may be empty."""
    lines = _lines(path)
    for number, text in lines:
        if text.strip() and not text.lstrip().startswith("#"):
            yield number, text, next(lines, (0, None))[1]


def _images_txt(path: Path) -> dict[int, PosedImage]:
    images: dict[int, PosedImage] = {}
    for line, text, points in _image_lines(path):
        words = text.split(maxsplit=9)
        if len(words) < 10:
            expected = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME (then a line of points, or an empty one)"
            raise BadInput(f"{path}: line {line}: {len(words)} words, expected {expected}. {_REMEDY}")
        if points is not None and len(points.split()) % 3:
            raise BadInput(f"{path}: line {line + 1}: truncated: points come as X Y POINT3D_ID, found {len(points.split())} words. {_REMEDY}")
        if len(images) >= MAX_IMAGES:
            raise BadInput(f"{path}: more than {MAX_IMAGES} images; not read.")
        numbers = tuple(_numbers(path, line, words[1:8]))
        images[_integer(path, line, words[0])] = _posed(path, words[9].strip(), _integer(path, line, words[8]), numbers)
    _check_count(path, "images", len(images))
    return images


def _points_txt(path: Path) -> SparsePoints:
    xyz, rgb, error, tracks = [], [], [], []
    for line, text in _lines(path):
        words = text.split()
        if not words or words[0].startswith("#"):
            continue
        if len(words) < 8 or len(words) % 2:
            expected = "POINT3D_ID X Y Z R G B ERROR and pairs IMAGE_ID POINT2D_IDX"
            raise BadInput(f"{path}: line {line}: truncated: {len(words)} words, expected {expected}. {_REMEDY}")
        numbers = _numbers(path, line, words[1:8])
        colour = numbers[3:6]
        if not all(0 <= channel <= 255 for channel in colour):
            raise BadInput(f"{path}: line {line}: colour {colour}, expected 0 to 255. {_REMEDY}")
        xyz.append(numbers[:3])
        rgb.append(colour)
        error.append(numbers[6])
        tracks.append(tuple(sorted({_integer(path, line, word) for word in words[8::2]})))
    _check_count(path, "points", len(xyz))
    points = SparsePoints(np.array(xyz, np.float64).reshape(-1, 3), np.array(rgb, np.uint8).reshape(-1, 3), np.array(error, np.float64), tuple(tracks))
    return _finite(path, points)
