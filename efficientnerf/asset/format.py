"""The asset file: format 1, specified in FORMAT.md beside this module.

A safetensors container (`container.py`) of a few tensors (`layouts.py`) and one metadata entry (`metadata.py`). Everything that an untrusted
file states is checked against the file's size and against the other tensors before memory for it is allocated.
"""

from __future__ import annotations

import hashlib
import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from efficientnerf.asset.file.container import DTYPES, METADATA_KEY, FormatError, Header, write_whole
from efficientnerf.asset.file.layouts import LAYOUTS
from efficientnerf.asset.file.memory import check_memory, needed
from efficientnerf.asset.file.metadata import MAJOR, STRUCTURE, check_metadata, layout_name, layout_of, lookup_of, ndc_of
from efficientnerf.asset.file.serialisation import WRITERS, written_as
from efficientnerf.asset.tree import NerfTree

__all__ = ["LAYOUTS", "WRITERS", "FormatError", "contents", "describe", "load", "save", "serialize"]

OCCUPANCY = "coarse.occupancy"


def serialize(tree: NerfTree, layout: str | None = None) -> bytes:
    """The bytes of the file; the same tree gives the same bytes.

    layout  one of WRITERS; by default `compact` where the harmonics are codes already, else `sparse`
    """
    from safetensors.numpy import save as save_tensors

    written = written_as(tree, layout)
    tensors = {OCCUPANCY: np.packbits(tree.brick_index.reshape(-1) >= 0, bitorder="little"), **written.tensors}
    name, minor = layout_name(written.layout, ndc=tree.ndc is not None, lookup=tree.lookup)
    meta = {
        **{key: value for key, value in tree.metadata.items() if key not in STRUCTURE},
        "format": "nerftree",
        "format_version": f"{MAJOR}.{minor or LAYOUTS[written.layout].minor}",
        "layout": name,
        **({} if tree.lookup == "trilinear" else {"lookup": tree.lookup}),
        **({} if tree.ndc is None else {"ndc": tree.ndc.to_json()}),
        "shape": list(tree.shape),
        "brick": tree.brick,
        "voxel": tree.voxel,
        "bounds_min": [float(x) for x in tree.bounds_min],
        "sh_degree": tree.degree,
        "sh_convention": "real-orthonormal-plenoctree",
        "colour_space": "srgb-sigmoid",
        "background": None if tree.background is None else [float(x) for x in tree.background],
        **written.metadata,
        "sha256": {name: hashlib.sha256(value.tobytes()).hexdigest() for name, value in tensors.items()},
    }
    try:
        text = json.dumps(meta, sort_keys=True, separators=(",", ":"), allow_nan=False)
    except (TypeError, ValueError) as error:
        raise FormatError(f"metadata can't be written as JSON: {error}") from error
    data: bytes = save_tensors(tensors, metadata={METADATA_KEY: text})
    shapes, types = {name: value.shape for name, value in tensors.items()}, {name: value.dtype for name, value in tensors.items()}
    check_memory("the tree can't be saved", len(data), needed(written.layout, meta, shapes, types))
    return data


def save(tree: NerfTree, path: str | Path, layout: str | None = None) -> None:
    """Write `tree` to `path`, whole or not at all; `layout` as in `serialize`."""
    write_whole(Path(path), serialize(tree, layout))


def _open(path: str | Path) -> Header:
    """The header with its metadata and the tensors' shapes checked; no tensor is read."""
    header = Header(Path(path))
    name, meta = header.name, header.meta
    check_metadata(name, meta, tuple(LAYOUTS))
    layout = LAYOUTS[layout_of(meta)]
    types = {OCCUPANCY: ("U8",), **layout.tensors}
    for tensor in header.tensors:
        if tensor not in types and not tensor.startswith("x."):
            raise FormatError(f"{name}: unknown tensor '{tensor[:60]}'; only names that begin with 'x.' may be ignored")
    for tensor, allowed in types.items():
        if tensor not in header.tensors:
            raise FormatError(f"{name}: tensor '{tensor}' is missing")
        if header.tensors[tensor][0] not in allowed:
            raise FormatError(f"{name}: tensor '{tensor}' is {header.tensors[tensor][0][:20]}; expected {' or '.join(allowed)}")
    shapes = {tensor: header.tensors[tensor][1] for tensor in types}
    expected = {OCCUPANCY: (math.ceil(math.prod(meta["shape"]) / 8),), **layout.expected(name, meta, shapes)}
    for tensor, want in expected.items():
        if shapes[tensor] != want:
            raise FormatError(f"{name}: tensor '{tensor}' has shape {shapes[tensor]}; expected {want}")
    check_memory(name, header.size, needed(layout_of(meta), meta, shapes, {tensor: DTYPES[header.tensors[tensor][0]] for tensor in types}))
    return header


def load(path: str | Path) -> NerfTree:
    """Read and verify an asset.

    Raises FormatError, naming the file, what was found and what was expected.
    """
    header = _open(path)
    name, meta = header.name, header.meta
    layout = LAYOUTS[layout_of(meta)]
    raw = {tensor: header.read_verified(tensor) for tensor in (OCCUPANCY, *layout.tensors)}
    shape = tuple(int(n) for n in meta["shape"])
    cells = math.prod(shape)
    if np.unpackbits(raw[OCCUPANCY][cells // 8 :], bitorder="little")[cells % 8 :].any():
        raise FormatError(f"{name}: '{OCCUPANCY}' has bits set beyond its {cells} cells")
    occupied = np.flatnonzero(np.unpackbits(raw[OCCUPANCY], count=cells, bitorder="little"))
    bricks = next(len(raw[tensor]) for tensor in layout.tensors if tensor.startswith("brick."))
    if len(occupied) != bricks:
        raise FormatError(f"{name}: {len(occupied)} occupied cells but {bricks} brick{' masks' if 'brick.mask' in raw else 's'}")
    bits = layout.stored(name, meta, raw)
    count = int(np.count_nonzero(bits))
    density, harmonics = layout.values(name, meta, raw, count)
    del raw
    brick_index = np.full(cells, -1, np.int32)
    brick_index[occupied] = np.arange(len(occupied), dtype=np.int32)
    voxel_index = np.full(bits.shape, -1, np.int32)
    voxel_index[bits] = np.arange(count, dtype=np.int32)
    background = meta["background"]
    return NerfTree(
        shape=shape,  # type: ignore[arg-type]
        brick=int(meta["brick"]),
        voxel=float(meta["voxel"]),
        bounds_min=np.asarray(meta["bounds_min"], np.float64),
        brick_index=brick_index.reshape(shape),
        voxel_index=voxel_index,
        density_values=density,
        harmonics=harmonics,
        background=None if background is None else tuple(float(x) for x in background),  # type: ignore[arg-type]
        metadata={key: value for key, value in meta.items() if key not in STRUCTURE},
        ndc=ndc_of(name, meta),
        lookup=lookup_of(name, meta),
    )


def contents(path: str | Path) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
    """Metadata but for the digests, and type, shape and digest of each tensor of the layout; from the header alone, so that they are what it claims."""
    header = _open(path)
    digests = header.meta.get("sha256")
    digests = digests if isinstance(digests, dict) else {}
    names = (OCCUPANCY, *LAYOUTS[layout_of(header.meta)].tensors)
    tensors = {name: {"dtype": header.tensors[name][0], "shape": list(header.tensors[name][1]), "sha256": digests.get(name)} for name in names}
    return {key: value for key, value in header.meta.items() if key != "sha256"}, tensors


def describe(path: str | Path) -> dict[str, Any]:
    """The metadata of an asset file, from its header alone."""
    header = _open(path)
    meta, shapes = header.meta, {name: entry[1] for name, entry in header.tensors.items()}
    shape, brick, voxel = [int(n) for n in meta["shape"]], int(meta["brick"]), float(meta["voxel"])
    resolution = [n * brick for n in shape]
    low = [float(x) for x in meta["bounds_min"]]
    full = layout_of(meta) == "full"
    voxels = math.prod(shapes["brick.density"]) if full else shapes["voxel.density"][0]
    sizes = {name: end - begin for name, (_, _, begin, end) in sorted(header.tensors.items())}
    per_voxel = sum(size for name, size in sizes.items() if name.startswith("brick." if full else "voxel."))
    facts = {
        "format": "nerftree",
        "format_version": meta["format_version"],
        "layout": meta["layout"],
        "bytes": header.size,
        "bytes_per_part": {"header": header.start, **sizes},
        "bytes_per_voxel": per_voxel // voxels if voxels else 0,
        "coarse_cells": shape,
        "brick": brick,
        "resolution": resolution,
        "bricks": shapes["brick.density" if full else "brick.mask"][0],
        "voxels": voxels,
        "voxel_side": voxel,
        "sh_degree": meta["sh_degree"],
        **({"values": header.tensors["brick.sh"][0]} if full else {}),
        **({"sh_groups": meta["sh_groups"], "palette": shapes["sh.palette"][0]} if layout_of(meta) == "compact" else {}),
        "bounds": {"min": low, "max": [a + n * voxel for a, n in zip(low, resolution, strict=True)]},
        "background": meta["background"],
        "lookup": lookup_of(header.name, meta),
        **({} if ndc_of(header.name, meta) is None else {"ndc": meta["ndc"]}),
    }
    return facts | {key: meta[key] for key in sorted(meta) if key not in STRUCTURE and key not in facts}
