"""Kapture: sensors/ with sensors.txt, records_camera.txt, trajectories.txt and rigs.txt, images in sensors/records_data/.

Layout: kapture_format.adoc of naver/kapture, versions 1.0 and 1.1. Values are separated by commas. Poses are world to device, quaternion w x y z and
translation, as COLMAP's; those of rigs are rig to sensor, so that a sensor's is the one after the other. Sensors have COLMAP's models. Points are read with
the images that see them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from efficientnerf.geometry.cameras import MODELS, Camera, pose_from_colmap
from pipeline.errors import BadInput
from pipeline.text import printable
from stages.formats.importers import frames
from stages.formats.importers.colmap_model import FISHEYE, as_traced, count_parameters
from stages.formats.importers.source import ImportSettings, Source
from stages.formats.importers.texts import head, number, numbers, read_text
from stages.io.capture import Capture, SparsePoints

SENSORS, RECORDS, TRAJECTORIES, RIGS = (f"sensors/{name}.txt" for name in ("sensors", "records_camera", "trajectories", "rigs"))
POINTS, OBSERVATIONS = "reconstruction/points3d.txt", "reconstruction/observations.txt"
IMAGES = "sensors/records_data"
MAX_POINTS = 5_000_000
MAX_RIGS = 8  # within each other
_AGAIN = "Write the data set again, or choose another format with --as."


@dataclass
class _Devices:
    """Sensors and how they are carried.

    lenses  sensor -> camera at the origin
    mounts  sensor or rig -> (the rig that carries it, sensor from rig)
    poses   (timestamp, device) -> device from world
    """

    lenses: dict[str, Camera] = field(default_factory=dict)
    mounts: dict[str, list[tuple[str, np.ndarray]]] = field(default_factory=dict)
    poses: dict[tuple[str, str], np.ndarray] = field(default_factory=dict)

    def pose(self, timestamp: str, device: str, depth: int = 0) -> np.ndarray | None:
        """(4, 4) device from world, by its own trajectory or that of the rig that carries it; None where there is neither."""
        own = self.poses.get((timestamp, device))
        if own is not None or depth >= MAX_RIGS:
            return own
        for rig, mounted in self.mounts.get(device, []):
            carried = self.pose(timestamp, rig, depth + 1)
            if carried is not None:
                return np.asarray(mounted @ carried)
        return None


def recognises(folder: Path, allow_outside: bool = False) -> bool:
    source = Source(folder, allow_outside)
    path = folder / SENSORS
    return path.is_file() and "kapture format" in head(source.real(path), 200)


def files(folder: Path, settings: ImportSettings) -> list[Path]:
    """The text files that are there, the images and their masks."""
    source = Source(folder, settings.allow_outside)
    texts = [folder / name for name in (SENSORS, RECORDS, TRAJECTORIES, RIGS, POINTS, OBSERVATIONS) if (folder / name).is_file()]
    return [*texts, *frames.files_of(source, _frames(source)[0])]


def read(folder: Path, settings: ImportSettings) -> Capture:
    """The capture that the records describe. Raises BadInput."""
    source = Source(folder, settings.allow_outside)
    listed, unposed = _frames(source)
    return frames.capture_of(
        source,
        listed,
        settings,
        kind="kapture",
        where=RECORDS,
        rejected=[(name, "without a pose") for name in unposed],
        points=lambda places: _points(source, places),
    )


def _rows(source: Source, name: str, least: int) -> Iterator[tuple[str, list[str]]]:
    """(place for messages, values) of each line that is no comment; none where there is no such file."""
    path = source.root / name
    if not path.is_file():
        return
    for index, line in enumerate(read_text(source.real(path)).splitlines(), 1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        values = [value.strip() for value in line.split(",")]
        if len(values) < least:
            raise BadInput(f"{name}: line {index} has {len(values)} values, expected {least} or more. {_AGAIN}")
        yield f"{name}: line {index}", values


def _transform(values: list[str], where: str) -> np.ndarray:
    """(4, 4) of qw qx qy qz tx ty tz."""
    found = numbers(values, 7, where)
    length = float(np.linalg.norm(found[:4]))
    if not 0.99 < length < 1.01:
        raise BadInput(f"{where}: quaternion of length {length:g}, expected 1. {_AGAIN}")
    return np.linalg.inv(pose_from_colmap(found[:4], found[4:]))


def _devices(source: Source) -> _Devices:
    devices = _Devices()
    for where, values in _rows(source, SENSORS, 3):
        if values[2] != "camera":
            continue
        model, params = (values[3] if len(values) > 3 else ""), values[4:]
        if (count := count_parameters(model)) is None:
            supported = ", ".join([*MODELS, *FISHEYE])
            raise BadInput(f"{where}: camera model {printable(model, 40) or 'missing'}; supported are {supported}. Undistort the images first.")
        lens = numbers(params, 2 + count, where)
        if (lens[:2] != np.rint(lens[:2])).any() or not 0 < lens[:2].min() <= lens[:2].max() <= 65535:
            raise BadInput(f"{where}: image size {lens[0]:g}x{lens[1]:g}; expected whole pixels. {_AGAIN}")
        devices.lenses[values[0]] = Camera("", int(lens[0]), int(lens[1]), *as_traced(model, tuple(lens[2:].tolist())), np.eye(4))
    for where, values in _rows(source, RIGS, 9):
        devices.mounts.setdefault(values[1], []).append((values[0], _transform(values[2:9], where)))
    for where, values in _rows(source, TRAJECTORIES, 9):
        if "" not in values[2:9]:  # only a place, or only a direction, is known
            devices.poses[values[0], values[1]] = _transform(values[2:9], where)
    return devices


def _frames(source: Source) -> tuple[list[frames.Frame], list[str]]:
    """The frames, and the images without a pose."""
    if not (source.root / RECORDS).is_file():
        raise BadInput(f"{source.root}: no {RECORDS}. Name the folder of a data set of Kapture, or choose another format with --as.")
    devices = _devices(source)
    listed, unposed = [], []
    for where, values in _rows(source, RECORDS, 3):
        timestamp, sensor, name = values[:3]
        if sensor not in devices.lenses:
            raise BadInput(f"{where}: sensor {printable(sensor, 40)} is no camera of {SENSORS}. {_AGAIN}")
        found = devices.pose(timestamp, sensor)
        if found is None:
            unposed.append(printable(name, frames.MAX_NAME))
            continue
        camera = replace(devices.lenses[sensor], world_from_camera=np.linalg.inv(found))
        place = f"{where} ({printable(name, frames.MAX_NAME)})"
        listed.append(frames.Frame(name, source.root / IMAGES, place, frames.stated(camera)))
        frames.check_count(len(listed), RECORDS)
    return listed, unposed


def _points(source: Source, places: dict[str, int]) -> SparsePoints | None:
    rows = []
    for where, values in _rows(source, POINTS, 3):
        rows.append([number(value, where) for value in values[:6]] + [128.0] * (6 - len(values[:6])))
        if len(rows) > MAX_POINTS:
            raise BadInput(f"{POINTS}: more than {MAX_POINTS} points; that many are not read.")
    if not rows:
        return None
    tracks: list[set[int]] = [set() for _ in rows]
    for where, values in _rows(source, OBSERVATIONS, 1):
        index = number(values[0], where)
        first = 1 if len(values) % 2 else 2  # from version 1.1 on with the type of the features
        if index != int(index) or not 0 <= index < len(rows):
            raise BadInput(f"{where}: point {index:g} of {len(rows)}. {_AGAIN}")
        tracks[int(index)].update(places[name] for name in values[first::2] if name in places)
    array = np.array(rows)
    return frames.sparse_points(array[:, :3], array[:, 3:], [tuple(sorted(track)) for track in tracks])
