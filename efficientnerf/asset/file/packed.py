"""The layout `packed`: the tensors of `compact`, entropy-coded for sending and archiving. FORMAT.md, section 14.

`packed` makes one set of tensors of the other and `unpacked` back, without loss. Both take the walks of `efficientnerf.backends.numba.entropy.walks`, so that
the context of a symbol is stated once. Streams are cut into slices of bricks, which all cores decode: a slice knows no voxel of another one.

B bricks, N stored voxels, b voxels along a side of a brick, G groups of harmonics, S slices.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from efficientnerf.asset.file import streams
from efficientnerf.asset.file.checks import number
from efficientnerf.asset.file.container import FormatError
from efficientnerf.asset.file.streams import Family
from efficientnerf.asset.file.whole_scene import bits, booleans, grids_of, occupancy_name
from efficientnerf.backends.numba.entropy import walks
from efficientnerf.backends.pieces import pieces

MINOR = 5  # the version that brought it
STREAMS: tuple[str, ...] = ("packed.occupancy", "packed.mask", "packed.density", "packed.base", "packed.sh")
TABLES = ("density.table", "base.table", "sh.palette")
MAX_COUNT = 2**31 - 1  # bricks or voxels, which are counted in 32 bits
SLICE_VOXELS = 2**17  # about; docs/experiments/packed.md
Tensors = dict[str, np.ndarray]
Walk = Callable[[Any], None]
Run = Callable[[str, Sequence[int], Sequence[Family], Walk], None]  # a stream, how many symbols its slices have at most, its contexts, and what codes them


def counts_of(name: str, meta: dict[str, Any]) -> tuple[int, int, int, int]:
    """Bricks, voxels, bytes of a code and bricks of a slice as the metadata claim them."""
    found = meta.get("packed")
    if not isinstance(found, dict):
        raise FormatError(f"{name}: metadata 'packed' is {str(found)[:60]}; expected an object")
    bricks, voxels = (int(number(name, found, key, 0, MAX_COUNT, whole=True)) for key in ("bricks", "voxels"))
    width = int(number(name, found, "code_bytes", 1, 2, whole=True))
    each = int(number(name, found, "slice_bricks", max(1, math.ceil(bricks / streams.MOST_SLICES)), MAX_COUNT, whole=True))
    return bricks, voxels, width, each


def claimed(name: str, meta: dict[str, Any], groups: int) -> tuple[dict[str, tuple[int, ...]], dict[str, np.dtype[Any]]]:
    """Shapes of the tensors of `compact` that the file will be unpacked to, and their types where these may differ."""
    bricks, voxels, width, _ = counts_of(name, meta)
    shapes: dict[str, tuple[int, ...]] = {"brick.mask": (bricks, math.ceil(int(meta["brick"]) ** 3 / 64))}
    shapes |= {"voxel.density": (voxels,), "voxel.base": (voxels, 3), "voxel.sh": (voxels, groups)}
    return shapes, {"voxel.sh": np.dtype(f"<u{width}")}


def slice_bricks(bricks: int, voxels: int) -> int:
    """Bricks of each slice of a tree of so many bricks and voxels, of the last one at most."""
    return max(1, math.ceil(bricks / min(max(1, voxels // SLICE_VOXELS), streams.MOST_SLICES)))


def packed(meta: dict[str, Any], tensors: Tensors) -> tuple[Tensors, dict[str, Any]]:
    """Tensors of `packed`, and the entry of the metadata, of those of `compact`, the occupancy of all cascades among them."""
    shapes = {name: values.shape for name, values in tensors.items()}
    bricks, voxels = shapes["brick.mask"][0], shapes["voxel.density"][0]
    each = slice_bricks(bricks, voxels)
    entry = {"bricks": bricks, "voxels": voxels, "code_bytes": tensors["voxel.sh"].dtype.itemsize, "slice_bricks": each}
    out = {name: tensors[name] for name in TABLES}

    def run(stream: str, symbols: Sequence[int], families: Sequence[Family], walk: Walk) -> None:
        coder = streams.recorder(symbols)
        walk(coder)
        out[stream] = streams.written(coder, families)

    cells = [booleans("tree", occupancy_name(n), tensors[occupancy_name(n)], math.prod(grid.shape), "cells") for n, grid in enumerate(grids_of(meta))]
    grids = [padded(one.reshape(grid.shape)) for one, grid in zip(cells, grids_of(meta), strict=True)]
    cube = int(meta["brick"]) ** 3
    masks = tensors["brick.mask"]
    stored = np.unpackbits(masks.view(np.uint8).reshape(len(masks), 8 * masks.shape[1]), axis=1, bitorder="little", count=cube)
    codes = {key: np.ascontiguousarray(tensors[key]) for key in ("voxel.density", "voxel.base", "voxel.sh")}
    _walk_all(meta, grids, stored, codes, out, each, run)
    return {name: out[name] for name in (*STREAMS, *TABLES)}, {"packed": entry}


def unpacked(name: str, meta: dict[str, Any], raw: Tensors) -> Tensors:
    """The tensors of `compact`; memory for them has been checked. FormatError where a stream is none, or does not hold what the metadata claim."""
    bricks, voxels, width, each = counts_of(name, meta)
    groups = len(meta["sh_groups"])

    def run(stream: str, symbols: Sequence[int], families: Sequence[Family], walk: Walk) -> None:
        coder = streams.reader(name, stream, raw[stream], families, len(symbols))
        walk(coder)
        streams.check(name, stream, coder)

    if voxels and not (len(raw["density.table"]) and len(raw["base.table"])):
        raise FormatError(f"{name}: {voxels} voxels, but a table without entries")
    grids = [padded(np.zeros(grid.shape, bool)) for grid in grids_of(meta)]
    stored = np.zeros((bricks, int(meta["brick"]) ** 3), np.uint8)
    codes = {"voxel.density": np.zeros(voxels, np.uint8), "voxel.base": np.zeros((voxels, 3), np.uint8), "voxel.sh": np.zeros((voxels, groups), f"<u{width}")}
    _walk_all(meta, grids, stored, codes, raw, each, run, name)
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


def _walk_all(meta: dict[str, Any], grids: list[np.ndarray], stored: np.ndarray, codes: Tensors, tables: Tensors, each: int, run: Run, name: str = "") -> None:
    """Walk all streams in their order; arrays are filled where `run` reads.

    grids   cells of each cascade, padded; stored (B, b^3) uint8; codes N of each
    tables  of densities, bases and harmonics
    each    bricks of a slice
    """
    b, (bricks, cube) = int(meta["brick"]), stored.shape

    def occupancy(coder: Any) -> None:
        for cells in grids:
            for piece in pieces(cells.shape[0] - 1, first=1):
                walks.walk_cells(coder, cells, piece.start, piece.stop)

    bit_family = [Family(walks.BIT_CONTEXTS, symbols=2)]
    run(STREAMS[0], [sum(math.prod(n - 1 for n in cells.shape) for cells in grids)], bit_family, occupancy)
    owned = sum(int(np.count_nonzero(cells)) for cells in grids)
    if owned != bricks:
        raise FormatError(f"{name}: {owned} occupied cells but {bricks} bricks")
    before, first = _bricks_before(grids, bricks, each), _slices(bricks, each)
    border, inner = _borders(b)

    def masks(coder: Any) -> None:
        for piece in pieces(min(each, bricks), first=64):
            walks.walk_masks(coder, stored, before, border, inner, b, first, piece.start, piece.stop)

    run(STREAMS[1], (cube * np.diff(first)).tolist(), bit_family, masks)
    voxels = int(np.count_nonzero(stored))
    if voxels != len(codes["voxel.density"]):
        raise FormatError(f"{name}: masks name {voxels} voxels but {len(codes['voxel.density'])} are stored")
    _walk_codes(codes, tables, _neighbours(before, stored, b), _voxels_before(stored)[first], run)


def _slices(bricks: int, each: int) -> np.ndarray:
    """(S + 1,) int64: the first brick of each slice, and how many bricks there are; S is 1 at least."""
    return np.append(np.arange(0, max(1, bricks), each), bricks)


def neighbours_of(grids: list[np.ndarray], stored: np.ndarray, b: int) -> tuple[np.ndarray, np.ndarray]:
    """(N, 3) int32: the voxels one step back along x, y and z, -1 where none is stored in the same slice; numbers as in the file that is written. And
    (S + 1,) int64: the first voxel of each slice, and N.

    grids  cells of each cascade, `padded`; stored (B, b^3) uint8
    """
    each = slice_bricks(len(stored), int(np.count_nonzero(stored)))
    return _neighbours(_bricks_before(grids, len(stored), each), stored, b), _voxels_before(stored)[_slices(len(stored), each)]


def _voxels_before(stored: np.ndarray) -> np.ndarray:
    """(B + 1,) int64: how many voxels lie before each brick, and N."""
    return np.cumsum(np.append(0, np.count_nonzero(stored, axis=1)), dtype=np.int64)


def _neighbours(before: np.ndarray, stored: np.ndarray, b: int) -> np.ndarray:
    neighbours = np.full((int(np.count_nonzero(stored)), 3), -1, np.int32)
    index = np.where(stored, np.cumsum(stored, dtype=np.int32).reshape(stored.shape) - 1, -1).astype(np.int32)
    for piece in pieces(len(stored), first=1024):
        walks.find_neighbours(index, before, b, neighbours, piece.start, piece.stop)
    return neighbours


def _walk_codes(codes: Tensors, tables: Tensors, neighbours: np.ndarray, first: np.ndarray, run: Run) -> None:
    """Walk the streams of densities, bases and harmonics.

    first  (S + 1,) int64: voxels of the slices
    """
    density, base, sh = codes["voxel.density"], codes["voxel.base"], codes["voxel.sh"]
    _, groups = sh.shape
    near = neighbours.reshape(-1)
    entries = {key: len(tables[key]) for key in TABLES}
    voxels = np.diff(first)

    def parts() -> Iterator[slice]:
        return pieces(int(voxels.max()), first=1024)

    def densities(coder: Any) -> None:
        for piece in parts():
            walks.walk_densities(coder, density, near, entries["density.table"], first, piece.start, piece.stop)

    def bases(coder: Any) -> None:
        for piece in parts():
            walks.walk_bases(coder, base, near, entries["base.table"], first, piece.start, piece.stop)

    shift = 8 if sh.dtype.itemsize == 2 else 0
    quarters = quarters_of(entries["density.table"])

    def harmonics(coder: Any) -> None:
        for piece in parts() if groups else ():
            walks.walk_codes(coder, sh, near, density, quarters, shift, first, piece.start, piece.stop)

    run(STREAMS[2], voxels.tolist(), [Family(walks.DENSITY_CONTEXTS)], densities)
    run(STREAMS[3], (3 * voxels).tolist(), [Family(8, 0), Family(72, 1), Family(136, 2)], bases)
    families = code_families(groups, wide=shift > 0)
    run(STREAMS[4], (len(families) * voxels if groups else 0 * voxels).tolist(), families, harmonics)


def quarters_of(entries: int) -> np.ndarray:
    """(256,) uint8: the quarter of a table of densities that each code lies in."""
    return np.minimum(4 * np.arange(256) // max(1, entries), 3).astype(np.uint8)


def code_families(groups: int, *, wide: bool) -> list[Family]:
    """The contexts of `packed.sh`, each group's in a lane; `wide` where codes have two bytes."""
    kinds = [(walks.REPEAT_CONTEXTS, walks.NEW + 1), (walks.CODE_CONTEXTS, 256), *([(walks.LOW_CONTEXTS, 256)] if wide else [])]
    out = [Family(0)]
    for group in range(groups):
        for contexts, symbols in kinds:
            out.append(Family(out[-1].end + contexts, group, symbols))
    return out[1:] or [Family(1)]


def _bricks_before(grids: list[np.ndarray], bricks: int, each: int) -> np.ndarray:
    """(B, 8) int32, see `walks.walk_masks`, of slices of so many bricks."""
    before = np.full((bricks, 8), -1, np.int32)
    first = 0
    for cells in grids:
        owner = np.where(cells, np.cumsum(cells, dtype=np.int32).reshape(cells.shape) - 1 + first, -1).astype(np.int32)
        x, y, z = np.nonzero(cells)
        for step in range(1, 8):
            before[first : first + len(x), step] = owner[x - (step >> 2), y - (step >> 1 & 1), z - (step & 1)]
        first += len(x)
    number = np.arange(bricks)[:, None]
    before[before < number - number % each] = -1
    return before


def _borders(b: int) -> tuple[np.ndarray, np.ndarray]:
    """`border` and `inner` of `walks.walk_masks`."""
    at = np.argwhere(np.ones((b + 1,) * 3, bool))
    back = (at == 0) @ np.array([4, 2, 1])
    place, slot = at @ np.array([(b + 1) ** 2, b + 1, 1]), (at - 1) % b @ np.array([b * b, b, 1])
    beside = np.stack([place, back, slot], axis=1)[back > 0]
    return np.ascontiguousarray(beside, np.int32), np.ascontiguousarray(place[back == 0], np.int32)
