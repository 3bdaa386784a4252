"""The layout `packed`: the tensors of `compact`, entropy-coded for sending and archiving. FORMAT.md, section 14.

`packed` makes one set of tensors of the other and `unpacked` back, without loss. Both take the walks of `efficientnerf.backends.numba.entropy.walks`, so that
the context of a symbol is stated once.

B bricks, N stored voxels, b voxels along a side of a brick, G groups of harmonics.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from efficientnerf.asset.file import streams
from efficientnerf.asset.file.checks import number
from efficientnerf.asset.file.container import FormatError
from efficientnerf.asset.file.whole_scene import bits, booleans, grids_of, occupancy_name

MINOR = 5  # the version that brought it
STREAMS = ("packed.occupancy", "packed.mask", "packed.density", "packed.base", "packed.sh")
TABLES = ("density.table", "base.table", "sh.palette")
MOST = 2**31 - 1  # bricks or voxels, which are counted in 32 bits
Tensors = dict[str, np.ndarray]
Run = Callable[[str, int, int, list[tuple[int, int]], Callable[[Any], None]], None]


def counts_of(name: str, meta: dict[str, Any]) -> tuple[int, int, int]:
    """Bricks, voxels and bytes of a code as the metadata claim them."""
    found = meta.get("packed")
    if not isinstance(found, dict):
        raise FormatError(f"{name}: metadata 'packed' is {str(found)[:60]}; expected an object")
    bricks, voxels = (int(number(name, found, key, 0, MOST, whole=True)) for key in ("bricks", "voxels"))
    return bricks, voxels, int(number(name, found, "code_bytes", 1, 2, whole=True))


def claimed(name: str, meta: dict[str, Any], groups: int) -> tuple[dict[str, tuple[int, ...]], dict[str, np.dtype[Any]]]:
    """Shapes of the tensors of `compact` that the file will be unpacked to, and their types where these may differ."""
    bricks, voxels, width = counts_of(name, meta)
    shapes: dict[str, tuple[int, ...]] = {"brick.mask": (bricks, math.ceil(int(meta["brick"]) ** 3 / 64))}
    shapes |= {"voxel.density": (voxels,), "voxel.base": (voxels, 3), "voxel.sh": (voxels, groups)}
    return shapes, {"voxel.sh": np.dtype(f"<u{width}")}


def packed(meta: dict[str, Any], tensors: Tensors) -> tuple[Tensors, dict[str, Any]]:
    """Tensors of `packed`, and the entry of the metadata, of those of `compact`, the occupancy of all cascades among them."""
    shapes = {name: values.shape for name, values in tensors.items()}
    entry = {"bricks": shapes["brick.mask"][0], "voxels": shapes["voxel.density"][0], "code_bytes": tensors["voxel.sh"].dtype.itemsize}
    out = {name: tensors[name] for name in TABLES}

    def run(stream: str, symbols: int, contexts: int, families: list[tuple[int, int]], walk: Callable[[Any], None]) -> None:
        coder = streams.recorder(symbols)
        walk(coder)
        out[stream] = streams.written(coder, families)

    cells = [booleans("tree", occupancy_name(n), tensors[occupancy_name(n)], math.prod(grid.shape), "cells") for n, grid in enumerate(grids_of(meta))]
    grids = [padded(one.reshape(grid.shape)) for one, grid in zip(cells, grids_of(meta), strict=True)]
    cube = int(meta["brick"]) ** 3
    masks = tensors["brick.mask"]
    stored = np.unpackbits(masks.view(np.uint8).reshape(len(masks), 8 * masks.shape[1]), axis=1, bitorder="little", count=cube)
    codes = {key: tensors[key].copy() for key in ("voxel.density", "voxel.base", "voxel.sh")}
    _walk_all(meta, grids, stored, codes, out, run)
    return {name: out[name] for name in (*STREAMS, *TABLES)}, {"packed": entry}


def unpacked(name: str, meta: dict[str, Any], raw: Tensors) -> Tensors:
    """The tensors of `compact`; memory for them has been checked. FormatError where a stream is none, or does not hold what the metadata claim."""
    bricks, voxels, width = counts_of(name, meta)
    groups = len(meta["sh_groups"])

    def run(stream: str, symbols: int, contexts: int, families: list[tuple[int, int]], walk: Callable[[Any], None]) -> None:
        coder = streams.reader(name, stream, raw[stream], contexts)
        walk(coder)
        streams.check(name, stream, coder, ended=True)

    if voxels and not (len(raw["density.table"]) and len(raw["base.table"])):
        raise FormatError(f"{name}: {voxels} voxels, but a table without entries")
    grids = [padded(np.zeros(grid.shape, bool)) for grid in grids_of(meta)]
    stored = np.zeros((bricks, int(meta["brick"]) ** 3), np.uint8)
    codes = {"voxel.density": np.zeros(voxels, np.uint8), "voxel.base": np.zeros((voxels, 3), np.uint8), "voxel.sh": np.zeros((voxels, groups), f"<u{width}")}
    _walk_all(meta, grids, stored, codes, raw, run, name)
    words = math.ceil(stored.shape[1] / 64)
    mask = np.zeros((bricks, words * 8), np.uint8)
    mask[:, : math.ceil(stored.shape[1] / 8)] = np.packbits(stored, axis=1, bitorder="little")
    occupancy = {occupancy_name(n): bits(cells[1:, 1:, 1:]) for n, cells in enumerate(grids)}
    tables = {key: raw[key] for key in raw if key not in STREAMS}
    return {**occupancy, "brick.mask": mask.view("<u8").reshape(bricks, words), **codes, **tables}


def padded(cells: np.ndarray) -> np.ndarray:
    """Cells (X, Y, Z) as bytes behind a plane, a row and a column of zeros."""
    out = np.zeros([n + 1 for n in cells.shape], np.uint8)
    out[1:, 1:, 1:] = cells
    return out


def _walk_all(meta: dict[str, Any], grids: list[np.ndarray], stored: np.ndarray, codes: Tensors, tables: Tensors, run: Run, name: str = "") -> None:
    """Walk all streams in their order; arrays are filled where `run` reads.

    grids   cells of each cascade, padded; stored (B, b^3) uint8; codes N of each
    tables  of densities, bases and harmonics
    """
    from efficientnerf.backends.numba.entropy import walks

    b, (bricks, _) = int(meta["brick"]), stored.shape

    def occupancy(coder: Any) -> None:
        for cells in grids:
            for piece in _pieces(cells.shape[0] - 1):
                walks.walk_cells(coder, cells, piece.start, piece.stop)

    bits_family = [(0, walks.BIT_CONTEXTS)]
    run(STREAMS[0], sum(math.prod(n - 1 for n in cells.shape) for cells in grids), walks.BIT_CONTEXTS, bits_family, occupancy)
    owned = sum(int(np.count_nonzero(cells)) for cells in grids)
    if owned != bricks:
        raise FormatError(f"{name}: {owned} occupied cells but {bricks} bricks")
    before = _bricks_before(grids, bricks)

    def masks(coder: Any) -> None:
        for piece in _pieces(bricks):
            walks.walk_masks(coder, stored, before, b, piece.start, piece.stop)

    run(STREAMS[1], stored.size, walks.BIT_CONTEXTS, bits_family, masks)
    voxels = int(np.count_nonzero(stored))
    if voxels != len(codes["voxel.density"]):
        raise FormatError(f"{name}: masks name {voxels} voxels but {len(codes['voxel.density'])} are stored")
    _walk_codes(codes, tables, neighbours_of(grids, stored, b), run)


def neighbours_of(grids: list[np.ndarray], stored: np.ndarray, b: int) -> np.ndarray:
    """(N, 3) int32: the voxels one step back along x, y and z, -1 where none is stored; numbers as in the file.

    grids  cells of each cascade, `padded`; stored (B, b^3) uint8
    """
    from efficientnerf.backends.numba.entropy import walks

    neighbours = np.full((int(np.count_nonzero(stored)), 3), -1, np.int32)
    index = np.where(stored, np.cumsum(stored, dtype=np.int32).reshape(stored.shape) - 1, -1).astype(np.int32)
    before = _bricks_before(grids, len(stored))
    for piece in _pieces(len(stored)):
        walks.find_neighbours(index, before, b, neighbours, piece.start, piece.stop)
    return neighbours


def _walk_codes(codes: Tensors, tables: Tensors, neighbours: np.ndarray, run: Run) -> None:
    """Walk the streams of densities, bases and harmonics."""
    from efficientnerf.backends.numba.entropy import walks

    density, base, sh = codes["voxel.density"], codes["voxel.base"], codes["voxel.sh"]
    voxels, groups = sh.shape
    entries = {key: len(tables[key]) for key in TABLES}

    def densities(coder: Any) -> None:
        for piece in _pieces(voxels):
            walks.walk_densities(coder, density, neighbours, entries["density.table"], piece.start, piece.stop)

    def bases(coder: Any) -> None:
        for channel in (1, 0, 2):
            for piece in _pieces(voxels):
                walks.walk_bases(coder, base, neighbours, entries["base.table"], channel, piece.start, piece.stop)

    shift = 8 if sh.dtype.itemsize == 2 else 0
    split = walks.REPEAT_CONTEXTS, walks.CODE_CONTEXTS, *([walks.LOW_CONTEXTS] if shift else [])

    def harmonics(coder: Any) -> None:
        beside = np.minimum(4 * density.astype(np.int32) // max(1, entries["density.table"]), 3).astype(np.uint8)
        for group in range(groups):
            column = np.ascontiguousarray(sh[:, group])
            for piece in _pieces(voxels):
                first = group * sum(split)
                walks.walk_codes(coder, column, neighbours, beside, shift, first, piece.start, piece.stop)
            sh[:, group] = column

    run(STREAMS[2], voxels, walks.DENSITY_CONTEXTS, [(0, walks.DENSITY_CONTEXTS)], densities)
    run(STREAMS[3], 3 * voxels, walks.BASE_CONTEXTS, [(0, 8), (8, 72), (72, 136)], bases)
    ends = np.cumsum([0, *split * groups]).tolist()
    run(STREAMS[4], groups * voxels * len(split), max(1, ends[-1]), list(itertools.pairwise(ends)) or [(0, 1)], harmonics)


def _bricks_before(grids: list[np.ndarray], bricks: int) -> np.ndarray:
    """(B, 8) int32, see `walks.walk_masks`."""
    before = np.full((bricks, 8), -1, np.int32)
    first = 0
    for cells in grids:
        owner = np.where(cells, np.cumsum(cells, dtype=np.int32).reshape(cells.shape) - 1 + first, -1).astype(np.int32)
        x, y, z = np.nonzero(cells)
        for step in range(1, 8):
            before[first : first + len(x), step] = owner[x - (step >> 2), y - (step >> 1 & 1), z - (step & 1)]
        first += len(x)
    return before


def _pieces(count: int) -> Iterator[slice]:
    from efficientnerf.backends.pieces import pieces

    return pieces(count, first=1024)
