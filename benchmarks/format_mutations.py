"""Asset files changed at random, for `benchmarks/fuzz_format.py`: the same generator gives the same file."""

from __future__ import annotations

import copy
import hashlib
import json
import math
from typing import Any

import numpy as np

NUMBERS = [0, 1, -1, 2, 3, 7, 8, 16, 17, 63, 64, 65, 255, 256, 257, 2**16, 2**31, 2**32, 2**53, 2**63, 2**64, 10**30, 0.5, -0.0, 1e-30, 1e30, 1e300, 1e-320]
TEXTS = [
    "", "sparse", "compact", "full", "ndc-sparse", "ndc-compact", "ndc-full", "nested-sparse", "nested-compact", "nearest-nested-sparse",
    "packed", "nested-packed",
    "U8", "U16", "U64", "F16", "F32", "F64", "1.0", "1.3", "1.4", "1.5", "1.9", "2.0",
    "x.a", "nerftree", "\ud7ff\0", "9" * 50,
]  # fmt: skip
# Densities and harmonics that strain sums: halves and what lies between.
VALUES = [0.0, 6e-8, 6.1e-5, 1e-3, 0.5, 1.0, 30.0, 1e3, 65504.0]
DTYPES = {"U8": "<u1", "U16": "<u2", "U64": "<u8", "F16": "<f2", "F32": "<f4"}
LAYOUTS = ("sparse", "compact", "full")
Rng = np.random.Generator


def number(rng: Rng, below: int) -> int:
    return int(rng.integers(below))


def header_of(data: bytes) -> tuple[dict[str, Any], dict[str, Any], bytes]:
    """The header's entries, the metadata and the data of a valid file."""
    length = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + length])
    return header, json.loads(header.pop("__metadata__")["nerftree"]), data[8 + length :]


def file_of(header: dict[str, Any], meta: Any, data: bytes) -> bytes:
    raw = json.dumps({"__metadata__": {"nerftree": json.dumps(meta)}, **header}).encode("utf-8", "surrogatepass")
    return len(raw).to_bytes(8, "little") + raw + data


def with_bytes(rng: Rng, data: bytes, begin: int, end: int) -> bytes:
    """A few changes of bytes between `begin` and `end`: flipped, overwritten, put in, taken out, copied, cut off."""
    out = bytearray(data)
    for _ in range(1 + number(rng, 4)):
        end = min(end, len(out))
        if end <= begin:
            break
        at, count = begin + number(rng, end - begin), 1 + number(rng, 8)
        kind = number(rng, 7)
        if kind == 0:
            out[at] ^= 1 << number(rng, 8)
        elif kind == 1:
            out[at : at + count] = rng.bytes(count)
        elif kind == 2:
            out[at:at] = rng.bytes(count)
        elif kind == 3:
            del out[at : at + count]
        elif kind == 4:
            source = number(rng, len(out))
            out[at : at + count] = out[source : source + count]
        elif kind == 5:
            out[at : at + 1] = b'0123456789-.eE[]{},:"\\ '[number(rng, 23) :][:1]
        else:
            del out[at:]
    return bytes(out)


def value(rng: Rng, depth: int = 0) -> Any:
    """Any JSON value, of kinds that break readers."""
    kind = number(rng, 8 if depth < 3 else 5)
    if kind == 0:
        return [None, True, False][number(rng, 3)]
    if kind in (1, 2):
        return NUMBERS[number(rng, len(NUMBERS))]
    if kind in (3, 4):
        return TEXTS[number(rng, len(TEXTS))]
    if kind == 5:
        return {TEXTS[number(rng, len(TEXTS))]: value(rng, depth + 1) for _ in range(number(rng, 3))}
    return [value(rng, depth + 1) for _ in range(number(rng, 5))]


def with_values(rng: Rng, root: Any) -> Any:
    """The JSON with one value changed, anywhere: by another, by a near one, or gone."""
    root = copy.deepcopy(root)
    node = root
    while True:
        keys: list[Any] = list(node) if isinstance(node, dict) else list(range(len(node)))
        if not keys:
            return root
        key = keys[number(rng, len(keys))]
        if isinstance(node[key], (dict, list)) and node[key] and number(rng, 4):
            node = node[key]
            continue
        kind = number(rng, 4)
        if kind == 0 and isinstance(node[key], (int, float)) and not isinstance(node[key], bool):
            node[key] = node[key] + [-1, 1, 0.5, 8][number(rng, 4)]
        elif kind == 1:
            del node[key]
        elif kind == 2 and isinstance(node, dict):
            node[TEXTS[number(rng, len(TEXTS))]] = node[key]
        else:
            node[key] = value(rng)
        return root


def with_tensor(rng: Rng, data: bytes) -> bytes:
    """Bytes of one tensor changed and its digest put right."""
    header, meta, body = header_of(data)
    name = sorted(header)[number(rng, len(header))]
    begin, end = header[name]["data_offsets"]
    out = bytearray(body)
    for _ in range(1 + number(rng, 4)):
        if end > begin:
            at = begin + number(rng, end - begin)
            out[at] = [0, 255, 0x7C, 0x7E, 0x80, number(rng, 256)][number(rng, 6)]
    meta["sha256"][name] = hashlib.sha256(out[begin:end]).hexdigest()
    if not number(rng, 3):
        meta = with_values(rng, meta)
    return file_of(header, meta, bytes(out))


def with_numbers(rng: Rng, data: bytes) -> bytes:
    """Numbers of the metadata scaled within what the format may allow: places, sizes, cascades, the region, the reference camera, the orbit and the spiral."""
    header, meta, body = header_of(data)
    for _ in range(1 + number(rng, 4)):
        kind = number(rng, 9)
        factor = float(10.0 ** rng.uniform(-14, 14))
        if kind == 0:
            meta["voxel"] *= factor
        elif kind == 1:
            meta["bounds_min"] = [x + float(rng.normal()) * factor for x in meta["bounds_min"]]
        elif kind == 2 and "ndc" in meta:
            key = ("focal", "width", "height", "near")[number(rng, 4)]
            meta["ndc"][key] *= factor
        elif kind == 3 and "ndc" in meta:
            for row in meta["ndc"]["world_from_camera"][:3]:
                row[3] = float(rng.normal()) * factor
        elif kind == 4:
            place = [float(x) for x in rng.normal(size=3) * factor]
            meta["orbit"] = {"centre": place, "radius": factor, "elevation": float(rng.uniform(-90, 90)), "heading": 0, "forward_facing": bool(number(rng, 2))}
        elif kind == 5:
            meta["spiral"] = {"radii": [factor, 0, 1], "focus": 1 / factor, "tangents": [0.5, factor], "far": factor}
        elif kind == 6:
            corners = np.sort(rng.normal(size=(2, 3)) * factor, axis=0)
            meta["region"] = {"bounds": corners.tolist(), "corner_radius": abs(float(rng.normal())) * factor, "fade": factor * number(rng, 2), "bricks": False}
            meta["format_version"] = "1.4"
        elif kind in (7, 8) and meta.get("cascades"):
            _with_cascades(rng, meta, factor)
    return file_of(header, meta, body)


def _with_cascades(rng: Rng, meta: dict[str, Any], factor: float) -> None:
    """All grids moved or scaled together, so that they nest still; or one of them moved by cells."""
    grids = [meta, *meta["cascades"]]
    kind, shift = number(rng, 3), [float(x) for x in rng.normal(size=3) * factor]
    for grid in grids:
        if kind == 0:
            grid["bounds_min"] = [x + y for x, y in zip(grid["bounds_min"], shift, strict=True)]
        elif kind == 1:
            grid["bounds_min"] = [x * factor for x in grid["bounds_min"]]
    if kind == 1:
        meta["voxel"] *= factor
    if kind == 2:
        n = number(rng, len(grids))
        cell = meta["brick"] * meta["voxel"] * 2.0**n
        grids[n]["bounds_min"] = [x + cell * float(rng.choice([-1, 0, 1, 0.5, 1e-4])) for x in grids[n]["bounds_min"]]


def with_values_of_tensors(rng: Rng, data: bytes) -> bytes:
    """Densities, harmonics, tables and palettes drawn from extremes, digests put right."""
    header, meta, body = header_of(data)
    out = bytearray(body)
    for name, entry in header.items():
        begin, end = entry["data_offsets"]
        if entry["dtype"] in ("F16", "F32") and end > begin and number(rng, 2):
            values = rng.choice(VALUES, math.prod(entry["shape"]))
            if "density" not in name:
                values *= rng.choice([-1.0, 1.0], len(values))
            out[begin:end] = values.astype(DTYPES[entry["dtype"]]).tobytes()
            meta["sha256"][name] = hashlib.sha256(out[begin:end]).hexdigest()
    return file_of(header, meta, bytes(out))


def _random_shape(rng: Rng) -> tuple[int, int, int]:
    """Sides of all proportions; up to 2^20 cells."""
    left = 20 * float(rng.random()) ** 2
    parts = rng.dirichlet([0.5] * 3) * left
    x, y, z = (min(65536, max(1, int(2.0**part))) for part in parts)
    return x, y, z


def _random_occupancy(rng: Rng, shape: tuple[int, ...]) -> np.ndarray:
    """A few cells of a grid, (cells,) bool."""
    cells = math.prod(shape)
    bricks = min(cells, 1 + number(rng, 8))
    occupied = np.zeros(cells, bool)
    occupied[rng.choice(cells, bricks, replace=False) if cells < 2**12 else rng.integers(cells, size=bricks)] = True
    return occupied


def _nested(rng: Rng, meta: dict[str, Any], tensors: dict[str, np.ndarray]) -> int:
    """Cascades around the grid of a file, an environment map, and a region of some bricks; how many bricks the cascades have."""
    shape, low, bricks = list(meta["shape"]), list(meta["bounds_min"]), 0
    meta["cascades"], meta["environment"] = [], None
    for n in range(1, 1 + number(rng, 4)):
        before = [number(rng, 4) for _ in range(3)]
        after = [number(rng, 4) for _ in range(3)]
        after = [b + (side // 2 + a + b) % 2 for side, a, b in zip(shape, before, after, strict=True)]  # even, for the next one
        shape = [side // 2 + a + b for side, a, b in zip(shape, before, after, strict=True)]
        low = [x - a * meta["brick"] * meta["voxel"] * 2.0**n for x, a in zip(low, before, strict=True)]
        occupied = _random_occupancy(rng, tuple(shape))
        bricks += int(occupied.sum())
        tensors[f"coarse.occupancy.{n}"] = np.packbits(occupied, bitorder="little")
        meta["cascades"].append({"shape": list(shape), "bounds_min": list(low)})
    if number(rng, 2):
        meta["environment"] = rows = 1 + number(rng, 30)
        tensors["environment"] = rng.integers(256, size=(rows, 2 * rows, 3)).astype("<u1")
    return bricks


def _region(rng: Rng, meta: dict[str, Any], tensors: dict[str, np.ndarray], bricks: int) -> None:
    corners = np.sort(rng.uniform(-0.5, 1.5, (2, 3)), axis=0) * meta["voxel"] * meta["brick"] * np.array(meta["shape"]) + meta["bounds_min"]
    meta["region"] = {"bounds": corners.tolist(), "corner_radius": float(rng.choice([0.0, meta["voxel"], 1.0])), "fade": float(rng.choice([0, meta["voxel"]]))}
    meta["region"]["bricks"] = bool(number(rng, 2))
    if meta["region"]["bricks"]:
        tensors["x.region.bricks"] = np.packbits(rng.random(bricks) < 0.5, bitorder="little")


def built(rng: Rng) -> bytes:
    """A sound file from nothing: any proportions of the grid, any brick, few voxels, values of all sizes; in the world, with cascades or without, or in
    device coordinates."""
    shape, brick, degree = _random_shape(rng), 1 + number(rng, 16), number(rng, 5)
    layout, nearest, ndc = LAYOUTS[number(rng, 3)], not number(rng, 3), not number(rng, 3)
    nested = not ndc and bool(number(rng, 2))
    if nested:
        shape = tuple(side + side % 2 for side in shape)  # type: ignore[assignment]
    cube, terms = brick**3, (degree + 1) ** 2
    occupied = _random_occupancy(rng, shape)
    bricks = int(occupied.sum())
    tensors: dict[str, np.ndarray] = {"coarse.occupancy": np.packbits(occupied, bitorder="little")}
    voxel = float(10.0 ** rng.uniform(-6, 6)) if number(rng, 2) else 0.05
    meta: dict[str, Any] = {"shape": list(shape), "brick": brick, "voxel": voxel, "bounds_min": [float(x) for x in rng.normal(size=3)]}
    bricks += _nested(rng, meta, tensors) if nested else 0
    if not number(rng, 3):
        _region(rng, meta, tensors, bricks)

    def drawn(*size: int, signed: bool = True) -> np.ndarray:
        values = rng.choice(VALUES, size)
        return values * rng.choice([-1.0, 1.0], size) if signed else values

    if layout == "full":
        tensors |= {"brick.density": drawn(bricks, cube, signed=False).astype("<f2"), "brick.sh": drawn(bricks, cube, terms, 3).astype("<f2")}
    else:
        stored = rng.random((bricks, -(-cube // 64) * 64)) < rng.choice([0.02, 0.5, 1.0])
        stored[:, cube:] = False
        tensors["brick.mask"] = np.packbits(stored, axis=1, bitorder="little").view("<u8").reshape(bricks, -1)
        count = int(stored.sum())
        if layout == "sparse":
            tensors |= {"voxel.density": drawn(count, signed=False).astype("<f2"), "voxel.sh": drawn(count, terms, 3).astype("<f2")}
        else:
            entries, group = 1 + number(rng, 300), number(rng, 2)
            meta["sh_groups"] = [terms - 1] if group and terms > 1 else [1] * (terms - 1)
            codes = rng.integers(entries, size=(count, len(meta["sh_groups"])))
            tensors |= {
                "voxel.density": rng.integers(3, size=count).astype("<u1"), "density.table": drawn(3, signed=False).astype("<f4"),
                "voxel.base": rng.integers(4, size=(count, 3)).astype("<u1"), "base.table": drawn(4, 3).astype("<f4"),
                "voxel.sh": codes.astype("<u2" if entries > 256 else "<u1"), "sh.palette": drawn(entries, terms - 1, 3).astype("<f2"),
            }  # fmt: skip
    header, body = {}, b""
    for name, values in tensors.items():
        raw = np.ascontiguousarray(values).tobytes()
        kind = next(key for key, dtype in DTYPES.items() if np.dtype(dtype) == values.dtype)
        header[name] = {"dtype": kind, "shape": list(values.shape), "data_offsets": [len(body), len(body) + len(raw)]}
        body += raw
    meta |= {
        "format": "nerftree", "format_version": "1.4",
        "layout": ("nearest-" if nearest else "") + ("ndc-" if ndc else "nested-" if nested else "") + layout,
        "sh_degree": degree, "sh_convention": "real-orthonormal-plenoctree", "colour_space": "srgb-sigmoid", "background": None,
        "sha256": {name: hashlib.sha256(np.ascontiguousarray(values).tobytes()).hexdigest() for name, values in tensors.items()},
    }  # fmt: skip
    if nearest:
        meta["lookup"] = "nearest"
    if ndc:
        meta["ndc"] = {"world_from_camera": np.eye(4).tolist(), "focal": 400.0, "width": 504.0, "height": 378.0, "near": 1.0}
    data = file_of(header, meta, body)
    return data if number(rng, 2) else with_numbers(rng, data)


def changed(rng: Rng, seeds: list[bytes]) -> tuple[str, bytes]:
    """The kind of mutation, and the file."""
    data = seeds[number(rng, len(seeds))]
    kind = number(rng, 8)
    if kind == 0:
        return "bytes", with_bytes(rng, data, 0, len(data))
    if kind == 1:
        return "header bytes", with_bytes(rng, data, 0, 8 + int.from_bytes(data[:8], "little"))
    if kind == 2:
        header, meta, body = header_of(data)
        for _ in range(1 + number(rng, 2)):
            header, meta = (with_values(rng, header), meta) if number(rng, 2) else (header, with_values(rng, meta))
        return "json", file_of(header, meta, body)
    if kind == 3:
        return "tensor", with_tensor(rng, data)
    if kind == 4:
        return "values", with_values_of_tensors(rng, data)
    if kind == 5:
        return "numbers", with_numbers(rng, data)
    return "built", built(rng)
