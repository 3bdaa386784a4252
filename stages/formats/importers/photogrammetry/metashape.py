"""Agisoft Metashape's camera export ("File > Export > Export Cameras", Agisoft XML) next to the photographs.

Layout: the XML files that Metashape 1.5 to 2.2 write; lens: the Metashape user manual, appendix "Camera models" (frame and fisheye cameras)

    u = w/2 + cx + x' f + x' b1 + y' b2      v = h/2 + cy + y' f      x' = x (1 + k1 r^2 + ... + k4 r^8) + p1 (r^2 + 2 x^2) + 2 p2 x y

so that its p1, p2 are OpenCV's p2, p1. A camera's `transform` is camera to chunk, row by row, with x right, y down, z forward; the transform of the chunk (or
of the component) leads on to the frame of the project, in metres. A geocentric project lies millions of metres from its origin: there the shift is left out.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from efficientnerf.geometry.cameras import Camera, Similarity
from pipeline.errors import BadInput
from pipeline.text import printable
from stages.formats.importers import frames, lenses
from stages.formats.importers.brown import brown_camera, without_skew
from stages.formats.importers.listed import Listed, ListFormat
from stages.formats.importers.photogrammetry.xml import read_xml
from stages.formats.importers.source import Source
from stages.formats.importers.texts import head, number, numbers

FARTHEST = 1e5  # metres from the origin: beyond it coordinates are geocentric or projected, and the shift is left out
PARAMETERS = ("f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4")
_ALIGN = "Align the photographs in Metashape and export the cameras again."


def _camera_files(source: Source) -> list[Path]:
    """The files of the folder that hold cameras of Metashape."""
    found = []
    for path in sorted(source.root.glob("*.xml")):
        text = head(source.real(path)) if path.is_file() else ""
        if "<document" in text and "<chunk" in text:
            found.append(path)
    return found


def _listed(source: Source, found: Sequence[Path]) -> Listed:
    where = source.name_of(found[0])
    root = read_xml(source.real(found[0]))
    chunks = [chunk for chunk in root.iter("chunk") if chunk.find("cameras") is not None]
    if not chunks:
        raise BadInput(f"{where}: no chunk with cameras. {_ALIGN}")
    chunk = max(chunks, key=lambda one: sum(camera.find("transform") is not None for camera in _cameras(one)))  # the first of equals
    warnings = [f"{where}: {len(chunks)} chunks; the one with most cameras is used."] if len(chunks) > 1 else []
    cameras = list(_cameras(chunk))
    frames.check_count(len(cameras), where)
    components = {one.get("id"): one for one in chunk.iterfind("components/component")}
    aligned = Counter(one.get("component_id") for one in cameras if one.find("transform") is not None)
    component = aligned.most_common(1)[0][0] if aligned else None
    transform = chunk.find("transform")
    if transform is None and component in components:
        transform = components[component].find("transform")
    world, metric, up, remark = _world(transform, where)
    if remark:
        warnings.append(remark)
    sensors = {one.get("id"): one for one in chunk.iterfind("sensors/sensor")}

    @cache
    def sensor(of: str | None) -> Camera:
        return _sensor(sensors.get(of), f"{where}: sensor {printable(of, 20)}", warnings)

    listed: list[frames.Frame] = []
    rejected: list[tuple[str, str]] = []
    for index, one in enumerate(cameras):
        label = one.get("label") or ""
        name = printable(label, frames.MAX_NAME)
        matrix, place = one.find("transform"), f"{where}: camera {index} ({name})"
        if matrix is None:
            rejected.append((name, "not aligned in Metashape"))
        elif one.get("enabled") in ("0", "false"):
            rejected.append((name, "disabled in Metashape"))
        elif one.get("component_id") != component:
            rejected.append((name, "in another component"))
        else:
            pose = lenses.rigid(numbers((matrix.text or "").split(), 16, f"{place}: transform").reshape(4, 4), place)
            camera = replace(sensor(one.get("sensor_id")), world_from_camera=world.pose(pose))
            listed.append(frames.Frame(label, source.root, place, frames.stated(camera), bare=True))
    facts: dict[str, object] = {"label": printable(chunk.get("label") or "", frames.MAX_NAME), "sensors": len(sensors)}
    return Listed(where, listed, [found[0]], rejected, warnings, up, metric=metric, facts=facts)


def _cameras(chunk: Element) -> Iterator[Element]:
    cameras = chunk.find("cameras")
    if cameras is not None:
        yield from cameras.iter("camera")  # within groups, too


def _sensor(element: Element | None, where: str, warnings: list[str]) -> Camera:
    """A camera at the origin; what is left out of it goes into the warnings. Raises BadInput where the sensor is missing, not calibrated, or of a type that no
    camera model describes."""
    if element is None:
        raise BadInput(f"{where}: listed by a camera, and missing. {_ALIGN}")
    kind = element.get("type") or "frame"
    calibrations = {one.get("class"): one for one in element.iterfind("calibration")}
    calibration = calibrations.get("adjusted", calibrations.get("initial", calibrations.get(None)))
    if calibration is None:
        raise BadInput(f"{where}: not calibrated. {_ALIGN}")
    resolution = calibration.find("resolution")
    resolution = element.find("resolution") if resolution is None else resolution
    if resolution is None:
        raise BadInput(f"{where}: no resolution. {_ALIGN}")
    sides = numbers([resolution.get("width") or "", resolution.get("height") or ""], 2, f"{where}: resolution")
    size = lenses.image_size(sides[0], sides[1], where, _ALIGN)
    k = {key: number(calibration.findtext(key) or "0", f"{where}: {key}") for key in PARAMETERS}
    if not k["f"] > 0:
        raise BadInput(f"{where}: focal length {k['f']:g}; expected more than zero pixels. {_ALIGN}")
    if k["p3"] or k["p4"]:
        raise BadInput(f"{where}: p3, p4 are in no camera model that is supported. Export undistorted images and their cameras instead.")
    focal, centre = (k["f"] + k["b1"], k["f"]), (size[0] / 2 + k["cx"], size[1] / 2 + k["cy"])
    if remark := without_skew(k["b2"], k["f"], size, centre[1], "b2 (skew)", where):
        warnings.append(f"{where}: {remark}.")
    if kind == "frame":
        return brown_camera("", size, focal, centre, np.eye(4), where, (k["k1"], k["k2"], k["k3"], k["k4"]), (k["p2"], k["p1"]))
    if kind == "fisheye":
        if k["p1"] or k["p2"]:
            raise BadInput(f"{where}: a fisheye lens with p1, p2, which no camera model that is supported has. Align again without them.")
        return Camera("", *size, "OPENCV_FISHEYE", (*focal, *centre, k["k1"], k["k2"], k["k3"], k["k4"]), np.eye(4))
    raise BadInput(f"{where}: a {printable(kind, 40)} camera; frame and fisheye cameras are read. Export undistorted images and their cameras instead.")


def _world(transform: Element | None, where: str) -> tuple[Similarity, bool, np.ndarray | None, str | None]:
    """The frame of the project from that of the chunk, whether it is metric, the way up where that is known, and a warning."""
    if transform is None or transform.find("rotation") is None:
        return Similarity.identity(), False, None, None
    turn = lenses.rotation(numbers((transform.findtext("rotation") or "").split(), 9, f"{where}: rotation of the chunk").reshape(3, 3), f"{where}: chunk")
    shift = numbers((transform.findtext("translation") or "0 0 0").split(), 3, f"{where}: translation of the chunk")
    scale = number(transform.findtext("scale") or "1", f"{where}: scale of the chunk")
    if not 1e-9 < scale < 1e9:
        raise BadInput(f"{where}: scale of the chunk {scale:g}; expected a positive number. {_ALIGN}")
    metric = transform.find("scale") is not None
    distance = float(np.linalg.norm(shift))
    if distance <= FARTHEST:
        return Similarity(scale, turn, shift), metric, None, None
    warning = f"{where}: the project lies {distance:.3g} m from the origin of its coordinates; positions are from the chunk's own origin."
    up = shift / distance if 6.2e6 < distance < 6.5e6 else None  # geocentric: away from the middle of the earth
    return Similarity(scale, turn, np.zeros(3)), metric, up, warning


FORMAT = ListFormat("metashape", "an XML file with the cameras of Metashape next to the photographs", _camera_files, _listed, single=True)
