"""Record3D's export "EXR + JPG": rgb/<number>.jpg, depth/, metadata.json, directly in the folder or in EXR_RGBD/.

Layout: record3d.app's manual and the reader of nerfstudio (record3d_utils). metadata.json holds w, h, K (column by column), for each frame the pose [qx qy qz
qw tx ty tz], camera to world with x right, y up, looking along -z, and in newer versions the lens as [fx fy cx cy]. The world is
ARKit's: y up, metres. depth/<number>.exr holds metres.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from efficientnerf.geometry.cameras import pose_from_colmap, pose_from_opengl
from pipeline.errors import BadInput
from stages.formats.importers import lenses
from stages.formats.importers.brown import brown_camera
from stages.formats.importers.depth import SENSOR_RANGE, DepthFile, depth_file
from stages.formats.importers.frames import Frame, check_count, stated
from stages.formats.importers.listed import Y_UP, Listed, ListFormat
from stages.formats.importers.source import Source, images_in
from stages.io.json_file import numbers, read_json, shown

PLACES = (".", "EXR_RGBD")
METADATA, IMAGES = "metadata.json", "rgb"
_AGAIN = "Export from Record3D again, as EXR + JPG."


def _depth(source: Source, place: Path, frame: Frame, image: Path) -> DepthFile | None:
    return depth_file(source, place / f"depth/{image.stem}.exr", 1.0, farthest=SENSOR_RANGE)


def _signs(source: Source) -> Sequence[Path]:
    for name in PLACES:
        place = source.root / name
        if (place / METADATA).is_file() and images_in(place / IMAGES):
            document = read_json(source.real(place / METADATA), _AGAIN)
            if isinstance(document, dict) and "poses" in document and ("K" in document or "perFrameIntrinsicCoeffs" in document):
                return [place / METADATA]
    return []


def _listed(source: Source, signs: Sequence[Path]) -> Listed:
    place, where = signs[0].parent, source.name_of(signs[0])
    document = read_json(source.real(place / METADATA), _AGAIN)
    poses, coefficients = document["poses"], document.get("perFrameIntrinsicCoeffs") or []
    if not isinstance(poses, list) or not isinstance(coefficients, list) or (coefficients and len(coefficients) != len(poses)):
        raise BadInput(f"{where}: poses are {shown(poses)} and perFrameIntrinsicCoeffs {shown(coefficients)}; expected lists of one length. {_AGAIN}")
    width, height = numbers([document.get("w"), document.get("h")], 2, f"{where}: w, h", _AGAIN)
    size = lenses.image_size(width, height, where, _AGAIN)
    common: list[float] = []
    if not coefficients:
        k = numbers(document.get("K"), 9, f"{where}: K", _AGAIN)  # column by column
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
        fx, fy, cx, cy = common or numbers(coefficients[index], 4, f"{what}: perFrameIntrinsicCoeffs", _AGAIN)
        camera = brown_camera("", size, (fx, fy), (cx, cy), _pose(numbers(poses[index], 7, f"{what}: pose", _AGAIN), what), what)
        listed.append(Frame(image.name, image.parent, what, stated(camera)))
    return Listed(where, listed, signs, rejected=unposed, up=Y_UP, metric=True, depth=partial(_depth, source, place))


def _pose(values: list[float], where: str) -> np.ndarray:
    x, y, z, w, *place = values
    if not 0.99 < np.linalg.norm([x, y, z, w]) < 1.01:
        raise BadInput(f"{where}: quaternion {[x, y, z, w]}; expected a length of 1. {_AGAIN}")
    pose = np.linalg.inv(pose_from_colmap(np.array([w, x, y, z]), np.zeros(3)))  # which takes world to camera
    pose[:3, 3] = place
    return pose_from_opengl(pose)


FORMAT = ListFormat("record3d", f"{METADATA} with poses and K, and {IMAGES}/0.jpg and so on", _signs, _listed)
