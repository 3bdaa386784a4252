"""A hostile file for each rule of FORMAT.md, and what is said of it; `make docs` makes docs/hostile.md of the table."""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

from efficientnerf.asset.cascades import cascade_grids
from efficientnerf.asset.file.container import DTYPES
from efficientnerf.asset.format import LAYOUTS, serialize
from efficientnerf.asset.region import Region
from efficientnerf.asset.tree import NerfTree
from tests.efficientnerf.trees import LOW, random_cascades, random_tree

SIMILARITY = {"scale": 0.5, "rotation": [[1, 0, 0], [0, 0, 1], [0, -1, 0]], "translation": [1, 2, 3]}
ORBIT = {"centre": [0.0, 0.1, 0.2], "radius": 3.0, "elevation": 25.0, "forward_facing": False, "heading": 40.0}
METADATA = {"world_from_capture": SIMILARITY, "orbit": ORBIT, "metric": True, "licence": "CC0-1.0", "provenance": {"tool": "a test"}}


TENSORS = ("coarse.occupancy", *LAYOUTS["sparse"].tensors)


def tiny(degree: int = 0, **more: Any) -> NerfTree:
    return random_tree(1, shape=(2, 1, 2), brick=2, degree=degree, share=0.7, metadata=METADATA, **more)


NESTED = ("nested-sparse", "nested-compact", "nested-full")


def tiny_scene(degree: int = 0) -> NerfTree:
    """Two cascades with an environment map and a region of some bricks."""
    tree = random_cascades(6, count=2, brick=1, degree=degree, share=0.1, metadata=METADATA)
    assert tree.environment is not None
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


HOSTILE: dict[str, tuple[Callable[[], bytes], str]] = {
    # container
    "empty": (lambda: b"", "0 bytes; a NerfTree begins with an 8-byte header length"),
    "header longer than the file": (lambda: (10**6).to_bytes(8, "little") + b"{}", "header of 1000000 bytes in a file of 10"),
    "header longer than anything": (lambda: b"\xff" * 8 + b"{}", "header of 18446744073709551615 bytes"),
    "a PNG": (lambda: b"\x89PNG\r\n\x1a\n" + bytes(100), "no NerfTree"),
    "not JSON": (lambda: (4).to_bytes(8, "little") + b"{]]}", "header is not JSON"),
    "not UTF-8": (lambda: replaced(b'"bounds_min', b'"bounds\xff_min'[1:]), "header is not JSON"),
    "UTF-16": (lambda: (lambda raw: len(raw).to_bytes(8, "little") + raw)("{}".encode("utf-16")), "header is not JSON"),
    "nested deep": (lambda: (lambda raw: len(raw).to_bytes(8, "little") + raw)(b"[" * 200_000), "header is not JSON"),
    "a list": (lambda: (2).to_bytes(8, "little") + b"[]", "header is not a JSON object"),
    "no metadata": (lambda: (2).to_bytes(8, "little") + b"{}", "a safetensors file without 'nerftree' metadata"),
    "metadata is no text": (lambda: (lambda raw: len(raw).to_bytes(8, "little") + raw)(b'{"__metadata__":{"nerftree":3}}'), "without 'nerftree' metadata"),
    "metadata is not JSON": (lambda: joined({}, "{", b""), "header is not JSON"),
    "a key named twice": (lambda: joined({}, '{"format": "nerftree", "format": "nerftree"}', b""), "names a key twice"),
    "NaN in the metadata": (lambda: joined({}, '{"format": NaN}', b""), "NaN, which is no finite number"),
    "an infinite number": (lambda: meta_with(note="x").replace(b'\\"note\\": \\"x\\"', b'\\"note\\": 1e999'), "1e999, which is no finite number"),
    "an entry with more keys": (lambda: header_with("brick.mask", colour="red"), "expected dtype, shape and data_offsets"),
    "an entry with fewer keys": (lambda: header_with("brick.mask", shape="absent"), "expected dtype, shape and data_offsets"),
    "a negative count": (lambda: header_with("brick.mask", shape=[-1, 1]), "is not a list of counts"),
    "a fractional count": (lambda: header_with("brick.mask", shape=[1.5, 1]), "is not a list of counts"),
    "a huge count": (lambda: header_with("brick.mask", shape=[2**60, 1]), "is not a list of counts"),
    "offsets the wrong way": (lambda: header_with("brick.mask", data_offsets=[8, 0]), "are not a range"),
    "offsets beyond the end": (lambda: header_with("brick.mask", data_offsets=[0, 10**9]), "the file is cut short"),
    "too few bytes for the shape": (lambda: header_with("brick.mask", shape=[1000, 1]), "does not fill its"),
    "overlapping tensors": (lambda: overlapping(), "tensors must lie end to end"),
    "a gap": (lambda: without_entry("voxel.density"), "tensors must lie end to end|appended to"),
    "bytes appended": (lambda: serialize(tiny()) + b"\0", "1 bytes after the last tensor; the file was appended to"),
    "a million empty lists": (lambda: meta_with(note=[[]] * 2**19), "header of more than 1048576 commas, brackets and braces"),
    # metadata
    "another format": (lambda: meta_with(format="octree"), "metadata 'format' is octree; expected nerftree"),
    "version 2": (lambda: meta_with(format_version="2.0"), r"format version 2\.0; this build reads 1\.x\. Upgrade"),
    "no version": (lambda: meta_with(format_version="absent"), "expected MAJOR.MINOR"),
    "a strange version": (lambda: meta_with(format_version="1.٠"), "expected MAJOR.MINOR"),
    "a version that is a number": (lambda: meta_with(format_version=1), "expected MAJOR.MINOR"),
    "another layout": (lambda: meta_with(layout="octree"), "layout octree; this build reads sparse, compact, full. Upgrade"),
    "other harmonics": (lambda: meta_with(sh_convention="complex"), "harmonics complex"),
    "another colour space": (lambda: meta_with(colour_space="linear"), "expected real-orthonormal-plenoctree in srgb-sigmoid"),
    "no shape": (lambda: meta_with(shape="absent"), "'shape' is None; expected 3 numbers"),
    "a shape of two": (lambda: meta_with(shape=[2, 2]), "expected 3 numbers"),
    "a fractional shape": (lambda: meta_with(shape=[2, 1, 2.5]), "expected whole numbers"),
    "a shape of nothing": (lambda: meta_with(shape=[0, 1, 2]), "expected 3 numbers from 1"),
    "a shape too large": (lambda: meta_with(shape=[65536, 65536, 65536]), "a product of at most 1073741824"),
    "a shape of true": (lambda: meta_with(shape=[True, 1, 2]), "expected 3 numbers"),
    "brick 0": (lambda: meta_with(brick=0), "'brick' is 0; expected a whole number from 1 to 16"),
    "brick 17": (lambda: meta_with(brick=17), "expected a whole number from 1 to 16"),
    "degree 5": (lambda: meta_with(sh_degree=5), "expected a whole number from 0 to 4"),
    "degree true": (lambda: meta_with(sh_degree=True), "expected a whole number from 0 to 4"),
    "no voxel": (lambda: meta_with(voxel=0), "'voxel' is 0"),
    "a voxel of text": (lambda: meta_with(voxel="1"), "'voxel' is 1; expected a number"),
    "no corner": (lambda: meta_with(bounds_min=[0, 0]), "'bounds_min'"),
    "a corner far away": (lambda: meta_with(bounds_min=[0, 0, 10**400]), "'bounds_min'"),
    "a corner beyond what floats resolve": (lambda: meta_with(bounds_min=[0, 0, 1e20]), "'bounds_min'"),
    "no background": (lambda: meta_with(background="absent"), "'background' is missing"),
    "a bright background": (lambda: meta_with(background=[1, 1, 2]), "expected 3 numbers from 0 to 1"),
    "a similarity of text": (lambda: meta_with(world_from_capture="identity"), "'world_from_capture' is identity; expected an object"),
    "a similarity without scale": (lambda: meta_with(world_from_capture={}), "'scale' is None"),
    "a scale of zero": (lambda: rotated(scale=0), "'scale' is 0"),
    "a rotation of two rows": (lambda: rotated(rotation=[[1, 0, 0], [0, 1, 0]]), "expected three rows"),
    "a rotation of short rows": (lambda: rotated(rotation=[[1, 0], [0, 1, 0], [0, 0, 1]]), "expected 3 numbers"),
    "a reflection": (lambda: rotated(rotation=[[1, 0, 0], [0, 1, 0], [0, 0, -1]]), "is not a rotation"),
    "a shear": (lambda: rotated(rotation=[[1, 0.1, 0], [0, 1, 0], [0, 0, 1]]), "is not a rotation"),
    "a translation of text": (lambda: rotated(translation="0 0 0"), "'translation'"),
    "an orbit of text": (lambda: meta_with(orbit="round"), "'orbit' is round; expected an object"),
    "an orbit without centre": (lambda: meta_with(orbit={"radius": 1}), "'centre' is None"),
    "an orbit around somewhere else": (lambda: orbiting(centre=[0, 1e25, 0]), "'centre'"),
    "an orbit beyond what floats resolve": (lambda: orbiting(radius=1e25), "'radius'"),
    "an orbit of no radius": (lambda: orbiting(radius=0), "'radius' is 0"),
    "an orbit below the ground": (lambda: orbiting(elevation=-91), "'elevation' is -91"),
    "an orbit that winds": (lambda: orbiting(heading=1e9), "'heading'"),
    "an orbit facing 1": (lambda: orbiting(forward_facing=1), "'forward_facing' is 1; expected true or false"),
    "metric 1": (lambda: meta_with(metric=1), "'metric' is 1; expected true or false"),
    # tensors
    "a tensor of another name": (lambda: added("voxel.roughness"), r"unknown tensor 'voxel\.roughness'; only names that begin with 'x\.'"),
    **{f"no {name}": (lambda name=name: without(name), f"tensor '{re.escape(name)}' is missing") for name in TENSORS},  # type: ignore[misc]
    "densities of integers": (lambda: header_with("voxel.density", dtype="I16"), "is I16; expected F16"),
    "a dtype of another world": (lambda: header_with("voxel.density", dtype=["F16"]), "expected F16"),
    "too few cells": (lambda: with_tensor("coarse.occupancy", np.zeros(0, "<u1")), r"has shape \(0,\); expected \(1,\)"),
    "masks of two words": (lambda: with_tensor("brick.mask", np.zeros((3, 2), "<u8")), r"'brick\.mask' has shape \(3, 2\)"),
    "fewer harmonics than densities": (lambda: with_tensor("voxel.sh", tensor("voxel.sh")[:-1]), r"'voxel\.sh' has shape"),
    "harmonics of another degree": (lambda: meta_with(sh_degree=1), r"'voxel\.sh' has shape"),
    "densities in a table": (lambda: with_tensor("voxel.density", tensor("voxel.density")[:, None]), r"'voxel\.density' has shape"),
    "a wrong digest": (lambda: meta_with(sha256=dict.fromkeys(TENSORS, "0" * 64)), "SHA-256 .* the file says 0{12}…; the file is damaged"),
    "no digests": (lambda: meta_with(sha256="absent"), "the file is damaged"),
    "a cell beyond the last": (lambda: with_tensor("coarse.occupancy", flipped("coarse.occupancy", 7)), "bits set beyond its 4 cells"),
    "a brick without a cell": (lambda: with_tensor("coarse.occupancy", np.zeros(1, "<u1")), "0 occupied cells but"),
    "a voxel beyond the brick": (lambda: with_tensor("brick.mask", flipped("brick.mask", 8)), "bits set beyond the 8 voxels of a brick"),
    "a voxel more than stored": (lambda: with_tensor("brick.mask", tensor("brick.mask") * np.uint64(0)), "masks name 0 voxels but"),
    "a density below zero": (lambda: with_tensor("voxel.density", negative("voxel.density")), "densities must be finite and not negative"),
    "a density that is no number": (lambda: with_tensor("voxel.density", nan("voxel.density")), "densities must be finite"),
    "an infinite harmonic": (lambda: with_tensor("voxel.sh", negative("voxel.sh")), "harmonics finite"),
    # compact
    **{f"compact, no {name}": (lambda name=name: without(name, "compact"), f"tensor '{re.escape(name)}' is missing") for name in LAYOUTS["compact"].tensors},  # type: ignore[misc]
    "codes of a type too wide": (lambda: header_with("voxel.sh", "compact", dtype="I8"), r"'voxel\.sh' is I8; expected U8 or U16"),
    "no groups": (lambda: meta_with("compact", sh_groups="absent"), "'sh_groups' is None; expected whole numbers above 0 whose sum is 3"),
    "groups of text": (lambda: meta_with("compact", sh_groups=["3"]), "'sh_groups'"),
    "a group of nothing": (lambda: meta_with("compact", sh_groups=[3, 0]), "'sh_groups'"),
    "groups for another degree": (lambda: meta_with("compact", sh_groups=[1, 1]), "'sh_groups'"),
    "fewer codes than groups": (lambda: with_tensor("voxel.sh", tensor("voxel.sh", "compact")[:, :2], "compact"), r"'voxel\.sh' has shape"),
    "a palette of other harmonics": (lambda: with_tensor("sh.palette", tensor("sh.palette", "compact")[:, :2], "compact"), r"'sh\.palette' has shape"),
    "a table in a row": (lambda: with_tensor("base.table", tensor("base.table", "compact")[:, 0], "compact"), r"'base\.table' has shape"),
    "a table too long": (lambda: with_tensor("density.table", np.zeros(257, "<f4"), "compact"), r"'density\.table' has 257 entries; expected at most 256"),
    "a palette too long": (lambda: with_tensor("sh.palette", np.zeros((65537, 3, 3), "<f2"), "compact"), r"'sh\.palette' has 65537 entries"),
    "a base for fewer voxels": (lambda: with_tensor("voxel.base", tensor("voxel.base", "compact")[:-1], "compact"), r"'voxel\.base' has shape"),
    **{
        f"a code beyond {table}": (  # type: ignore[misc]
            lambda table=table: with_tensor(table, tensor(table, "compact")[:-1], "compact"),
            f"expected codes below the [0-9]+ entries of '{re.escape(table)}'",
        )
        for table in ("density.table", "base.table", "sh.palette")
    },
    "a table below zero": (lambda: with_tensor("density.table", negative("density.table", "compact"), "compact"), "densities must be finite and not negative"),
    "a base that is no number": (lambda: with_tensor("base.table", nan("base.table", "compact"), "compact"), "harmonics finite"),
    "an infinite palette": (lambda: with_tensor("sh.palette", negative("sh.palette", "compact"), "compact"), "harmonics finite"),
    "masks of no voxel but codes": (lambda: with_tensor("brick.mask", tensor("brick.mask", "compact") * np.uint64(0), "compact"), "masks name 0 voxels but"),
    # normalised device coordinates
    "no reference camera": (lambda: meta_with(layout="ndc-sparse"), "'ndc' is None; expected an object"),
    "a reference camera of text": (lambda: meta_with(layout="ndc-sparse", ndc="pinhole"), "'ndc' is pinhole; expected an object"),
    "a reference camera without focal length": (lambda: reference(focal=0), "'focal' is 0"),
    "a reference camera of three rows": (lambda: reference(world_from_camera=[[1, 0, 0, 0]] * 3), "expected four rows"),
    "a reference camera of short rows": (lambda: reference(world_from_camera=[[1, 0, 0]] * 4), "expected 4 numbers"),
    "a reference camera that shears": (lambda: reference(world_from_camera=[[1, 1, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]), "'ndc': "),
    # nearest lookup
    "nearest by its layout alone": (lambda: meta_with(layout="nearest-sparse"), "'lookup' is None; expected nearest in layout nearest-sparse"),
    "nearest by its layout, trilinear by its word": (lambda: meta_with(layout="nearest-sparse", lookup="trilinear"), "'lookup' is trilinear; expected nearest"),
    "nearest by its word alone": (lambda: meta_with(lookup="nearest"), "'lookup' is nearest; expected trilinear in layout sparse"),
    "a lookup of no name": (lambda: meta_with(lookup="cubic"), "'lookup' is cubic; expected trilinear"),
    "a lookup of numbers": (lambda: meta_with(layout="nearest-sparse", lookup=[1]), r"'lookup' is \[1\]; expected nearest"),
    "prefixes the wrong way round": (lambda: meta_with(layout="ndc-nearest-sparse", lookup="nearest"), "layout ndc-nearest-sparse; this build reads"),
    "nearest, but no reference camera": (lambda: meta_with(layout="nearest-ndc-sparse", lookup="nearest"), "'ndc' is None; expected an object"),
    "a reference camera as wide as the sky": (lambda: reference(width=1e30), "2 f / w and 2 f / h are 8e-28 and .*; expected 1e-06 to 1e\\+06"),
    "a reference camera of endless focal length": (lambda: reference(focal=1e30), "2 f / w and 2 f / h"),
    "a reference camera that is far away": (
        lambda: reference(world_from_camera=[[1, 0, 0, 1e20], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]),
        "times `near` from the world's origin",
    ),
    "a reference camera with its near plane on its centre": (
        lambda: reference(near=1e-30, world_from_camera=[[1, 0, 0, 1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]),
        "times `near` from the world's origin",
    ),
    "a spiral of text": (lambda: spiral("round"), "'spiral' is round; expected an object"),
    "a spiral of two radii": (lambda: spiral({"radii": [1, 1]}), "'radii'"),
    "a spiral that goes on for ever": (lambda: spiral({"radii": [1e30, 1, 1]}), "'radii'"),
    "a spiral without focus": (lambda: spiral({"focus": 0}), "'focus' is 0"),
    "a spiral of no width": (lambda: spiral({"tangents": [0, 1]}), "'tangents'"),
    "a spiral that ends behind its camera": (lambda: spiral({"far": -1}), "'far' is -1"),
    # nested grids
    "nested, no cascades": (lambda: meta_with(NESTED[0], cascades="absent"), "'cascades' is None; expected a list of at most 15 objects"),
    "cascades of text": (lambda: meta_with(NESTED[0], cascades="two"), "'cascades' is two; expected a list"),
    "cascades of numbers": (lambda: meta_with(NESTED[0], cascades=[2]), r"'cascades' is \[2\]; expected a list of at most 15 objects"),
    "seventeen cascades": (lambda: shells(17, 4), "expected a list of at most 15 objects"),
    "a cascade without shape": (lambda: cascade(shape="absent"), r"'shape' is None; expected 3 numbers .*\(cascade 1\)"),
    "a cascade of fractional shape": (lambda: cascade(shape=[4, 4, 4.5]), r"expected whole numbers .*\(cascade 1\)"),
    "a cascade of nothing": (lambda: cascade(shape=[4, 0, 4]), r"'shape' is \[4, 0, 4\]; expected 3 numbers from 1"),
    "a cascade too large": (lambda: cascade(shape=[65536] * 3), r"a product of at most 1073741824 \(cascade 1\)"),
    "cascades too large together": (lambda: shells(10, 512), "cascades of 1342177280 coarse cells; expected at most 1073741824 in all"),
    "a cascade without corner": (lambda: cascade(bounds_min="absent"), r"'bounds_min' is None; expected 3 numbers .*\(cascade 1\)"),
    "a cascade beyond what floats resolve": (lambda: cascade(bounds_min=[0, 0, 1e20]), "'bounds_min'"),
    "a cascade off its cells": (lambda: cascade(bounds_min=[-0.95, 0, -1.3]), "the box of cascade 0 does not lie on faces of the coarse cells of cascade 1"),
    "a cascade beside the one before": (lambda: cascade(bounds_min=[-0.5, 0, -1.3]), "cascade 1 does not enclose cascade 0"),
    "a cascade that ends too early": (lambda: cascade(shape=[4, 4, 2]), "cascade 1 does not enclose cascade 0"),
    "a cascade of an odd number of cells": (lambda: meta_with(NESTED[0], shape=[4, 4, 3]), "the box of cascade 0 does not lie on faces"),
    "a cascade without cells": (lambda: without("coarse.occupancy.1", NESTED[0]), r"tensor 'coarse\.occupancy\.1' is missing"),
    "cells of no cascade": (lambda: meta_with(NESTED[0], cascades=[]), r"unknown tensor 'coarse\.occupancy\.1'"),
    "cells of a cascade in a layout of one grid": (lambda: added("coarse.occupancy.1"), r"unknown tensor 'coarse\.occupancy\.1'"),
    "too few cells of a cascade": (
        lambda: with_tensor("coarse.occupancy.1", np.zeros(7, "<u1"), NESTED[0]),
        r"'coarse\.occupancy\.1' has shape \(7,\); expected \(8,\)",
    ),
    "a cell beyond a cascade's last": (lambda: beyond_the_last_cell(), r"'coarse\.occupancy\.1' has bits set beyond its 36 cells"),
    "fewer cells than bricks in all cascades": (
        lambda: with_tensor("coarse.occupancy.1", np.zeros(8, "<u1"), NESTED[0]),
        "[0-9]+ occupied cells but [0-9]+ brick masks",
    ),
    "nested by its cascades alone": (lambda: meta_with(NESTED[0], layout="sparse"), "unknown tensor"),
    "nested by its layout alone": (lambda: meta_with(layout="nested-sparse"), "'cascades' is None; expected a list"),
    "nested in normalised device coordinates": (lambda: meta_with(NESTED[0], layout="nested-ndc-sparse"), "layout nested-ndc-sparse; this build reads"),
    "normalised device coordinates that are nested": (lambda: meta_with(NESTED[0], layout="ndc-nested-sparse"), "layout ndc-nested-sparse; this build reads"),
    "nested before nearest": (
        lambda: meta_with(NESTED[0], layout="nested-nearest-sparse", lookup="nearest"),
        "layout nested-nearest-sparse; this build reads",
    ),
    # environment map
    "nested, no word of an environment": (lambda: meta_with(NESTED[0], environment="absent"), "'environment' is missing; expected the rows of the map or null"),
    "an environment of no rows": (lambda: meta_with(NESTED[0], environment=0), "'environment' is 0; expected a whole number from 1 to 2048"),
    "an environment of too many rows": (lambda: meta_with(NESTED[0], environment=2049), "'environment' is 2049"),
    "an environment that is true": (lambda: meta_with(NESTED[0], environment=True), "'environment' is True"),
    "an environment without a map": (lambda: without("environment", NESTED[0]), "tensor 'environment' is missing"),
    "a map without an environment": (lambda: meta_with(NESTED[0], environment=None), "unknown tensor 'environment'"),
    "a map in a layout of one grid": (lambda: added("environment"), "unknown tensor 'environment'"),
    "a map of other rows": (lambda: meta_with(NESTED[0], environment=3), r"'environment' has shape \(2, 4, 3\); expected \(3, 6, 3\)"),
    "a square map": (lambda: with_tensor("environment", np.zeros((2, 2, 3), "<u1"), NESTED[0]), r"has shape \(2, 2, 3\); expected \(2, 4, 3\)"),
    "a map of halves": (lambda: header_with("environment", NESTED[0], dtype="I8"), "'environment' is I8; expected U8"),
    # region
    "a region of text": (lambda: meta_with(NESTED[0], region="front"), "'region' is front; expected an object"),
    "a region that is null": (lambda: meta_with(format_version="1.4", region=None), "'region' is None; expected an object"),
    "a region without bounds": (lambda: region(bounds="absent"), "'bounds' is None; expected two corners"),
    "a region of one corner": (lambda: region(bounds=[[0, 0, 0]]), "expected two corners"),
    "a region of short corners": (lambda: region(bounds=[[0, 0], [1, 1]]), "expected 3 numbers"),
    "a region from its greatest corner": (lambda: region(bounds=[[0, 0, 0], [1, -1, 1]]), "expected the least corner, then the greatest"),
    "a region without height": (lambda: region(bounds=[[0, 0, 0], [1, 1, 0]]), "expected the least corner, then the greatest"),
    "a region beyond what floats resolve": (lambda: region(bounds=[[0, 0, 0], [1, 1, 1e20]]), "'bounds'"),
    "a region of negative radius": (lambda: region(corner_radius=-0.1), "'corner_radius' is -0.1"),
    "a region without fade": (lambda: region(fade="absent"), "'fade' is None"),
    "a region of bricks, perhaps": (lambda: region(bricks=1), "'bricks' is 1; expected true or false"),
    "a region without its bricks": (lambda: without("x.region.bricks", NESTED[0]), r"tensor 'x\.region\.bricks' is missing"),
    "a region of other bricks": (
        lambda: with_tensor("x.region.bricks", np.zeros(9, "<u1"), NESTED[0]),
        r"'x\.region\.bricks' has shape \(9,\); expected \([0-9],\)",
    ),
    "a region of halves": (lambda: header_with("x.region.bricks", NESTED[0], dtype="I8"), r"'x\.region\.bricks' is I8; expected U8"),
    "a brick beyond the last": (
        lambda: with_tensor("x.region.bricks", tensor("x.region.bricks", NESTED[0]) | np.uint8(128), NESTED[0]),
        r"'x\.region\.bricks' has bits set beyond its [0-9]+ bricks",
    ),
    # memory
    "nearly empty cascades": (lambda: hollow(), r"take [0-9]+ MB of memory; expected at most 8 times the size and 200 MB"),
    "one voxel in 2^27 cells": (lambda: filled((512, 512, 512), 1), r"16\.8 MB that take 805 MB of memory; expected at most 8 times the size and 200 MB"),
    "large bricks of one voxel each": (lambda: filled((30, 30, 30), 27000, brick=16), r"14\.\d MB that take 55\d MB of memory"),
    # full
    **{f"full, no {name}": (lambda name=name: without(name, "full"), f"tensor '{re.escape(name)}' is missing") for name in LAYOUTS["full"].tensors},  # type: ignore[misc]
    "masks beside full bricks": (lambda: added("brick.mask", of="full"), r"unknown tensor 'brick\.mask'"),
    "bricks of other voxels": (lambda: meta_with("full", brick=3), r"'brick\.density' has shape"),
    "bricks of another degree": (lambda: meta_with("full", sh_degree=2), r"'brick\.sh' has shape"),
    "bricks without cells": (lambda: with_tensor("coarse.occupancy", np.zeros(1, "<u1"), "full"), "0 occupied cells but 2 bricks"),
    "a brick of negative density": (lambda: with_tensor("brick.density", negative("brick.density", "full"), "full"), "densities must be finite"),
    "a brick's harmonic that is no number": (lambda: with_tensor("brick.sh", nan("brick.sh", "full"), "full"), "harmonics finite"),
}


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
