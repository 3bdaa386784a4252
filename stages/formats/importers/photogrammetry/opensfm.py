"""OpenSfM and OpenDroneMap (ODM): reconstruction.json, of OpenSfM in the folder itself, of ODM in opensfm/, with the photographs in images/.

Layout and lenses: OpenSfM's documentation, "Dataset structure" and "Geometric models". A shot's `rotation` (axis times angle) and `translation` are world to
camera with x right, y down, z forward. Lengths of the lens are shares of the image's longer side, the centre is that of the image. The world has z up, and
is in metres where the photographs have GPS (`reference_lla`). Points that tracks.csv knows are registered in their images.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from efficientnerf.geometry.cameras import Camera
from pipeline.errors import BadInput
from pipeline.text import printable
from stages.formats.importers import frames, lenses
from stages.formats.importers.brown import brown_camera
from stages.formats.importers.listed import Z_UP, Listed, ListFormat, places_of, sparse_points
from stages.formats.importers.source import Source
from stages.formats.importers.texts import read_text
from stages.io.capture import SparsePoints
from stages.io.json_file import finite, number, numbers, read_json, shown

PLACES = ("opensfm/reconstruction.json", "reconstruction.json")
MAX_POINTS = 2_000_000
_REMEDY = "Reconstruct again, or choose another format with --as."
_BROWN = {
    "perspective": ("k1", "k2"),
    "simple_radial": ("k1",),
    "radial": ("k1", "k2"),
    "brown": ("k1", "k2", "k3", "p1", "p2"),
}
_FISHEYE = {"fisheye": ("k1", "k2"), "fisheye_opencv": ("k1", "k2", "k3", "k4")}


def _listed(source: Source, signs: Sequence[Path]) -> Listed:
    """The reconstruction with most shots."""
    file, where, tracks = signs[0], source.name_of(signs[0]), signs[0].with_name("tracks.csv")
    document = read_json(source.real(file), _REMEDY)
    found = [one for one in document if isinstance(one, dict)] if isinstance(document, list) else []
    found = [one for one in found if isinstance(one.get("shots"), dict) and isinstance(one.get("cameras"), dict)]
    if not found:
        raise BadInput(f"{where}: no reconstruction: expected a list of objects with `cameras` and `shots`. {_REMEDY}")
    best, *others = sorted(found, key=lambda one: len(one["shots"]), reverse=True)
    counts = ", ".join(str(len(one["shots"])) for one in others[:5])
    warning = f"{where}: the reconstruction with {len(best['shots'])} images is used; there are others with {counts}, which share no frame with it."
    origin = best.get("reference_lla")
    return Listed(
        where,
        _frames(source, file, best),
        [file, *([tracks] if tracks.is_file() else [])],
        warnings=[warning] if others else [],
        up=Z_UP,
        metric=isinstance(origin, dict) and any(finite(value) for value in origin.values()),
        facts={"reconstruction": where, "registered": len(best["shots"]), "cameras": len(best["cameras"])},
        finish=lambda capture, kept: replace(capture, points=_points(source, file, best, places_of(kept))),
    )


def _frames(source: Source, file: Path, reconstruction: dict[str, Any]) -> list[frames.Frame]:
    where = source.name_of(file)
    frames.check_count(len(reconstruction["shots"]), where)
    folder = source.root / "images" if (source.root / "images").is_dir() else source.root
    listed = []
    for name, shot in sorted(reconstruction["shots"].items()):
        place = f"{where}: shot {printable(name, frames.MAX_NAME)}"
        if not isinstance(shot, dict):
            raise BadInput(f"{place}: {shown(shot)}; expected an object. {_REMEDY}")
        turn, shift = (np.array(numbers(shot.get(key), 3, f"{place}: {key}", _REMEDY)) for key in ("rotation", "translation"))
        pose = lenses.inverse(rotation_of(turn), shift)
        lens = reconstruction["cameras"].get(shot.get("camera")) if isinstance(shot.get("camera"), str) else None
        if not isinstance(lens, dict):
            raise BadInput(f"{place}: camera {shown(shot.get('camera'))} is not among the cameras. {_REMEDY}")
        listed.append(frames.Frame(name, folder, place, _camera(lens, pose, place), bare=True))
    return listed


def rotation_of(vector: np.ndarray) -> np.ndarray:
    """(3,) axis times angle -> (3, 3), by Rodrigues' formula."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross)


def _camera(lens: dict[str, Any], pose: np.ndarray, where: str) -> frames.CameraOf:
    value = partial(number, lens, where=f"{where}: its camera", remedy=_REMEDY)
    kind = lens.get("projection_type")
    if not isinstance(kind, str) or kind not in _BROWN | _FISHEYE:
        raise BadInput(f"{where}: a {shown(kind)} camera; {', '.join(_BROWN | _FISHEYE)} are read. Undistort the images first (opensfm undistort).")
    used = (_BROWN | _FISHEYE)[kind]
    k = {key: value(key, default=0.0) if key in used else 0.0 for key in ("k1", "k2", "k3", "k4", "p1", "p2")}
    focal = value("focal_x", default=lens.get("focal")), value("focal_y", default=lens.get("focal", lens.get("focal_x")))
    shift = value("c_x", default=0.0), value("c_y", default=0.0)
    stated = lenses.image_size(value("width"), value("height"), where, _REMEDY) if "width" in lens and "height" in lens else None

    def camera(name: str, size: tuple[int, int]) -> Camera:
        width, height = stated or size
        longer = max(width, height)
        fx, fy = focal[0] * longer, focal[1] * longer
        centre = width / 2 + shift[0] * longer, height / 2 + shift[1] * longer
        if kind in _FISHEYE:
            return Camera(name, width, height, "OPENCV_FISHEYE", (fx, fy, *centre, k["k1"], k["k2"], k["k3"], k["k4"]), pose)
        return brown_camera(name, (width, height), (fx, fy), centre, pose, where, (k["k1"], k["k2"], k["k3"]), (k["p1"], k["p2"]))

    return camera


def _points(source: Source, file: Path, reconstruction: dict[str, Any], places: dict[str, int]) -> SparsePoints | None:
    """The reconstruction's points; tracks where tracks.csv has them."""
    points = reconstruction.get("points")
    if not isinstance(points, dict) or not points:
        return None
    where = source.name_of(file)
    if len(points) > MAX_POINTS:
        raise BadInput(f"{where}: {len(points)} points; at most {MAX_POINTS} are read. {_REMEDY}")
    xyz, rgb = [], []
    for name, point in points.items():
        if not isinstance(point, dict):
            raise BadInput(f"{where}: point {printable(name, 40)}: {shown(point)}; expected an object. {_REMEDY}")
        xyz.append(numbers(point.get("coordinates"), 3, f"{where}: point {printable(name, 40)}", _REMEDY))
        rgb.append(numbers(point.get("color", [128, 128, 128]), 3, f"{where}: colour of point {printable(name, 40)}", _REMEDY))
    tracks = _tracks(source, file.with_name("tracks.csv"), {name: index for index, name in enumerate(points)}, places)
    return sparse_points(np.array(xyz), np.array(rgb), tracks)


def _tracks(source: Source, file: Path, points: dict[str, int], places: dict[str, int]) -> list[tuple[int, ...]] | None:
    """Of each point the photos that see it, from the lines "image TAB track TAB ..."; None where there is no such file."""
    if not file.is_file():
        return None
    tracks: list[set[int]] = [set() for _ in points]
    for line in read_text(source.real(file)).splitlines():
        words = line.split("\t", 2)
        if len(words) == 3 and words[1] in points and words[0] in places:
            tracks[points[words[1]]].add(places[words[0]])
    return [tuple(sorted(track)) for track in tracks]


FORMAT = ListFormat("opensfm", " or ".join(PLACES), lambda source: source.first_of(PLACES), _listed)
