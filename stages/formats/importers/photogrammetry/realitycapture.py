"""RealityCapture (RealityScan): its table of internal and external camera parameters (CSV), or XMP files next to the photographs.

Layout: the application's help, "Export registration", and the article "RealityCapture XMP camera math". Lengths of the lens are shares of the image's longer
side: `f` and FocalLength35mm in 36ths, px, py and PrincipalPointU, V as they are, from the middle of the image.

    CSV   x y alt is the camera's place; heading, pitch, roll (degrees) turn a camera that looks along -z with y up: Rz(-heading) Rx(pitch) Ry(roll)
    XMP   Rotation is world to camera, row by row, with x right, y down, z forward; Position is the camera's place

Both worlds have z up. Distortion is Brown's, in the order k1 k2 k3 k4 t1 t2, with t1, t2 OpenCV's p2, p1 (as AliceVision's importer reads them).
"""

import csv
import io
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from efficientnerf.geometry.cameras import Camera, Similarity, pose_from_opengl
from pipeline.errors import BadInput
from pipeline.text import printable
from stages.formats.importers import frames, lenses
from stages.formats.importers.brown import brown_camera
from stages.formats.importers.listed import Z_UP, Listed, ListFormat
from stages.formats.importers.photogrammetry.xml import read_xml
from stages.formats.importers.source import Source
from stages.formats.importers.texts import head, number, numbers, read_text

REQUIRED = ("name", "x", "y", "alt", "heading", "pitch", "roll", "f")
FILM = 36.0  # millimetres, the longer side of a frame of 35 mm film
XCR = "{http://www.capturingreality.com/ns/xcr/1.1#}"
RDF = "{http://www.w3.org/1999/02/22-rdf-syntax-ns#}"
LARGEST_SIDECAR = 1 << 20  # bytes
_PLACES = (".", "images", "input", "photos")
_REMEDY = "Export the registration again."
_BROWN = {"perspective": 0, "none": 0, "brown3": 3, "brown3t2": 5, "brown4": 4, "brown4t2": 6}


def _signs(source: Source) -> Sequence[Path]:
    return _tables(source) or _sidecars(source, first=True)


def _listed(source: Source, signs: Sequence[Path]) -> Listed:
    tables, sidecars = _tables(source), _sidecars(source)
    if not tables:
        return _from_sidecars(source, sidecars)
    warnings = [f"{source.name_of(tables[0])} is read; the XMP files next to the photographs are not."] if sidecars else []
    return _from_table(source, tables[0], warnings)


# --- CSV


def _columns(line: str) -> tuple[str, list[str]]:
    """The separator of a table, and the names of its columns."""
    separator = max(",;\t", key=line.count)
    return separator, [name.strip().lstrip("#").strip().lower() for name in line.split(separator)]


def _title(text: str) -> tuple[int, str] | None:
    """Number and text of the line that names the columns, among the first few; None where none does."""
    for number_of, line in enumerate(text.splitlines()[:5]):
        if set(REQUIRED) <= set(_columns(line)[1]):
            return number_of, line
    return None


def _tables(source: Source) -> list[Path]:
    return [path for path in sorted(source.root.glob("*.csv")) if path.is_file() and _title(head(source.real(path))) is not None]


def _from_table(source: Source, file: Path, warnings: list[str]) -> Listed:
    where = source.name_of(file)
    text = read_text(source.real(file))
    title = _title(text)
    if title is None:
        raise BadInput(f"{where}: no line names the columns {', '.join(REQUIRED)}. {_REMEDY}")
    separator, columns = _columns(title[1])
    rows = csv.reader(io.StringIO("\n".join(text.splitlines()[title[0] + 1 :])), delimiter=separator)
    listed: list[frames.Frame] = []
    try:
        for index, cells in enumerate(rows, title[0] + 2):
            if not any(cell.strip() for cell in cells):
                continue
            if len(cells) < len(columns):
                raise BadInput(f"{where}: line {index} has {len(cells)} of {len(columns)} columns. {_REMEDY}")
            listed.append(_row(source, f"{where}: line {index}", dict(zip(columns, (cell.strip() for cell in cells), strict=False))))
            frames.check_count(len(listed), where)
    except csv.Error as error:
        raise BadInput(f"{where}: {printable(error, 100)}. {_REMEDY}") from None
    return Listed(where, listed, [file], warnings=warnings, up=Z_UP, facts={"registration": where})


def _row(source: Source, where: str, cells: dict[str, str]) -> frames.Frame:
    def value(key: str) -> float:
        return number(cells.get(key) or "0", f"{where}: {key}")

    where = f"{where} ({printable(cells['name'], frames.MAX_NAME)})"
    heading, pitch, roll = np.radians([value("heading"), value("pitch"), value("roll")])
    turn = _about("z", -heading) @ _about("x", pitch) @ _about("y", roll)
    pose = Similarity(1.0, turn, np.array([value("x"), value("y"), value("alt")])).matrix()
    radial, tangential = (value("k1"), value("k2"), value("k3"), value("k4")), (value("t2"), value("t1"))
    lens = _lens(value("f"), (value("px"), value("py")), radial, tangential, pose_from_opengl(pose), where)
    return frames.Frame(cells["name"], source.root, where, lens, bare=True)


def _about(axis: str, angle: float) -> np.ndarray:
    """(3, 3) right-handed rotation about an axis, radians."""
    c, s = np.cos(angle), np.sin(angle)
    return {
        "x": np.array([[1, 0, 0], [0, c, -s], [0, s, c]]),
        "y": np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]),
        "z": np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]),
    }[axis]


def _lens(
    focal: float, principal: tuple[float, float], radial: Sequence[float], tangential: tuple[float, float], pose: np.ndarray, where: str
) -> frames.CameraOf:
    """The camera of an image by its size: lengths are stated as shares of its longer side."""

    def camera(name: str, size: tuple[int, int]) -> Camera:
        if not focal > 0:
            raise BadInput(f"{where}: focal length {focal:g}; expected more than zero. {_REMEDY}")
        longer = max(size)
        pixels = focal / FILM * longer
        centre = size[0] / 2 + principal[0] * longer, size[1] / 2 + principal[1] * longer
        return brown_camera(name, size, (pixels, pixels), centre, pose, where, radial, tangential)

    return camera


# --- XMP


def _sidecars(source: Source, first: bool = False) -> list[Path]:
    """The XMP files that state a camera, or the first of them, in the first folder of the usual ones that holds any."""
    for place in _PLACES:
        found = []
        for path in sorted((source.root / place).glob("*.xmp")):
            if path.is_file() and XCR[1:-1] in head(source.real(path)) and "Rotation" in head(source.real(path), LARGEST_SIDECAR):
                found.append(path)
                if first:
                    break
        if found:
            return found
    return []


def _from_sidecars(source: Source, found: list[Path]) -> Listed:
    listed: list[frames.Frame] = []
    frames.check_count(len(found), source.name_of(found[0].parent))
    for path in found:
        where = source.name_of(path)
        root = read_xml(source.real(path), LARGEST_SIDECAR)
        described = [one for one in root.iter(f"{RDF}Description") if _stated(one, "Rotation") is not None]
        if not described:
            continue  # that of another program
        listed.append(frames.Frame(path.stem, path.parent, where, _sidecar(partial(_stated, described[0]), where), bare=True))
    where = f"{len(listed)} XMP files"
    return Listed(where, listed, found, up=Z_UP, facts={"registration": where})


def _stated(description: Element, key: str) -> str | None:
    """A value that stands as an attribute or as an element."""
    value = description.get(f"{XCR}{key}")
    return value if value is not None else description.findtext(f"{XCR}{key}")


def _sidecar(stated: Callable[[str], str | None], where: str) -> frames.CameraOf:
    def value(key: str, default: str) -> float:
        return number(stated(key) or default, f"{where}: {key}")

    turn = numbers((stated("Rotation") or "").split(), 9, f"{where}: Rotation").reshape(3, 3)
    place = numbers((stated("Position") or "").split(), 3, f"{where}: Position")
    pose = Similarity(1.0, lenses.rotation(turn, f"{where}: Rotation").T, place).matrix()
    model = (stated("DistortionModel") or "none").lower()
    words = (stated("DistortionCoeficients") or "").split()  # so spelled
    k = [number(word, f"{where}: DistortionCoeficients") for word in words[:6]]
    k += [0.0] * (6 - len(k))
    if any(k) and model not in _BROWN:
        raise BadInput(f"{where}: distortion model {printable(model, 40)}; Brown's are read. Choose one of them in the alignment settings.")
    used = _BROWN.get(model, 0)
    radial = [*k[:3], k[3] if used in (4, 6) else 0.0] if used else [0.0] * 4
    tangential = (k[5], k[4]) if used in (5, 6) else (0.0, 0.0)
    aspect, skew = value("AspectRatio", "1"), value("Skew", "0")
    if abs(aspect - 1) > 1e-6 or abs(skew) > 1e-6:
        raise BadInput(f"{where}: AspectRatio {aspect:g} and Skew {skew:g}; only square pixels are read from XMP files. Align again without.")
    return _lens(value("FocalLength35mm", "0"), (value("PrincipalPointU", "0"), value("PrincipalPointV", "0")), radial, tangential, pose, where)


FORMAT = ListFormat("realitycapture", f"a CSV file with the columns {', '.join(REQUIRED)}, or XMP files next to the photographs", _signs, _listed, single=True)
