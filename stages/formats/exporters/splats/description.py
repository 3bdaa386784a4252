"""What a file of 3D Gaussians holds, whoever wrote it: PLY of 3DGS, SPZ 1 to 4, SOG 2, GLB with KHR_gaussian_splatting.

Nothing that a header says is believed before the file's size allows it, and no more than a piece of a file is in memory at a time.

N Gaussians.
"""

import gzip
import io
import re
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from pipeline.files import Unreadable, json_value
from pipeline.text import printable
from stages.formats.exporters.splats import gltf, spz
from stages.io.meshes.geometry import AT_ONCE, Damaged, exactly, opened
from stages.io.meshes.glb import Glb
from stages.io.meshes.ply import read_header

MAX_GLTF_JSON = 2**24  # bytes; of Gaussians it takes a few thousand
MAX_SOG_JSON = 2**20  # bytes; it takes ten thousand
DENSEST = 1032  # bytes that one byte of deflate, or of a zstd frame as SPZ writes them, can stand for
FEW, USUAL = 2**20, 64  # Gaussians that any file may hold; and bytes that one byte stands for in larger ones at most: those of scenes have 3
SPZ_DEGREES = range(5)
_PLY_NAMES = {*"xyz", *(f"{name}_{k}" for name, count in (("f_dc", 3), ("scale", 3), ("rot", 4)) for k in range(count)), "opacity"}


@dataclass
class _Range:
    """The least and the greatest of columns that come in pieces, and how many numbers of them are not finite."""

    low: np.ndarray | None = None
    high: np.ndarray | None = None
    not_finite: int = 0

    def add(self, rows: np.ndarray) -> None:
        """rows  (n, K)"""
        rows = rows.astype(np.float64)
        finite = np.isfinite(rows)
        self.not_finite += int(rows.size - finite.sum())
        low, high = np.where(finite, rows, np.inf).min(axis=0), np.where(finite, rows, -np.inf).max(axis=0)
        self.low = low if self.low is None else np.minimum(self.low, low)
        self.high = high if self.high is None else np.maximum(self.high, high)

    def box(self) -> list[list[float]] | None:
        """The corners; None where no number is finite in a column."""
        if self.low is None or self.high is None or not (np.isfinite(self.low) & np.isfinite(self.high)).all():
            return None
        return [self.low.tolist(), self.high.tolist()]

    def extremes(self) -> list[float] | None:
        """The least and the greatest of all columns."""
        box = self.box()
        return None if box is None else [min(box[0]), max(box[1])]


@dataclass
class _Found:
    """What is known of a file's Gaussians."""

    format: str
    count: int
    degree: int
    places: _Range = field(default_factory=_Range)
    scales: _Range = field(default_factory=_Range)
    opacities: _Range = field(default_factory=_Range)
    notes: list[str] = field(default_factory=list)

    def facts(self) -> dict[str, Any]:
        wrong = sum(each.not_finite for each in (self.places, self.scales, self.opacities))
        return {
            "format": self.format, "gaussians": self.count, "sh_degree": self.degree, "bounds": self.places.box(), "scales": self.scales.extremes(),
            "opacities": self.opacities.extremes(), "not_finite": wrong or None, "notes": self.notes,
        }  # fmt: skip


def describe_splats(path: Path) -> dict[str, Any] | None:
    """Format, number, degree of the harmonics, bounds, least and greatest standard deviation and opacity of the Gaussians in a file; None where the file is
    something else, as a mesh may be. In the file's own frame. Raises BadInput."""
    readers: dict[str, Callable[[BinaryIO, int], _Found | None]] = {".ply": _ply, ".spz": _spz, ".sog": _sog, ".glb": _glb}
    with opened(path) as (file, size):
        found = readers[path.suffix.lower()](file, size)
    return None if found is None else found.facts()


# PLY


def _ply(file: BinaryIO, size: int) -> _Found | None:
    kind, comments, elements = read_header(file)
    names = {each.name for element in elements for each in element.properties}
    if {"packed_position", "packed_rotation"} <= names:
        raise Damaged("a PLY compressed as SuperSplat does it; expected the columns of 3DGS (convert it: splat-transform in.ply out.ply)")
    if _PLY_NAMES - names:
        return None
    if kind == "ascii":
        raise Damaged("a PLY of 3D Gaussians that is not binary; expected 'format binary_little_endian 1.0'")
    if elements[0].name != "vertex":
        raise Damaged("its first element is not 'element vertex N'")
    columns, count = [(each.name, each.type) for each in elements[0].properties], elements[0].count
    if any(each.counts is not None for each in elements[0].properties) or len(dict(columns)) < len(columns):
        raise Damaged("its vertices have a property list, or a column twice; expected columns of numbers, each once")
    rows, start = np.dtype(columns), file.tell()
    if _PLY_NAMES - {*(rows.names or ())}:
        raise Damaged("its vertices lack columns of Gaussians, which other elements have")
    if size < start + count * rows.itemsize or (size > start + count * rows.itemsize and len(elements) == 1):
        raise Damaged(f"{size} bytes; expected {start + count * rows.itemsize} for the {count} Gaussians that its header names")
    above = sum(bool(re.fullmatch(r"f_rest_\d+", name)) for name in rows.names or ())
    if above not in (0, 9, 24, 45, 72):
        raise Damaged(f"{above} columns f_rest_*; expected 0, 9, 24, 45 or 72")
    found = _Found("PLY (3DGS)", count, round((above / 3 + 1) ** 0.5) - 1, notes=[printable(comment, 200) for comment in comments])
    for raw in _rows(file, count, rows.itemsize):
        part = np.frombuffer(raw, rows)
        found.places.add(np.stack([part[name] for name in "xyz"], axis=1))
        with np.errstate(over="ignore", invalid="ignore"):
            found.scales.add(np.exp(np.stack([part[f"scale_{k}"] for k in range(3)], axis=1).astype(np.float64)))
            found.opacities.add(1 / (1 + np.exp(-part["opacity"].astype(np.float64)))[:, None])
    return found


# SPZ


def _spz(file: BinaryIO, size: int) -> _Found:
    if file.read(4) == spz.MAGIC:
        return _spz4(file, size)
    file.seek(0)
    inflated = gzip.GzipFile(fileobj=file)
    magic, version, count, degree, bits, flags, _ = struct.unpack("<4sIIBBBB", next(_rows(inflated, 1, 16)))
    if magic != spz.MAGIC or version not in (1, 2, 3):
        raise Damaged(f"no SPZ of version 1 to 4: its header begins with {magic!r} and version {version}")
    found = _spz_header(version, count, degree, bits, flags, size)
    for raw in _rows(inflated, count, 6 if version == 1 else 9):
        found.places.add(np.frombuffer(raw, "<f2").reshape(-1, 3) if version == 1 else spz.places(raw, bits))
    for raw in _rows(inflated, count, 1):
        found.opacities.add(np.frombuffer(raw, np.uint8)[:, None] / 255)
    for _ in _rows(inflated, count, 3):
        pass  # colours
    for raw in _rows(inflated, count, 3):
        found.scales.add(spz.scales(raw))
    for _ in _rows(inflated, count, (3 if version < 3 else 4) + 3 * ((degree + 1) ** 2 - 1)):
        pass  # rotations and harmonics
    _finish(inflated, FEW if flags & 2 else 0)
    return found


def _spz4(file: BinaryIO, size: int) -> _Found:
    """Version 4: a header and a table of streams that are not compressed, then the streams, each a frame of zstd."""
    version, count, degree, bits, flags, streams, table = struct.unpack("<IIBBBBI", exactly(file, 16))
    if version != 4:
        raise Damaged(f"no SPZ of version 1 to 4: version {version}")
    found = _spz_header(version, count, degree, bits, flags, size)
    widths = [9, 1, 3, 3, 4, *([3 * ((degree + 1) ** 2 - 1)] if degree else [])]
    if streams < len(widths) or table < spz.HEADER.size or table + 16 * streams > size:
        raise Damaged(f"a table of {streams} streams at byte {table} of {size}; expected at least {len(widths)}, within the file")
    file.seek(table)
    stated = struct.unpack(f"<{2 * streams}Q", exactly(file, 16 * streams))
    stored, unpacked = stated[::2], stated[1::2]
    if table + 16 * streams + sum(stored) != size:
        raise Damaged(f"{size} bytes; expected {table + 16 * streams + sum(stored)} for its streams")
    if unpacked[: len(widths)] != tuple(width * count for width in widths):
        raise Damaged(f"streams of {', '.join(map(str, unpacked[: len(widths)]))} bytes; expected {', '.join(str(width * count) for width in widths)}")
    places, opacities, _, scales = (spz.zstd.ZstdFile(io.BytesIO(exactly(file, some))) for some in stored[:4])
    for raw in _rows(places, count, 9):
        found.places.add(spz.places(raw, bits))
    for raw in _rows(opacities, count, 1):
        found.opacities.add(np.frombuffer(raw, np.uint8)[:, None] / 255)
    for raw in _rows(scales, count, 3):
        found.scales.add(spz.scales(raw))
    for stream in (places, opacities, scales):
        _finish(stream)
    return found


def _spz_header(version: int, count: int, degree: int, bits: int, flags: int, size: int) -> _Found:
    if degree not in SPZ_DEGREES or bits > 24:
        raise Damaged(f"harmonics of degree {degree} and {bits} fractional bits; expected a degree of 0 to 4 and at most 24 bits")
    if count < 1 or 9 * count > (DENSEST if count <= FEW else USUAL) * size:
        raise Damaged(f"its header names {count} Gaussians, and {size} bytes hold none, or not as many")
    return _Found(f"SPZ {version}", count, degree, notes=["antialiased"] if flags & 1 else [])


# SOG


def _sog(file: BinaryIO, size: int) -> _Found:
    """What meta.json says, and that the images are there and whole. They are not decoded."""
    try:
        with zipfile.ZipFile(file) as archive:
            meta = _sog_member(archive, "meta.json", MAX_SOG_JSON)
            found = _sog_meta(json_value(meta), size, lambda name: _sog_member(archive, name, size))
    except (Damaged, Unreadable):
        raise
    except (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, ArithmeticError, LookupError, TypeError, ValueError, AttributeError) as error:
        raise Damaged(f"no SOG of version 2, or a damaged one ({type(error).__name__}: {printable(error, 80)})") from error
    found.notes.append("opacities are not read: they are in an image")
    return found


def _sog_member(archive: zipfile.ZipFile, name: str, most: int) -> bytes:
    """The beginning of a file in the zip, all of which is read for its checksum."""
    info = archive.getinfo(name)
    if info.file_size > most or info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise Damaged(f"{printable(name, 80)}: {info.file_size} bytes, compression {info.compress_type}; expected at most {most}, stored or deflated")
    with archive.open(info) as member:
        begin = member.read(most if name == "meta.json" else 16)
        while member.read(AT_ONCE):
            pass
    return begin


def _sog_meta(meta: Any, size: int, image: Callable[[str], bytes]) -> _Found:
    if meta["version"] != 2:
        raise Damaged("no SOG of version 2 (convert it: splat-transform in.sog out.sog)")
    count, above = meta["count"], meta.get("shN")
    degree = 0 if above is None else above["bands"]
    if not (type(count) is type(degree) is int and 1 <= 9 * count <= (DENSEST if count <= FEW else USUAL) * size and 0 <= degree <= 3):
        raise Damaged(f"Gaussians {printable(count, 40)}, degree {printable(degree, 40)}; {size} bytes hold none, or not as many")
    for part, number in (("means", 2), ("scales", 1), ("quats", 1), ("sh0", 1), *((("shN", 2),) if degree else ())):
        for name in meta[part]["files"][:number]:
            begin = image(name)
            if begin[:4] + begin[8:12] != b"RIFFWEBP":
                raise Damaged(f"{printable(name, 80)} is no WebP")
    found = _Found("SOG 2", count, degree, notes=["antialiased"] if meta.get("antialias") is True else [])
    ranges, scales = np.array([_sog_numbers(meta["means"][end], 3) for end in ("mins", "maxs")]), _sog_numbers(meta["scales"]["codebook"], 256)
    with np.errstate(over="ignore"):
        found.places.add(np.sign(ranges) * np.expm1(np.abs(ranges)))
        found.scales.add(np.exp(scales)[:, None])
    return found


def _sog_numbers(given: Any, count: int) -> np.ndarray:
    if not isinstance(given, list) or len(given) != count or not all(type(each) in (int, float) for each in given):
        raise Damaged(f"a range or a codebook in meta.json; expected {count} numbers")
    return np.array(given, np.float64)


# GLB


def _glb(file: BinaryIO, size: int) -> _Found | None:
    if gltf.EXTENSION.encode() not in file.read(20 + MAX_GLTF_JSON):
        return None
    file.seek(0)
    glb = Glb(file, size, MAX_GLTF_JSON)
    try:
        primitives = [each for mesh in glb.document["meshes"] for each in mesh["primitives"] if gltf.EXTENSION in each.get("extensions", {})]
        if not primitives:
            return None
        found = _Found(f"GLB ({gltf.EXTENSION})", 0, 0)
        for primitive in primitives:
            below = primitive["extensions"][gltf.EXTENSION].get("extensions", {})
            if below:
                raise Damaged(f"Gaussians compressed by {printable(', '.join(below), 80)}; expected attributes as they are (write it without compression)")
            names, counts = primitive["attributes"], set()
            scales, opacities = (f"{gltf.EXTENSION}:{name}" for name in ("SCALE", "OPACITY"))
            columns = (("POSITION", "VEC3", found.places), (scales, "VEC3", found.scales), (opacities, "SCALAR", found.opacities))
            for name, widths, into in columns:
                counts.add(glb.document["accessors"][names[name]]["count"])
                for rows in glb.rows(names[name], widths):
                    into.add(rows / np.iinfo(rows.dtype).max if rows.dtype.kind in "iu" else rows)
            if len(counts) > 1:
                raise Damaged(f"attributes of {sorted(counts)} rows; expected as many of each")
            degrees = [int(each[1]) for name in names if (each := re.fullmatch(rf"{gltf.EXTENSION}:SH_DEGREE_(\d)_COEF_\d", name))]
            found.count, found.degree = found.count + counts.pop(), max([found.degree, *degrees])
        return found
    except (KeyError, IndexError, TypeError, AttributeError) as error:
        raise Damaged(f"a glTF document that is not as it has to be ({type(error).__name__}: {printable(error, 80)})") from error


# what files have in common


def _rows(file: Any, count: int, width: int) -> Iterator[bytes]:
    """So many rows of so many bytes, in pieces. Raises Damaged where they are not there, or do not unpack."""
    for done in range(0, count, AT_ONCE):
        wanted = width * min(AT_ONCE, count - done)
        raw = _unpacked(file, wanted)
        if len(raw) != wanted:
            raise Damaged("its Gaussians end before as many have come as its header names")
        yield raw


def _finish(file: Any, most: int = 0) -> None:
    """To the end, where gzip's checksum is. Raises Damaged where more than `most` bytes come before it."""
    if len(_unpacked(file, most + 1)) > most:
        raise Damaged("it goes on after its last Gaussian")


def _unpacked(file: Any, most: int) -> bytes:
    try:
        return bytes(file.read(most))
    except (zlib.error, gzip.BadGzipFile, spz.zstd.ZstdError, EOFError) as error:
        raise Damaged(f"it does not unpack as gzip or zstd, or is cut short ({error})") from error
