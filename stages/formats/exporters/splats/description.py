"""What the header of a file of 3D Gaussians says, whoever wrote it: PLY of 3DGS, SPZ 1 to 4, SOG 2, GLB with KHR_gaussian_splatting.

The Gaussians themselves are not read, so that no more than a header is in memory, whatever it says.
"""

import os
import re
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

from pipeline.errors import BadInput
from pipeline.files import Unreadable, json_value, open_plain
from pipeline.text import printable
from stages.formats.exporters.splats import gltf, spz
from stages.io.meshes.geometry import Damaged
from stages.io.meshes.glb import Glb
from stages.io.meshes.ply import read_header

MAX_GLTF_JSON = 2**24  # bytes; of Gaussians it takes a few thousand
MAX_SOG_JSON = 2**20  # bytes; it takes ten thousand
MAX_DEGREE = 4
_PLY_NAMES = {*"xyz", *(f"{name}_{k}" for name, count in (("f_dc", 3), ("scale", 3), ("rot", 4)) for k in range(count)), "opacity"}
_ERRORS = (Unreadable, struct.error, zlib.error, zipfile.BadZipFile, EOFError, RuntimeError, LookupError, TypeError, ValueError, AttributeError)


def describe_splats(path: Path) -> dict[str, Any] | None:
    """Format, number and degree of the harmonics of the Gaussians in a file; None where the file is something else, as a mesh may be. Raises BadInput."""
    readers: dict[str, Callable[[BinaryIO, int], dict[str, Any] | None]] = {".ply": _ply, ".spz": _spz, ".sog": _sog, ".glb": _glb}
    try:
        with open(open_plain(path), "rb") as file:
            return readers[path.suffix.lower()](file, os.fstat(file.fileno()).st_size)
    except OSError as error:
        raise BadInput(f"{path}: cannot be read ({error.strerror or error}).") from error
    except _ERRORS as error:
        why = str(error) if isinstance(error, Damaged | Unreadable) else f"a damaged header ({type(error).__name__}: {printable(error, 80)})"
        raise BadInput(f"{path}: {why}. Write the file again with the program that made it.") from error


def _facts(format: str, count: Any, degree: Any, notes: list[str]) -> dict[str, Any]:
    if type(count) is not int or type(degree) is not int or count < 1 or not 0 <= degree <= MAX_DEGREE:
        raise Damaged(f"{printable(count, 40)} Gaussians of degree {printable(degree, 40)}; expected one or more, of a degree of 0 to {MAX_DEGREE}")
    return {"format": format, "gaussians": count, "sh_degree": degree, "notes": notes}


def _ply(file: BinaryIO, size: int) -> dict[str, Any] | None:
    kind, comments, elements = read_header(file)
    names = {each.name for element in elements for each in element.properties}
    if {"packed_position", "packed_rotation"} <= names:
        raise Damaged("a PLY compressed as SuperSplat does it; expected the columns of 3DGS (convert it: splat-transform in.ply out.ply)")
    if _PLY_NAMES - names:
        return None
    vertices = elements[0]
    if kind == "ascii" or vertices.name != "vertex" or any(each.counts is not None for each in vertices.properties):
        raise Damaged("Gaussians in text, or that are not its first element, in columns of numbers; expected 'format binary_little_endian 1.0' and these")
    least = vertices.count * sum(each.type.itemsize for each in vertices.properties) + file.tell()
    if size < least:
        raise Damaged(f"{size} bytes; expected {least} for the {vertices.count} Gaussians that its header names")
    above = sum(bool(re.fullmatch(r"f_rest_\d+", each.name)) for each in vertices.properties)
    if above not in (0, 9, 24, 45, 72):
        raise Damaged(f"{above} columns f_rest_*; expected 0, 9, 24, 45 or 72")
    return _facts("PLY (3DGS)", vertices.count, round((above / 3 + 1) ** 0.5) - 1, [printable(comment, 200) for comment in comments])


def _spz(file: BinaryIO, size: int) -> dict[str, Any]:
    begin = file.read(1024)
    if begin[:4] != spz.MAGIC:
        begin = zlib.decompressobj(16 + zlib.MAX_WBITS).decompress(begin, 16)  # versions 1 to 3 are gzip
    magic, version, count, degree, _, flags, _ = struct.unpack("<4sIIBBBB", begin[:16])
    if magic != spz.MAGIC or version not in (1, 2, 3, 4):
        raise Damaged(f"no SPZ of version 1 to 4: its header begins with {magic!r} and version {version}")
    return _facts(f"SPZ {version}", count, degree, ["antialiased"] if flags & 1 else [])


def _sog(file: BinaryIO, size: int) -> dict[str, Any]:
    with zipfile.ZipFile(file) as archive:
        info = archive.getinfo("meta.json")
        if info.file_size > MAX_SOG_JSON:
            raise Damaged(f"meta.json of {info.file_size} bytes; expected at most {MAX_SOG_JSON}")
        with archive.open(info) as member:
            meta = json_value(member.read(MAX_SOG_JSON))
    if meta["version"] != 2:
        raise Damaged("no SOG of version 2 (convert it: splat-transform in.sog out.sog)")
    return _facts("SOG 2", meta["count"], meta["shN"]["bands"] if "shN" in meta else 0, ["antialiased"] if meta.get("antialias") is True else [])


def _glb(file: BinaryIO, size: int) -> dict[str, Any] | None:
    if gltf.EXTENSION.encode() not in file.read(20 + MAX_GLTF_JSON):
        return None
    file.seek(0)
    document = Glb(file, size, MAX_GLTF_JSON).document
    primitives = [each for mesh in document["meshes"] for each in mesh["primitives"] if gltf.EXTENSION in each.get("extensions", {})]
    if not primitives:
        return None
    if below := {name for each in primitives for name in each["extensions"][gltf.EXTENSION].get("extensions", {})}:
        raise Damaged(f"Gaussians compressed by {printable(', '.join(sorted(below)), 80)}; expected attributes as they are (write it without compression)")
    counts = [document["accessors"][each["attributes"]["POSITION"]]["count"] for each in primitives]
    named = [re.fullmatch(rf"{gltf.EXTENSION}:SH_DEGREE_(\d)_COEF_\d", name) for each in primitives for name in each["attributes"]]
    return _facts(f"GLB ({gltf.EXTENSION})", sum(counts), max((int(each[1]) for each in named if each), default=0), [])
