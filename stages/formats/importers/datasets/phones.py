"""Exports of apps that track a phone by ARKit, in a table as `published`. All state camera to world with x right, y up, looking along -z; the world is ARKit's:
y up, metres. Depth is the sensor's.

    polycam         the raw data (developer mode), as the README of PolyCam/polyform says: keyframes/ with images, cameras, and their corrected versions. A file
                    of cameras is named as its image and holds fx fy cx cy width height and the rows t_00 ... t_23. Corrected cameras belong to corrected
                    images, which are undistorted; the two kinds share no frame and are not mixed. depth/ holds millimetres, confidence/ 0, 127 or 255
    record3d        "EXR + JPG", directly in the folder or in EXR_RGBD/, as record3d.app's manual and nerfstudio's record3d_utils have it: rgb/<number>.jpg and
                    metadata.json with w, h, K (column by column), for each frame the pose [qx qy qz qw tx ty tz], and in newer versions the lens as
                    [fx fy cx cy]. depth/<number>.exr holds metres
    3d-scanner-app  "All Data" (Laan Labs), as PSegs (ios_lidar) and nuwa (from_3dscannerapp) read it: frame_00000.jpg next to frame_00000.json, directly in the
                    folder or in the only folder that it holds. cameraPoseARFrame is ARCamera.transform row by row, for the picture as the sensor has it
                    (landscape); intrinsics are K row by row, in pixels of the picture. There are more poses than pictures. Scans in low resolution have
                    depth_00000.png, millimetres, and conf_00000.png, ARConfidenceLevel: 0, 1 or 2
"""

import re
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from itertools import islice
from pathlib import Path

import numpy as np

from efficientnerf.geometry.cameras import Camera, pose_from_colmap, pose_from_opengl
from pipeline.errors import BadInput
from stages.formats.importers import lenses
from stages.formats.importers.brown import brown_camera
from stages.formats.importers.depth import MILLIMETRE, DepthFile, depth_file
from stages.formats.importers.frames import CameraOf, Frame, check_count, stated
from stages.formats.importers.listed import Y_UP, Listed, ListFormat
from stages.formats.importers.source import Source, images_in
from stages.io.json_file import number, numbers, read_json, read_object, shown

SENSOR_RANGE = 5.0  # metres
POLYCAM_HIGH, SCANNER_HIGH = 255, 2  # confidence; below is medium
LARGEST_FRAME = 1 << 20  # bytes of a file with one camera

# Polycam
KEYFRAMES = "keyframes"
POLYCAM_EXPECTED = f"{KEYFRAMES}/images with {KEYFRAMES}/cameras, or their corrected versions"
POLYCAM_IMAGES = {"corrected_cameras": "corrected_images", "cameras": "images"}  # the folders of cameras, the better ones first, and of their images
POLYCAM_AGAIN = "Export the raw data again."


def _polycam_signs(source: Source) -> Sequence[Path]:
    """The cameras of the first folder that has any, and images."""
    for cameras, images in POLYCAM_IMAGES.items():
        found = sorted(path for path in (source.root / KEYFRAMES / cameras).glob("*.json") if path.is_file())
        if found and images_in(source.root / KEYFRAMES / images):
            return [source.check_inside(path) for path in found]
    return []


def _polycam(source: Source, signs: Sequence[Path]) -> Listed:
    cameras = signs[0].parent.name
    where, place = f"{KEYFRAMES}/{cameras}", source.root / KEYFRAMES / POLYCAM_IMAGES[cameras]
    raw = "keyframes/corrected_cameras is not there: the phone's own poses and images with some distortion are used. Process with loop closure."
    posed = {path.stem for path in signs}
    check_count(len(signs), where)
    listed = [Frame(path.stem, place, source.name_of(path), stated(_polycam_camera(source, path)), bare=True) for path in signs]
    rejected = [(source.name_of(path), "without a camera file") for path in images_in(place) if path.stem not in posed]
    warnings = [raw] if cameras == "cameras" else []

    def depth(frame: Frame, image: Path) -> DepthFile | None:
        name, maps = f"{image.stem}.png", source.root / KEYFRAMES
        return depth_file(source, maps / "depth" / name, MILLIMETRE, maps / "confidence" / name, POLYCAM_HIGH, SENSOR_RANGE)

    return Listed(where, listed, signs, rejected, warnings, Y_UP, metric=True, facts={"cameras": cameras}, depth=depth)


def _polycam_camera(source: Source, path: Path) -> Camera:
    where = source.name_of(path)
    document = read_object(source.real(path), where, POLYCAM_AGAIN, limit=LARGEST_FRAME)
    value = partial(number, document, where=where, remedy=POLYCAM_AGAIN)
    size = lenses.image_size(value("width"), value("height"), where, POLYCAM_AGAIN)
    rows = [[value(f"t_{row}{column}") for column in range(4)] for row in range(3)]
    pose = pose_from_opengl(lenses.rigid([*rows, [0, 0, 0, 1]], where))
    return brown_camera("", size, (value("fx"), value("fy")), (value("cx"), value("cy")), pose, where)


# Record3D
METADATA, IMAGES = "metadata.json", "rgb"
RECORD3D_AGAIN = "Export from Record3D again, as EXR + JPG."


def _record3d_signs(source: Source) -> Sequence[Path]:
    for name in (".", "EXR_RGBD"):
        place = source.root / name
        if (place / METADATA).is_file() and images_in(place / IMAGES):
            document = read_json(source.real(place / METADATA), RECORD3D_AGAIN)
            if isinstance(document, dict) and "poses" in document and ("K" in document or "perFrameIntrinsicCoeffs" in document):
                return [place / METADATA]
    return []


def _record3d(source: Source, signs: Sequence[Path]) -> Listed:
    place, where = signs[0].parent, source.name_of(signs[0])
    document = read_json(source.real(place / METADATA), RECORD3D_AGAIN)
    poses, coefficients = document["poses"], document.get("perFrameIntrinsicCoeffs") or []
    if not isinstance(poses, list) or not isinstance(coefficients, list) or (coefficients and len(coefficients) != len(poses)):
        raise BadInput(f"{where}: poses are {shown(poses)} and perFrameIntrinsicCoeffs {shown(coefficients)}; expected lists of one length. {RECORD3D_AGAIN}")
    width, height = numbers([document.get("w"), document.get("h")], 2, f"{where}: w, h", RECORD3D_AGAIN)
    size = lenses.image_size(width, height, where, RECORD3D_AGAIN)
    common: list[float] = []
    if not coefficients:
        k = numbers(document.get("K"), 9, f"{where}: K", RECORD3D_AGAIN)  # column by column
        common = [k[0], k[4], k[6], k[7]]
    listed, unposed = [], []
    images = images_in(place / IMAGES)
    check_count(len(images), where)
    for image in sorted(images, key=lambda path: (len(path.stem), path.stem)):
        index = int(image.stem) if image.stem.isascii() and image.stem.isdecimal() and len(image.stem) < 10 else len(poses)
        if index >= len(poses):
            unposed.append((source.name_of(image), "without a pose"))
            continue
        what = f"{where}: frame {index}"
        fx, fy, cx, cy = common or numbers(coefficients[index], 4, f"{what}: perFrameIntrinsicCoeffs", RECORD3D_AGAIN)
        camera = brown_camera("", size, (fx, fy), (cx, cy), _record3d_pose(numbers(poses[index], 7, f"{what}: pose", RECORD3D_AGAIN), what), what)
        listed.append(Frame(image.name, image.parent, what, stated(camera)))

    def depth(frame: Frame, image: Path) -> DepthFile | None:
        return depth_file(source, place / f"depth/{image.stem}.exr", 1.0, farthest=SENSOR_RANGE)

    return Listed(where, listed, signs, unposed, up=Y_UP, metric=True, depth=depth)


def _record3d_pose(values: list[float], where: str) -> np.ndarray:
    x, y, z, w, *place = values
    if not 0.99 < np.linalg.norm([x, y, z, w]) < 1.01:
        raise BadInput(f"{where}: quaternion {[x, y, z, w]}; expected a length of 1. {RECORD3D_AGAIN}")
    pose = np.linalg.inv(pose_from_colmap(np.array([w, x, y, z]), np.zeros(3)))  # which takes world to camera
    pose[:3, 3] = place
    return pose_from_opengl(pose)


# 3D Scanner App
POSE, INTRINSICS = "cameraPoseARFrame", "intrinsics"
OFF_CENTRE = 0.1  # of a side: as far as the principal point of a picture that was neither cropped nor scaled may lie from its middle
_FRAME = re.compile(r"frame_\d+")
_TRIED = 10  # frames that are read to recognise the format, for some may be damaged
SCANNER_AGAIN = "Export from 3D Scanner App again, as All Data."


def _scanner_signs(source: Source) -> Sequence[Path]:
    """The JSON files of the pictures that have one."""
    # The frames lie in the source, or in what is in it where that is one folder and nothing else, as the app packs them.
    inside = list(islice((path for path in source.root.iterdir() if not path.name.startswith((".", "__MACOSX"))), 2))
    place = inside[0] if len(inside) == 1 and inside[0].is_dir() and not inside[0].is_symlink() else source.root
    listed = (path.with_suffix(".json") for path in _scanner_pictures(place))
    return [source.check_inside(path) for path in listed if path.is_file()]


def _scanner_recognised(source: Source, signs: Sequence[Path]) -> bool:
    for path in signs[:_TRIED]:
        with suppress(BadInput):  # reported where it is read
            document = read_json(source.real(path), SCANNER_AGAIN, limit=LARGEST_FRAME)
            if isinstance(document, dict) and POSE in document:
                return True
    return False


def _scanner(source: Source, signs: Sequence[Path]) -> Listed:
    place, posed = signs[0].parent, {path.stem: path for path in signs}
    where = source.name_of(place / "frame_*.json")
    check_count(len(signs), where)
    listed: list[Frame] = []
    rejected: list[tuple[str, str]] = []
    for path in _scanner_pictures(place):
        if path.stem in posed:
            listed.append(Frame(path.name, place, source.name_of(posed[path.stem]), _scanner_camera(source, posed[path.stem])))
        else:
            rejected.append((source.name_of(path), "without a pose"))
    poses = sum(1 for path in place.glob("frame_*.json") if _FRAME.fullmatch(path.stem))
    facts: dict[str, object] = {"poses_without_picture": poses - len(listed)}

    def depth(frame: Frame, image: Path) -> DepthFile | None:
        digits = image.stem.removeprefix("frame_")
        return depth_file(source, place / f"depth_{digits}.png", MILLIMETRE, place / f"conf_{digits}.png", SCANNER_HIGH, SENSOR_RANGE)

    return Listed(where, listed, signs, rejected, up=Y_UP, metric=True, facts=facts, depth=depth)


def _scanner_pictures(place: Path) -> list[Path]:
    return [path for path in images_in(place) if _FRAME.fullmatch(path.stem)]


def _scanner_camera(source: Source, path: Path) -> CameraOf:
    """The camera of a frame for a picture of a size, which the frame does not state. Raises BadInput, as does what is returned."""
    where = source.name_of(path)
    document = read_object(source.real(path), where, SCANNER_AGAIN, limit=LARGEST_FRAME)
    matrix = numbers(document.get(POSE), 16, f"{where}: {POSE}", SCANNER_AGAIN)
    pose = pose_from_opengl(lenses.rigid(np.reshape(matrix, (4, 4)), where))
    k = numbers(document.get(INTRINSICS), 9, f"{where}: {INTRINSICS}", SCANNER_AGAIN)
    if k[1] or k[3] or k[6] or k[7] or k[8] != 1:
        raise BadInput(f"{where}: {INTRINSICS} are {k}; expected fx 0 cx 0 fy cy 0 0 1 (are they transposed?). {SCANNER_AGAIN}")

    def at(name: str, size: tuple[int, int]) -> Camera:
        for width, height in (size, size[::-1]):  # a picture that EXIF turns has its camera stated for the pixels as stored
            if abs(k[2] - width / 2) <= OFF_CENTRE * width and abs(k[5] - height / 2) <= OFF_CENTRE * height:
                return brown_camera(name, (width, height), (k[0], k[4]), (k[2], k[5]), pose, where)
        raise BadInput(
            f"{where}: the principal point {k[2]:g}, {k[5]:g} is not near the middle of the picture of {size[0]}x{size[1]}. Was it cropped or scaled? "
            f"{SCANNER_AGAIN}"
        )

    return at


POLYCAM = ListFormat("polycam", POLYCAM_EXPECTED, _polycam_signs, _polycam)
RECORD3D = ListFormat("record3d", f"{METADATA} with poses and K, and {IMAGES}/0.jpg and so on", _record3d_signs, _record3d)
SCANNER_APP = ListFormat("3d-scanner-app", "frame_00000.jpg next to frame_00000.json and so on", _scanner_signs, _scanner, _scanner_recognised)
