"""The asset file: format 1, specified in FORMAT.md beside this module. The only module of the method that opens a file.

A safetensors container of four tensors and one metadata entry. Everything that a stranger's file says is checked against the file's size and
against the other tensors before memory for it is allocated.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from pathlib import Path
from typing import Any

import numpy as np

from efficientnerf.harmonics import MAX_DEGREE, harmonics_count
from efficientnerf.nerftree.tree import NerfTree

MAJOR, MINOR = 1, 0
METADATA_KEY = "nerftree"
HEADER_LIMIT = 16 * 2**20
MAX_CELLS = 2**30
DTYPES: dict[str, np.dtype[Any]] = {"U8": np.dtype("<u1"), "U64": np.dtype("<u8"), "F16": np.dtype("<f2")}
TENSORS = {"coarse.occupancy": "U8", "brick.mask": "U64", "voxel.density": "F16", "voxel.sh": "F16"}
DENSITY_LIMIT = 65000.0  # fits a half


class FormatError(ValueError):
    """A file that is not a NerfTree, is damaged, or is of a format that this build does not read."""


def _bits_of(tree: NerfTree) -> tuple[np.ndarray, np.ndarray]:
    """Occupancy bits of the coarse cells, and one 64-bit mask (or several words) per brick."""
    owner = tree.brick_index.reshape(-1)
    occupancy = np.packbits(owner >= 0, bitorder="little")
    stored = tree.voxel_index[owner[owner >= 0]] >= 0  # bricks in the order of their cells
    words = math.ceil(tree.brick**3 / 64)
    padded = np.zeros((len(stored), words * 64), bool)
    padded[:, : tree.brick**3] = stored
    mask = np.packbits(padded, axis=1, bitorder="little").view("<u8").reshape(len(stored), words)
    return occupancy, np.ascontiguousarray(mask)


def _finite(name: str, values: np.ndarray) -> np.ndarray:
    if not np.isfinite(values).all():
        raise FormatError(f"{name}: holds values that are not finite; such a tree can't be saved")
    return values


def serialize(tree: NerfTree) -> bytes:
    """The bytes of the file; the same tree gives the same bytes."""
    from safetensors.numpy import save as save_tensors

    occupancy, mask = _bits_of(tree)
    # Stored voxels must lie in the order of the masks: brick by brick in the order of the cells, bit by bit.
    owner = tree.brick_index.reshape(-1)
    order = tree.voxel_index[owner[owner >= 0]]
    order = order[order >= 0]
    if (tree.density_values[order] < 0).any():
        raise FormatError("voxel.density: holds values below zero; such a tree can't be saved")
    tensors = {
        "coarse.occupancy": occupancy,
        "brick.mask": mask,
        "voxel.density": np.minimum(_finite("voxel.density", tree.density_values[order]), DENSITY_LIMIT).astype("<f2"),
        "voxel.sh": np.clip(_finite("voxel.sh", tree.sh[order]), -DENSITY_LIMIT, DENSITY_LIMIT).astype("<f2"),
    }
    meta = {
        **tree.metadata,
        "format": "nerftree",
        "format_version": f"{MAJOR}.{MINOR}",
        "layout": "sparse",
        "shape": list(tree.shape),
        "brick": tree.brick,
        "voxel": tree.voxel,
        "bounds_min": [float(x) for x in tree.bounds_min],
        "sh_degree": tree.degree,
        "sh_convention": "real-orthonormal-plenoctree",
        "colour_space": "srgb-sigmoid",
        "background": None if tree.background is None else [float(x) for x in tree.background],
        "sha256": {name: hashlib.sha256(value.tobytes()).hexdigest() for name, value in tensors.items()},
    }
    try:
        text = json.dumps(meta, sort_keys=True, separators=(",", ":"), allow_nan=False)
    except (TypeError, ValueError) as error:
        raise FormatError(f"metadata can't be written as JSON: {error}") from error
    return save_tensors(tensors, metadata={METADATA_KEY: text})


def save(tree: NerfTree, path: str | Path) -> None:
    """Write `tree` to `path`, whole or not at all."""
    path = Path(path)
    data = serialize(tree)
    aside = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with open(aside, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(aside, path)
    finally:
        aside.unlink(missing_ok=True)


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    out = dict(pairs)
    if len(out) != len(pairs):
        raise FormatError("a JSON object names a key twice")
    return out


def _json(name: str, text: bytes | str) -> dict[str, Any]:
    def refuse(token: str) -> float:
        raise FormatError(f"{name}: JSON holds {token[:60]}, which is no finite number")

    def finite(token: str) -> float:
        return float(token) if math.isfinite(float(token)) else refuse(token)

    try:
        text = text.decode("utf-8") if isinstance(text, bytes) else text
        value = json.loads(text, object_pairs_hook=_unique, parse_constant=refuse, parse_float=finite)
    except FormatError as error:
        raise FormatError(f"{name}: {error}") from None
    except (ValueError, RecursionError) as error:
        raise FormatError(f"{name}: header is not JSON ({type(error).__name__})") from None
    if not isinstance(value, dict):
        raise FormatError(f"{name}: header is not a JSON object")
    return value


class _Header:
    """The safetensors header, checked against the file's size: name -> (dtype, shape, first byte, last byte)."""

    def __init__(self, path: Path) -> None:
        self.path, self.name = path, path.name
        try:
            self.size = path.stat().st_size
            with open(path, "rb") as file:
                first = file.read(8)
                if len(first) < 8:
                    raise FormatError(f"{self.name}: {self.size} bytes; a NerfTree begins with an 8-byte header length. The file is cut short or is none.")
                length = int.from_bytes(first, "little")
                if length > HEADER_LIMIT or 8 + length > self.size:
                    raise FormatError(f"{self.name}: header of {length} bytes in a file of {self.size}; the file is cut short or is no NerfTree.")
                raw = file.read(length)
        except (OSError, IsADirectoryError) as error:
            raise FormatError(f"{self.name}: can't be read ({error.strerror})") from error
        header = _json(self.name, raw)
        strings = header.pop("__metadata__", None)
        if not isinstance(strings, dict) or not isinstance(strings.get(METADATA_KEY), str):
            raise FormatError(f"{self.name}: a safetensors file without '{METADATA_KEY}' metadata; not a NerfTree.")
        self.meta = _json(self.name, strings[METADATA_KEY])
        self.start = 8 + length
        self.tensors = {str(name): self._entry(str(name), entry) for name, entry in header.items()}
        self._check_cover()

    def _entry(self, name: str, entry: Any) -> tuple[str, tuple[int, ...], int, int]:
        where = f"{self.name}: tensor '{name}'"
        if not isinstance(entry, dict) or set(entry) != {"dtype", "shape", "data_offsets"}:
            raise FormatError(f"{where}: expected dtype, shape and data_offsets")
        shape, offsets, dtype = entry["shape"], entry["data_offsets"], entry["dtype"]
        if not (isinstance(shape, list) and len(shape) <= 8 and all(type(n) is int and 0 <= n < 2**48 for n in shape)):
            raise FormatError(f"{where}: shape {str(shape)[:60]} is not a list of counts")
        if not (isinstance(offsets, list) and len(offsets) == 2 and all(type(n) is int and n >= 0 for n in offsets) and offsets[0] <= offsets[1]):
            raise FormatError(f"{where}: data_offsets {str(offsets)[:60]} are not a range")
        if self.start + offsets[1] > self.size:
            raise FormatError(f"{where}: ends at byte {self.start + offsets[1]} of a file of {self.size}; the file is cut short.")
        if isinstance(dtype, str) and dtype in DTYPES and math.prod(shape) * DTYPES[dtype].itemsize != offsets[1] - offsets[0]:
            raise FormatError(f"{where}: {dtype} of shape {shape} does not fill its {offsets[1] - offsets[0]} bytes")
        return str(dtype), tuple(shape), offsets[0], offsets[1]

    def _check_cover(self) -> None:
        at = 0
        for name, (_, _, begin, end) in sorted(self.tensors.items(), key=lambda item: item[1][2:]):
            if begin != at:
                raise FormatError(f"{self.name}: tensor '{name}' begins at {begin}, expected {at}; tensors must lie end to end")
            at = end
        if self.start + at != self.size:
            raise FormatError(f"{self.name}: {self.size - self.start - at} bytes after the last tensor; the file was appended to.")

    def read(self, name: str) -> np.ndarray:
        dtype, shape, begin, _ = self.tensors[name]
        values = np.fromfile(self.path, DTYPES[dtype], count=math.prod(shape), offset=self.start + begin)
        if len(values) != math.prod(shape):
            raise FormatError(f"{self.name}: tensor '{name}' could not be read whole; the file changed while it was read")
        return values.reshape(shape)


def _number(name: str, meta: dict[str, Any], key: str, low: float, high: float, *, whole: bool) -> float:
    value = meta.get(key)
    if type(value) not in ((int,) if whole else (int, float)) or not low <= value <= high:  # type: ignore[operator]
        raise FormatError(f"{name}: metadata '{key}' is {str(value)[:60]}; expected a {'whole ' if whole else ''}number from {low} to {high}")
    return value  # type: ignore[return-value]


def _numbers(name: str, meta: dict[str, Any], key: str, count: int, low: float, high: float) -> list[float]:
    value = meta.get(key)
    if not (isinstance(value, list) and len(value) == count and all(type(x) in (int, float) and low <= x <= high for x in value)):
        raise FormatError(f"{name}: metadata '{key}' is {str(value)[:60]}; expected {count} numbers from {low} to {high}")
    return value


def _check_frame(name: str, meta: dict[str, Any]) -> None:
    """What may be said of the capture's frame and of the cameras' orbit must be sound where it is said."""
    for key in ("world_from_capture", "orbit"):
        if not isinstance(meta.get(key, {}), dict):
            raise FormatError(f"{name}: metadata '{key}' is {str(meta[key])[:60]}; expected an object")
    if type(meta.get("metric", False)) is not bool:
        raise FormatError(f"{name}: metadata 'metric' is {str(meta['metric'])[:60]}; expected true or false")
    if "world_from_capture" in meta:
        similarity = meta["world_from_capture"]
        _number(name, similarity, "scale", 1e-30, 1e30, whole=False)
        _numbers(name, similarity, "translation", 3, -1e30, 1e30)
        rows = similarity.get("rotation")
        if not (isinstance(rows, list) and len(rows) == 3):
            raise FormatError(f"{name}: metadata 'rotation' is {str(rows)[:60]}; expected three rows")
        rotation = np.array([_numbers(name, {"rotation": row}, "rotation", 3, -2, 2) for row in rows], np.float64)
        if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4) or np.linalg.det(rotation) < 0:
            raise FormatError(f"{name}: metadata 'rotation' is not a rotation")
    if "orbit" in meta:
        orbit = meta["orbit"]
        _numbers(name, orbit, "centre", 3, -1e30, 1e30)
        _number(name, orbit, "radius", 1e-30, 1e30, whole=False)
        _number(name, orbit, "elevation", -90, 90, whole=False)
        _number(name, orbit, "heading", -360, 360, whole=False)
        if type(orbit.get("forward_facing")) is not bool:
            raise FormatError(f"{name}: metadata 'forward_facing' is {str(orbit.get('forward_facing'))[:60]}; expected true or false")


def _open(path: str | Path) -> _Header:
    """The header with its metadata and the tensors' shapes checked; no tensor is read."""
    header = _Header(Path(path))
    name, meta = header.name, header.meta
    if meta.get("format") != "nerftree":
        raise FormatError(f"{name}: metadata 'format' is {str(meta.get('format'))[:60]}; expected nerftree")
    version = str(meta.get("format_version")).split(".")
    if len(version) != 2 or not all(part.isascii() and part.isdecimal() and len(part) < 6 for part in version):
        raise FormatError(f"{name}: format version {str(meta.get('format_version'))[:60]}; expected MAJOR.MINOR")
    if int(version[0]) != MAJOR:
        raise FormatError(f"{name}: format version {'.'.join(version)}; this build reads {MAJOR}.x. Upgrade efficientnerf.")
    if meta.get("layout") != "sparse":
        raise FormatError(f"{name}: layout {str(meta.get('layout'))[:60]}; this build reads 'sparse'. Upgrade efficientnerf.")
    if meta.get("sh_convention") != "real-orthonormal-plenoctree" or meta.get("colour_space") != "srgb-sigmoid":
        found = f"harmonics {str(meta.get('sh_convention'))[:60]} in {str(meta.get('colour_space'))[:60]}"
        raise FormatError(f"{name}: {found}; expected real-orthonormal-plenoctree in srgb-sigmoid")
    shape = _numbers(name, meta, "shape", 3, 1, 2**16)
    if not all(type(n) is int for n in shape) or math.prod(shape) > MAX_CELLS:
        raise FormatError(f"{name}: shape {shape}; expected whole numbers with a product of at most {MAX_CELLS}")
    brick = int(_number(name, meta, "brick", 1, 16, whole=True))
    degree = int(_number(name, meta, "sh_degree", 0, MAX_DEGREE, whole=True))
    _number(name, meta, "voxel", 1e-30, 1e30, whole=False)
    _numbers(name, meta, "bounds_min", 3, -1e30, 1e30)
    if "background" not in meta:
        raise FormatError(f"{name}: metadata 'background' is missing; expected three numbers or null")
    if meta["background"] is not None:
        _numbers(name, meta, "background", 3, 0, 1)
    _check_frame(name, meta)
    for tensor in header.tensors:
        if tensor not in TENSORS and not tensor.startswith("x."):
            raise FormatError(f"{name}: unknown tensor '{tensor[:60]}'; only names that begin with 'x.' may be ignored")
    for tensor, dtype in TENSORS.items():
        if tensor not in header.tensors:
            raise FormatError(f"{name}: tensor '{tensor}' is missing")
        if header.tensors[tensor][0] != dtype:
            raise FormatError(f"{name}: tensor '{tensor}' is {header.tensors[tensor][0][:20]}; expected {dtype}")
    mask, density = header.tensors["brick.mask"][1], header.tensors["voxel.density"][1]
    count = density[0] if len(density) == 1 else -1
    expected = {
        "coarse.occupancy": (math.ceil(math.prod(int(n) for n in shape) / 8),),
        "brick.mask": (mask[0] if mask else -1, math.ceil(brick**3 / 64)),
        "voxel.density": (count,),
        "voxel.sh": (count, harmonics_count(degree), 3),
    }
    for tensor, want in expected.items():
        if header.tensors[tensor][1] != want:
            raise FormatError(f"{name}: tensor '{tensor}' has shape {header.tensors[tensor][1]}; expected {want}")
    return header


def load(path: str | Path) -> NerfTree:
    """Read and verify an asset.

    Raises FormatError, naming the file, what was found and what was expected.
    """
    header = _open(path)
    name, meta = header.name, header.meta
    digests = meta.get("sha256")
    raw = {}
    for tensor in TENSORS:
        raw[tensor] = header.read(tensor)
        want = digests.get(tensor) if isinstance(digests, dict) else None
        found = hashlib.sha256(raw[tensor].tobytes()).hexdigest()
        if found != want:
            said = f"has SHA-256 {found[:12]}…, the file says {str(want)[:12]}…"
            raise FormatError(f"{name}: tensor '{tensor}' {said}; the file is damaged. Bake it again or copy it anew.")
    shape, brick = tuple(int(n) for n in meta["shape"]), int(meta["brick"])
    cells = math.prod(shape)
    occupied = np.flatnonzero(np.unpackbits(raw["coarse.occupancy"], count=cells, bitorder="little"))
    if np.unpackbits(raw["coarse.occupancy"], bitorder="little")[cells:].any():
        raise FormatError(f"{name}: 'coarse.occupancy' has bits set beyond its {cells} cells")
    masks = raw["brick.mask"]
    if len(occupied) != len(masks):
        raise FormatError(f"{name}: {len(occupied)} occupied cells but {len(masks)} brick masks")
    bits = np.unpackbits(masks.view(np.uint8), axis=1, bitorder="little").astype(bool) if len(masks) else np.zeros((0, 64 * masks.shape[1]), bool)
    if bits[:, brick**3 :].any():
        raise FormatError(f"{name}: 'brick.mask' has bits set beyond the {brick**3} voxels of a brick")
    bits = bits[:, : brick**3]
    count = int(bits.sum())
    if count != len(raw["voxel.density"]):
        raise FormatError(f"{name}: masks name {count} voxels but {len(raw['voxel.density'])} are stored")
    density, sh = raw["voxel.density"].astype(np.float32), raw["voxel.sh"].astype(np.float32)
    if not (np.isfinite(density).all() and (density >= 0).all() and np.isfinite(sh).all()):
        raise FormatError(f"{name}: densities must be finite and not negative, harmonics finite")
    brick_index = np.full(cells, -1, np.int32)
    brick_index[occupied] = np.arange(len(occupied), dtype=np.int32)
    voxel_index = np.full(bits.shape, -1, np.int32)
    voxel_index[bits] = np.arange(count, dtype=np.int32)
    background = meta["background"]
    return NerfTree(
        shape=shape,  # type: ignore[arg-type]
        brick=brick,
        voxel=float(meta["voxel"]),
        bounds_min=np.asarray(meta["bounds_min"], np.float64),
        brick_index=brick_index.reshape(shape),
        voxel_index=voxel_index,
        density_values=density,
        harmonics=sh,
        background=None if background is None else tuple(float(x) for x in background),  # type: ignore[arg-type]
        metadata={key: value for key, value in meta.items() if key not in _STRUCTURE},
    )


_STRUCTURE = {
    "format", "format_version", "layout", "shape", "brick", "voxel", "bounds_min", "sh_degree", "sh_convention", "colour_space", "background", "sha256",
}  # fmt: skip


def describe(path: str | Path) -> dict[str, Any]:
    """What an asset file says of itself, from its header alone."""
    header = _open(path)
    meta = header.meta
    shape, brick, voxel = [int(n) for n in meta["shape"]], int(meta["brick"]), float(meta["voxel"])
    resolution = [n * brick for n in shape]
    low = [float(x) for x in meta["bounds_min"]]
    return {
        "format": "nerftree",
        "format_version": meta["format_version"],
        "layout": meta["layout"],
        "bytes": header.size,
        "bytes_per_part": {"header": header.start, **{name: end - begin for name, (_, _, begin, end) in sorted(header.tensors.items())}},
        "coarse_cells": shape,
        "brick": brick,
        "resolution": resolution,
        "bricks": header.tensors["brick.mask"][1][0],
        "voxels": header.tensors["voxel.density"][1][0],
        "voxel_side": voxel,
        "sh_degree": meta["sh_degree"],
        "bounds": {"min": low, "max": [a + n * voxel for a, n in zip(low, resolution, strict=True)]},
        "background": meta["background"],
        **{key: meta[key] for key in sorted(meta) if key not in _STRUCTURE},
    }
