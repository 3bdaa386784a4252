"""The asset file: format 1, specified in FORMAT.md next to this module.

A safetensors container (`container.py`) of a few tensors (`layouts.py`) and one metadata entry (`metadata.py`). Everything that an untrusted
file states is checked against the file's size and against the other tensors before memory for it is allocated.
"""

import hashlib
import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import save as save_tensors

from efficientnerf.asset.cascades import brick_ranges, bricks_of, cascades_of, check_cascades
from efficientnerf.asset.file import packed, whole_scene
from efficientnerf.asset.file.container import DTYPES, METADATA_KEY, FormatError, Header, write_whole
from efficientnerf.asset.file.layouts import LAYOUTS
from efficientnerf.asset.file.memory import check_memory, counts_of
from efficientnerf.asset.file.metadata import MAJOR, STEP_MINOR, STRUCTURE, check_metadata, layout_name, layout_of, lookup_of, ndc_of, step_size_of
from efficientnerf.asset.file.serialisation import WRITERS, written_as
from efficientnerf.asset.palettes import PaletteHarmonics
from efficientnerf.asset.tree import STEP_SIZE, Cascade, NerfTree

__all__ = ["LAYOUTS", "WRITERS", "FormatError", "contents", "describe", "load", "save", "serialize"]


def serialize(tree: NerfTree, layout: str | None = None) -> bytes:
    """The bytes of the file; the same tree gives the same bytes.

    layout  one of WRITERS; by default `compact` where the harmonics are codes already, else `sparse`
    """
    if tree.outer or tree.environment is not None:
        _check_whole(tree)
    written = written_as(tree, layout)
    tensors = {whole_scene.occupancy_name(n): whole_scene.bits(cascade.brick_index >= 0) for n, cascade in enumerate(cascades_of(tree))} | written.tensors
    whole, more = _whole_scene(tree)
    name, minor = layout_name(written.layout, ndc=tree.ndc is not None, nested="cascades" in whole, lookup=tree.lookup)
    minor = max(minor, LAYOUTS[written.layout].minor, 0 if tree.region is None else whole_scene.MINOR, 0 if tree.step_size == STEP_SIZE else STEP_MINOR)
    meta = {
        **{key: value for key, value in tree.metadata.items() if key not in STRUCTURE},
        "format": "nerftree",
        "format_version": f"{MAJOR}.{minor}",
        "layout": name,
        **({} if tree.lookup == "trilinear" else {"lookup": tree.lookup}),
        **({} if tree.step_size == STEP_SIZE else {"step_size": tree.step_size}),
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
        **whole,
    }
    shapes, types = {name: value.shape for name, value in tensors.items()}, {name: value.dtype for name, value in tensors.items()}
    if written.layout == "packed":
        tensors, entry = packed.packed(meta, tensors)
        meta |= entry
    tensors |= more
    meta["sha256"] = {name: hashlib.sha256(value.tobytes()).hexdigest() for name, value in tensors.items()}
    try:
        text = json.dumps(meta, sort_keys=True, separators=(",", ":"), allow_nan=False)
    except (TypeError, ValueError) as error:
        raise FormatError(f"metadata can't be written as JSON: {error}") from error
    if whole:
        whole_scene.check_whole_scene("the tree can't be saved", meta)
    data: bytes = save_tensors(tensors, metadata={METADATA_KEY: text})
    check_memory("the tree can't be saved", meta, len(data), shapes, types)
    return data


def _check_whole(tree: NerfTree) -> None:
    """Raises FormatError for cascades that no file holds."""
    try:
        check_cascades(tree)
        brick_ranges(tree)
    except ValueError as error:
        raise FormatError(f"the tree can't be saved: {error}") from None
    if tree.ndc is not None:
        raise FormatError("the tree can't be saved: an environment map beyond normalised device coordinates, which reach to infinity themselves")


def _whole_scene(tree: NerfTree) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Metadata and tensors of what a tree has besides one grid."""
    meta: dict[str, Any] = {}
    tensors: dict[str, np.ndarray] = {}
    if tree.outer or tree.environment is not None:
        meta["cascades"] = [{"shape": list(cascade.shape), "bounds_min": [float(x) for x in cascade.bounds_min]} for cascade in tree.outer]
        meta["environment"] = None
    if tree.environment is not None:
        tensors[whole_scene.ENVIRONMENT] = whole_scene.environment_bytes(tree.environment)
        meta["environment"] = len(tree.environment)
    region = tree.region
    if region is not None:
        meta["region"] = {
            "bounds": np.asarray(region.bounds, np.float64).tolist(),
            "corner_radius": float(region.corner_radius),
            "fade": float(region.fade),
            "bricks": region.bricks is not None,
        }
        if region.bricks is not None:
            tensors[whole_scene.REGION] = whole_scene.bits(np.asarray(region.bricks, bool)[bricks_of(tree)])
    return meta, tensors


def save(tree: NerfTree, path: str | Path, layout: str | None = None) -> None:
    """Write `tree` to `path`, whole or not at all; `layout` as in `serialize`."""
    write_whole(Path(path), serialize(tree, layout))


def _tensors_of(meta: dict[str, Any]) -> dict[str, tuple[str, ...]]:
    """Tensors that a file of these metadata, which are checked, has, and the types that each may have."""
    layout = LAYOUTS[layout_of(meta)]
    return {
        **({} if layout.unpacked else {whole_scene.occupancy_name(n): ("U8",) for n in range(len(whole_scene.grids_of(meta)))}),
        **layout.tensors,
        **({whole_scene.ENVIRONMENT: ("U8",)} if whole_scene.environment_rows(meta) else {}),
        **({whole_scene.REGION: ("U8",)} if whole_scene.names_bricks(meta) else {}),
    }


def _open(path: str | Path) -> Header:
    """The header with its metadata and the tensors' shapes checked; no tensor is read."""
    header = Header(Path(path))
    name, meta = header.name, header.meta
    check_metadata(name, meta, tuple(LAYOUTS))
    layout = LAYOUTS[layout_of(meta)]
    types = _tensors_of(meta)
    for tensor in header.tensors:
        if tensor not in types and not tensor.startswith("x."):
            raise FormatError(f"{name}: unknown tensor '{tensor[:60]}'; only names that begin with 'x.' may be ignored")
    for tensor, allowed in types.items():
        if tensor not in header.tensors:
            raise FormatError(f"{name}: tensor '{tensor}' is missing")
        if header.tensors[tensor][0] not in allowed:
            raise FormatError(f"{name}: tensor '{tensor}' is {header.tensors[tensor][0][:20]}; expected {' or '.join(allowed)}")
    shapes = {tensor: header.tensors[tensor][1] for tensor in types}
    held, kinds = _held(header)
    rows = whole_scene.environment_rows(meta)
    owners = held["brick.density" if layout_of(meta) == "full" else "brick.mask"]  # a row for each brick; not checked yet
    expected = {
        **{whole_scene.occupancy_name(n): (math.ceil(math.prod(grid.shape) / 8),) for n, grid in enumerate(whole_scene.grids_of(meta))},
        **layout.expected(name, meta, shapes),
        whole_scene.ENVIRONMENT: (rows, 2 * rows, 3),
        whole_scene.REGION: (math.ceil((owners[0] if owners else 0) / 8),),
    }
    for tensor, shape in shapes.items():
        if shape != expected[tensor]:
            raise FormatError(f"{name}: tensor '{tensor}' has shape {shape}; expected {expected[tensor]}")
    check_memory(name, meta, header.size, held, kinds)
    return header


def _held(header: Header) -> tuple[dict[str, tuple[int, ...]], dict[str, np.dtype[Any]]]:
    """Shapes and types of a file's tensors, and of those that they are unpacked to where they are entropy-coded."""
    layout = LAYOUTS[layout_of(header.meta)]
    types = _tensors_of(header.meta)
    shapes, kinds = layout.claimed(header.name, header.meta) if layout.claimed else ({}, {})
    return {**{tensor: header.tensors[tensor][1] for tensor in types}, **shapes}, {
        **{tensor: DTYPES[header.tensors[tensor][0]] for tensor in types},
        **kinds,
    }


def load(path: str | Path) -> NerfTree:
    """Read and verify an asset. Raises FormatError, naming the file, what was found and what was expected."""
    header = _open(path)
    name, meta = header.name, header.meta
    layout = LAYOUTS[layout_of(meta)]
    raw = {tensor: header.read(tensor) for tensor in _tensors_of(meta)}
    if layout.unpacked is not None:
        raw = layout.unpacked(name, meta, raw)
    cascades, bricks = _cascades(name, meta, raw), len(raw["brick.mask" if "brick.mask" in raw else "brick.density"])
    owned = sum(int(np.count_nonzero(cascade.brick_index >= 0)) for cascade in cascades)
    if owned != bricks:
        raise FormatError(f"{name}: {owned} occupied cells but {bricks} brick{' masks' if 'brick.mask' in raw else 's'}")
    stored = layout.stored(name, meta, raw)
    count = int(np.count_nonzero(stored))
    density, harmonics = layout.values(name, meta, raw, count)
    environment = whole_scene.environment_colours(raw[whole_scene.ENVIRONMENT]) if whole_scene.environment_rows(meta) else None
    region = whole_scene.region_of(
        meta, whole_scene.booleans(name, whole_scene.REGION, raw[whole_scene.REGION], bricks, "bricks") if whole_scene.names_bricks(meta) else None
    )
    del raw
    voxel_index = np.full(stored.shape, -1, np.int32)
    voxel_index[stored] = np.arange(count, dtype=np.int32)
    tree = _tree_of(name, meta, cascades, voxel_index, density, harmonics)
    return replace(tree, environment=environment, region=region)


def _tree_of(
    name: str, meta: dict[str, Any], cascades: list[Cascade], voxel_index: np.ndarray, density: np.ndarray, harmonics: np.ndarray | PaletteHarmonics
) -> NerfTree:
    """The tree of a file with these metadata, without its environment map and region."""
    background = meta["background"]
    return NerfTree(
        shape=cascades[0].shape,
        brick=int(meta["brick"]),
        voxel=float(meta["voxel"]),
        bounds_min=cascades[0].bounds_min,
        brick_index=cascades[0].brick_index,
        voxel_index=voxel_index,
        density_values=density,
        harmonics=harmonics,
        background=None if background is None else tuple(float(x) for x in background),  # type: ignore[arg-type]
        metadata={key: value for key, value in meta.items() if key not in STRUCTURE},
        ndc=ndc_of(name, meta),
        lookup=lookup_of(name, meta),
        step_size=step_size_of(name, meta),
        outer=tuple(cascades[1:]),
    )


def _cascades(name: str, meta: dict[str, Any], raw: dict[str, np.ndarray]) -> list[Cascade]:
    """The grids with their bricks, which are numbered in the order of the file."""
    cascades, first = [], 0
    for n, grid in enumerate(whole_scene.grids_of(meta)):
        cells = math.prod(grid.shape)
        occupied = np.flatnonzero(whole_scene.booleans(name, whole_scene.occupancy_name(n), raw[whole_scene.occupancy_name(n)], cells, "cells"))
        brick_index = np.full(cells, -1, np.int32)
        brick_index[occupied] = np.arange(first, first + len(occupied), dtype=np.int32)
        cascades.append(Cascade(*grid, brick_index.reshape(grid.shape)))
        first += len(occupied)
    return cascades


def contents(path: str | Path) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
    """Metadata but for the digests, and type, shape and digest of each tensor of the layout; from the header alone, not verified."""
    header = _open(path)
    digests = header.meta.get("sha256")
    digests = digests if isinstance(digests, dict) else {}
    tensors = {
        name: {"dtype": header.tensors[name][0], "shape": list(header.tensors[name][1]), "sha256": digests.get(name)} for name in _tensors_of(header.meta)
    }
    return {key: value for key, value in header.meta.items() if key != "sha256"}, tensors


def outline(path: str | Path) -> NerfTree:
    """The tree of a file with arrays that have their sizes and no values, from the header alone: to predict its memory."""
    header = _open(path)
    name, meta = header.name, header.meta
    shapes, kinds = _held(header)
    (bricks, voxels), brick = counts_of(meta, shapes), int(meta["brick"])
    harmonics: np.ndarray | PaletteHarmonics = _sized((voxels, (int(meta["sh_degree"]) + 1) ** 2, 3), "<f4")
    if "voxel.base" in shapes:
        tables = _sized(shapes["base.table"], "<f4"), _sized(shapes["voxel.sh"], kinds["voxel.sh"]), _sized(shapes["sh.palette"], "<f4")
        harmonics = PaletteHarmonics(_sized(shapes["voxel.base"], "u1"), *tables, tuple(meta["sh_groups"]))
    cascades = [Cascade(*grid, _sized(grid.shape, "<i4")) for grid in whole_scene.grids_of(meta)]
    return _tree_of(name, meta, cascades, _sized((bricks, brick**3), "<i4"), _sized((voxels,), "<f4"), harmonics)


def _sized(shape: tuple[int, ...], kind: Any) -> np.ndarray:
    """An array of this shape that takes the memory of one number."""
    return np.broadcast_to(np.zeros((), kind), shape)


def describe(path: str | Path) -> dict[str, Any]:
    """The metadata of an asset file, from its header alone."""
    header = _open(path)
    meta, shapes = header.meta, _held(header)[0]
    shape, brick, voxel = [int(n) for n in meta["shape"]], int(meta["brick"]), float(meta["voxel"])
    resolution = [n * brick for n in shape]
    low = [float(x) for x in meta["bounds_min"]]
    full = layout_of(meta) == "full"
    bricks, voxels = counts_of(meta, shapes)
    sizes = {name: end - begin for name, (_, _, begin, end) in sorted(header.tensors.items())}
    per_voxel = sum(size for name, size in sizes.items() if name.startswith("brick." if full else ("voxel.", "packed.")))
    facts = {
        "format": "nerftree",
        "format_version": meta["format_version"],
        "layout": meta["layout"],
        "bytes": header.size,
        "bytes_per_part": {"header": header.start, **sizes},
        "bytes_per_voxel": (round(per_voxel / voxels, 2) if layout_of(meta) == "packed" else per_voxel // voxels) if voxels else 0,
        "coarse_cells": shape,
        "brick": brick,
        "resolution": resolution,
        "bricks": bricks,
        "voxels": voxels,
        "voxel_side": voxel,
        "sh_degree": meta["sh_degree"],
        **({"values": header.tensors["brick.sh"][0]} if full else {}),
        **({"sh_groups": meta["sh_groups"], "palette": shapes["sh.palette"][0]} if layout_of(meta) in ("compact", "packed") else {}),
        "bounds": {"min": low, "max": [a + n * voxel for a, n in zip(low, resolution, strict=True)]},
        "background": meta["background"],
        "lookup": lookup_of(header.name, meta),
        "step_size": step_size_of(header.name, meta),
        **({} if ndc_of(header.name, meta) is None else {"ndc": meta["ndc"]}),
        **_whole_scene_facts(meta),
    }
    return facts | {key: meta[key] for key in sorted(meta) if key not in STRUCTURE and key not in facts}


def _whole_scene_facts(meta: dict[str, Any]) -> dict[str, Any]:
    """What `describe` reports besides one grid: all cascades, where there are more than one or an environment map; rows and columns of the map; the region."""
    facts: dict[str, Any] = {}
    if whole_scene.is_nested(meta):
        facts["cascades"], brick = [], int(meta["brick"])
        for grid in whole_scene.grids_of(meta):
            low, high = grid.bounds(brick).tolist()
            place = {"coarse_cells": list(grid.shape), "resolution": [n * brick for n in grid.shape], "voxel_side": grid.voxel}
            facts["cascades"].append({**place, "bounds": {"min": low, "max": high}})
        rows = whole_scene.environment_rows(meta)
        facts["environment"] = [rows, 2 * rows] if rows else None
    if whole_scene.states_region(meta):
        facts["region"] = meta["region"]
    return facts
