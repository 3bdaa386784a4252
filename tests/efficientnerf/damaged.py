"""Damaged asset files: the tiny file in each layout, its parts, and what puts them together again with something changed."""

import hashlib
import json
import math
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

from efficientnerf.asset.cascades import cascade_grids
from efficientnerf.asset.file.container import DTYPES
from efficientnerf.asset.format import LAYOUTS, serialize
from efficientnerf.asset.tree import NerfTree, Region
from tests.efficientnerf.trees import LOW, random_cascades, random_tree

SIMILARITY = {"scale": 0.5, "rotation": [[1, 0, 0], [0, 0, 1], [0, -1, 0]], "translation": [1, 2, 3]}
ORBIT = {"centre": [0.0, 0.1, 0.2], "radius": 3.0, "elevation": 25.0, "forward_facing": False, "heading": 40.0}
METADATA = {"world_from_capture": SIMILARITY, "orbit": ORBIT, "metric": True, "licence": "CC0-1.0", "provenance": {"tool": "a test"}}
TENSORS = ("coarse.occupancy", *LAYOUTS["sparse"].tensors)
NESTED = ("nested-sparse", "nested-compact", "nested-packed", "nested-full")


def tiny(degree: int = 0, **more: Any) -> NerfTree:
    return random_tree(1, shape=(2, 1, 2), brick=2, degree=degree, share=0.7, metadata=METADATA, **more)


def tiny_scene(degree: int = 0) -> NerfTree:
    """Two cascades with an environment map and a region of some bricks."""
    tree = random_cascades(6, count=2, brick=1, degree=degree, share=0.1, metadata=METADATA)
    region = Region(np.stack([LOW, LOW + 0.3]), 0.1, 0.05, np.arange(len(tree.voxel_index)) % 3 > 0)
    return replace(tree, environment=tree.environment[:2, :4], region=region)


@cache
def blob(of: str = "sparse") -> bytes:
    """The tiny file in one of the layouts, `nested-` ones among them; codes need harmonics to stand for."""
    layout = of.removeprefix("nested-")
    degree = 0 if layout == "sparse" else 1
    return serialize(tiny(degree) if layout == of else tiny_scene(degree), layout)


def parts(data: bytes) -> tuple[dict[str, Any], dict[str, Any], bytes]:
    """Header without metadata, the metadata, the data."""
    length = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + length])
    return header, json.loads(header.pop("__metadata__")["nerftree"]), data[8 + length :]


def joined(header: dict[str, Any], meta: dict[str, Any] | str, data: bytes) -> bytes:
    text = meta if isinstance(meta, str) else json.dumps(meta)
    raw = json.dumps({"__metadata__": {"nerftree": text}, **header}).encode()
    return len(raw).to_bytes(8, "little") + raw + data


def with_tensor(name: str, values: np.ndarray, of: str = "sparse") -> bytes:
    """The tiny file with one tensor replaced, digest and offsets put right."""
    header, meta, data = parts(blob(of))
    begin, end = header[name]["data_offsets"]
    raw = values.tobytes()
    for entry in header.values():
        entry["data_offsets"] = [n + len(raw) - (end - begin) if n >= end else n for n in entry["data_offsets"]]
    header[name] = {"dtype": header[name]["dtype"], "shape": list(values.shape), "data_offsets": [begin, begin + len(raw)]}
    meta["sha256"][name] = hashlib.sha256(raw).hexdigest()
    return joined(header, meta, data[:begin] + raw + data[end:])


def tensor(name: str, of: str = "sparse") -> np.ndarray:
    header, _, data = parts(blob(of))
    begin, end = header[name]["data_offsets"]
    return np.frombuffer(data[begin:end], DTYPES[header[name]["dtype"]]).reshape(header[name]["shape"]).copy()


def meta_with(of: str = "sparse", **changes: Any) -> bytes:
    header, meta, data = parts(blob(of))
    return joined(header, {key: value for key, value in {**meta, **changes}.items() if value != "absent"}, data)


def header_with(name: str, of: str = "sparse", **changes: Any) -> bytes:
    header, meta, data = parts(blob(of))
    header[name] = {key: value for key, value in {**header[name], **changes}.items() if value != "absent"}
    return joined(header, meta, data)


def replaced(old: bytes, new: bytes) -> bytes:
    """The tiny file with its header text changed; the header's length follows."""
    data = blob()
    length = int.from_bytes(data[:8], "little")
    raw = data[8 : 8 + length]
    assert old in raw
    raw = raw.replace(old, new, 1)
    return len(raw).to_bytes(8, "little") + raw + data[8 + length :]


def without(name: str, of: str = "sparse") -> bytes:
    header, meta, data = parts(blob(of))
    begin, end = header.pop(name)["data_offsets"]
    for entry in header.values():
        entry["data_offsets"] = [n - (end - begin) if n >= end else n for n in entry["data_offsets"]]
    return joined(header, meta, data[:begin] + data[end:])


def added(name: str, dtype: str = "F64", of: str = "sparse") -> bytes:
    header, meta, data = parts(blob(of))
    header[name] = {"dtype": dtype, "shape": [1], "data_offsets": [len(data), len(data) + 8]}
    return joined(header, meta, data + bytes(8))


def negative(name: str, of: str = "sparse") -> np.ndarray:
    values = tensor(name, of)
    values.reshape(-1)[0] = -1 if "density" in name else np.inf
    return values


def nan(name: str, of: str = "sparse") -> np.ndarray:
    values = tensor(name, of)
    values.reshape(-1)[-1] = np.nan
    return values


def flipped(name: str, bit: int) -> np.ndarray:
    values = tensor(name)
    values.reshape(-1)[-1] ^= np.array(1 << bit).astype(values.dtype)
    return values


def rotated(**changes: Any) -> bytes:
    return meta_with(world_from_capture={**SIMILARITY, **changes})


def reference(**changes: Any) -> bytes:
    eye = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    return meta_with(layout="ndc-sparse", ndc={"world_from_camera": eye, "focal": 400, "width": 504, "height": 378, "near": 1, **changes})


def spiral(value: Any) -> bytes:
    header, meta, data = parts(reference())
    return joined(header, {**meta, "spiral": value}, data)


def filled(cells: tuple[int, int, int], occupied: int, brick: int = 1) -> bytes:
    """A sound file of `cells`, of which the first ones are `occupied` and store one voxel each."""
    occupancy = np.zeros(-(-math.prod(cells) // 8), np.uint8)
    occupancy[: occupied // 8] = 255
    occupancy[occupied // 8 :][:1] |= (1 << occupied % 8) - 1
    mask = np.zeros((occupied, -(-(brick**3) // 64)), "<u8")
    mask[:, 0] = 1
    density, sh = np.ones(occupied, "<f2"), np.zeros((occupied, 1, 3), "<f2")
    _, meta, _ = parts(blob())
    header: dict[str, Any] = {}
    data = b""
    for name, values in zip(TENSORS, (occupancy, mask, density, sh), strict=True):
        raw = values.tobytes()
        dtype = next(key for key, value in DTYPES.items() if value == values.dtype)
        header[name] = {"dtype": dtype, "shape": list(values.shape), "data_offsets": [len(data), len(data) + len(raw)]}
        meta["sha256"][name] = hashlib.sha256(raw).hexdigest()
        data += raw
    return joined(header, {**meta, "shape": list(cells), "brick": brick}, data)


def cascade(**changes: Any) -> bytes:
    """Two cascades, the outer of which is changed."""
    _, meta, _ = parts(blob(NESTED[0]))
    return meta_with(NESTED[0], cascades=[{key: value for key, value in {**meta["cascades"][0], **changes}.items() if value != "absent"}])


def region(**changes: Any) -> bytes:
    _, meta, _ = parts(blob(NESTED[0]))
    return meta_with(NESTED[0], region={key: value for key, value in {**meta["region"], **changes}.items() if value != "absent"})


def shells(count: int, cells: int) -> bytes:
    """A file that claims so many cascades of `cells` along each side, nothing in any."""
    header, meta, data = parts(blob(NESTED[0]))
    low = [-cells / 2 * 0.1 * 2**n for n in range(count)]
    meta |= {"shape": [cells] * 3, "voxel": 0.1, "bounds_min": [low[0]] * 3, "cascades": [{"shape": [cells] * 3, "bounds_min": [x] * 3} for x in low[1:]]}
    return joined(header, meta, data)


def orbiting(**changes: Any) -> bytes:
    return meta_with(orbit={**ORBIT, **changes})


def padded(data: bytes) -> bytes:
    end = 8 + int.from_bytes(data[:8], "little")
    return (end - 8 + 5).to_bytes(8, "little") + data[8:end] + b"     " + data[end:]


def hollow() -> bytes:
    """Three cascades of 400 cells along each side, all empty."""
    bounds = np.stack([np.zeros(3), np.full(3, 400.0)])
    grids = cascade_grids(bounds, 1.0, 1, 3)
    header, meta, _ = parts(blob(NESTED[0]))
    (shape, voxel, low), *outer = grids
    meta |= {"shape": list(shape), "voxel": voxel, "bounds_min": low.tolist(), "region": "absent", "environment": None}
    meta["cascades"] = [{"shape": list(cells), "bounds_min": corner.tolist()} for cells, _, corner in outer]
    del meta["region"]
    empty = np.zeros(400**3 // 8, np.uint8).tobytes()
    data, entries = b"", {}
    for n in range(3):
        entries[f"coarse.occupancy.{n}" if n else "coarse.occupancy"] = {
            "dtype": "U8",
            "shape": [len(empty)],
            "data_offsets": [len(data), len(data) + len(empty)],
        }
        data += empty
    for name, shape_ in (("brick.mask", [0, 1]), ("voxel.density", [0]), ("voxel.sh", [0, 1, 3])):
        entries[name] = {"dtype": header[name]["dtype"], "shape": shape_, "data_offsets": [len(data), len(data)]}
    return joined(entries, meta, data)


def beyond_the_last_cell() -> bytes:
    """An outer cascade of 4 by 3 by 3 cells around an inner one of 4 by 2 by 2, and a bit more."""
    tree = random_cascades(6, count=2, brick=1, share=0.1)
    outer = replace(tree.outer[0], shape=(4, 3, 3), brick_index=tree.outer[0].brick_index[:, :3, :3])
    inner = tree.brick_index[:, :2, :2]
    kept = np.sort(np.concatenate([index[index >= 0] for index in (inner, outer.brick_index)]))
    number = np.full(len(tree.voxel_index) + 1, -1, np.int32)
    number[kept] = np.arange(len(kept))
    smaller = replace(
        tree, shape=(4, 2, 2), brick_index=number[inner], voxel_index=np.arange(len(kept), dtype=np.int32)[:, None],
        density_values=tree.density_values[: len(kept)],
        harmonics=tree.sh[: len(kept)],
        outer=(replace(outer, brick_index=number[outer.brick_index]),),
    )  # fmt: skip
    header, meta, data = parts(serialize(smaller))
    begin, end = header["coarse.occupancy.1"]["data_offsets"]
    raw = data[begin : end - 1] + bytes([data[end - 1] | 128])
    meta["sha256"]["coarse.occupancy.1"] = hashlib.sha256(raw).hexdigest()
    return joined(header, meta, data[:begin] + raw + data[end:])


def overlapping(of: str = "sparse") -> bytes:
    header, meta, data = parts(blob(of))
    header["x.a"] = {"dtype": "F64", "shape": [1], "data_offsets": [0, 8]}
    return joined(header, meta, data)


def without_entry(name: str, of: str = "sparse") -> bytes:
    header, meta, data = parts(blob(of))
    del header[name]
    return joined(header, meta, data)
