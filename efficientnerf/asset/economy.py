"""Codes for the layout `packed`, chosen for what they cost: rate-distortion optimisation against the contexts that the file is coded with.

A voxel's code minimises bits + errors squared x worth / `rate`: most repeat the code of a neighbour, which costs less than a bit (docs/experiments/packed.md).
What an error is worth follows from the voxel's greatest weight in a photograph. Every pass is sequential and its tables come from the pass before: the
same tree gives the same codes.

N voxels, K harmonics, P entries of a palette.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from efficientnerf.asset.cascades import bricks_of, cascades_of, order_of, voxel_sides
from efficientnerf.asset.file import packed, streams
from efficientnerf.asset.palettes import PaletteHarmonics
from efficientnerf.asset.quantisation import ENTRIES, LIMIT, base_codes, clustered, quantised_density
from efficientnerf.asset.tree import NerfTree
from efficientnerf.rendering.harmonics import C0

PASSES = 3  # docs/experiments/packed.md
CONTRAST = 0.1  # mean squared difference of a colour from what is behind it
DEFAULT_RATE = 3e-6  # squared error of a colour, times weight, that a bit is worth
COST_PRIOR = 8.0  # symbols of all contexts together that each context is begun with


@dataclass(frozen=True, eq=False)
class _Voxels:
    """The values of a tree's voxels in the order of the file.

    worth       (N,) float32: what a squared error of the colour counts
    neighbours  (3 N,) int32, see `packed.neighbours_of`
    """

    density: np.ndarray
    opacity: np.ndarray
    sh: np.ndarray
    worth: np.ndarray
    neighbours: np.ndarray
    side: Any


def economised(tree: NerfTree, weight: np.ndarray | None = None, rate: float = DEFAULT_RATE, entries: int = ENTRIES) -> NerfTree:
    """The tree with codes for `packed`.

    weight   (N,) greatest weight of each voxel in a photograph, as `refinement.fit.max_weights` finds it; by default its opacity
    rate     distortion that a bit has to be worth: the greater, the smaller the file
    entries  of the palette, at most 256
    """
    if not len(tree.density_values):
        from efficientnerf.asset.quantisation import compacted

        return compacted(tree, entries)
    order = order_of(tree)
    voxels = _voxels_of(tree, order, weight)
    density = _densities(voxels, rate)
    base, table = _bases(voxels, rate)
    codes, palette = _harmonics(voxels, density[0], len(density[1]), rate, entries)
    back = np.argsort(order)
    harmonics = PaletteHarmonics(base[back], table, codes[back], palette, (1,) * (tree.harmonics_count - 1))
    return replace(tree, density_values=density[1][density[0]][back], harmonics=harmonics)


def _voxels_of(tree: NerfTree, order: np.ndarray, weight: np.ndarray | None) -> _Voxels:
    side = voxel_sides(tree)[order] if tree.outer else np.float32(tree.voxel)
    density = tree.density_values[order]
    opacity = -np.expm1(-density * side).astype(np.float32)
    worth = opacity if weight is None else np.asarray(weight, np.float32)[order]
    grids = [packed.padded(cascade.brick_index >= 0) for cascade in cascades_of(tree)]
    stored = (tree.voxel_index[bricks_of(tree)] >= 0).astype(np.uint8)
    return _Voxels(density, opacity, np.clip(tree.sh[order], -LIMIT, LIMIT), worth, packed.neighbours_of(grids, stored, tree.brick).reshape(-1), side)


def _bits(counts: np.ndarray) -> np.ndarray:
    """Bits of the symbols of each context (n, S) float32, from how often they occurred."""
    overall = counts.sum(axis=0) + 0.02
    smooth = counts + COST_PRIOR * overall / overall.sum()
    return np.ascontiguousarray(-np.log2(smooth / smooth.sum(axis=1, keepdims=True)), np.float32)


def _counted(symbols: int, contexts: int, walk: Callable[[Any], None]) -> np.ndarray:
    """How often (n, 256) each symbol of each context occurs on a walk."""
    coder = streams.recorder([symbols])
    walk(coder)
    return streams.counts(coder, contexts)


def _pieces(count: int) -> Any:
    from efficientnerf.backends.pieces import pieces

    return pieces(count, first=1024)


def _densities(voxels: _Voxels, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Codes (N,) uint8 and their table (T,) float32."""
    from efficientnerf.backends.numba.entropy import choices, walks

    table, codes = np.unique(quantised_density(voxels.density, voxels.side), return_inverse=True)
    codes = codes.reshape(-1).astype(np.uint8)
    count, side = len(codes), float(np.max(voxels.side))
    whole = np.array([0, count])  # which codes are neighbours' says where slices begin
    # In front of what it hides a voxel's weight is that over its opacity.
    weight = (CONTRAST / rate) * voxels.worth / np.maximum(voxels.opacity, 0.05)
    shown = -np.expm1(-table * np.float32(side)).astype(np.float32)

    def walk(coder: Any) -> None:
        for piece in _pieces(count):
            walks.walk_densities(coder, codes, voxels.neighbours, len(table), whole, piece.start, piece.stop)

    for _ in range(PASSES):
        bits = _bits(_counted(count, walks.DENSITY_CONTEXTS, walk)[:, : len(table)])
        for piece in _pieces(count):
            choices.choose_densities(
                voxels.opacity, weight.astype(np.float32), shown, voxels.neighbours, bits, codes, piece.start, piece.stop
            )  # fmt: skip
    return codes, table.astype(np.float32)


def _bases(voxels: _Voxels, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Codes (N, 3) uint8 and their table (U, 3) float32."""
    from efficientnerf.backends.numba.entropy import choices, walks

    values = np.ascontiguousarray(voxels.sh[:, 0], np.float32)
    nearest, table = base_codes(values)
    codes, count = nearest.copy(), len(values)
    whole = np.array([0, count])
    weight = ((C0 * _slopes(values)) ** 2 * (voxels.worth / np.float32(rate))[:, None]).astype(np.float32)

    def walk(coder: Any) -> None:
        for piece in _pieces(count):
            walks.walk_bases(coder, codes, voxels.neighbours, len(table), whole, piece.start, piece.stop)

    for _ in range(PASSES):
        bits = _bits(_counted(3 * count, walks.BASE_CONTEXTS, walk))
        codes[:] = nearest
        for channel in (1, 0, 2):
            for piece in _pieces(count):
                choices.choose_bases(values, weight, table, voxels.neighbours, bits, codes.reshape(-1), channel, piece.start, piece.stop)
    return codes, table


def _slopes(base: np.ndarray) -> np.ndarray:
    """How fast a colour changes with its coefficients; a little more than nothing where it is saturated."""
    colour = 1 / (1 + np.exp(-C0 * base))
    return np.maximum(colour * (1 - colour), 0.05)


def _harmonics(voxels: _Voxels, density: np.ndarray, levels: int, rate: float, entries: int) -> tuple[np.ndarray, np.ndarray]:
    """Codes (N, K - 1) uint8 and palette (P, K - 1, 3) float32, halves in value; entries lie by how often they occur."""
    from efficientnerf.backends.numba.entropy import choices, walks

    sh, count = voxels.sh, len(voxels.sh)
    slope = np.square(_slopes(sh[:, 0])).mean(axis=1)
    weight = (voxels.worth * slope / (4 * math.pi * rate)).astype(np.float32)
    out = np.zeros((count, sh.shape[1] - 1), np.uint8)
    palettes: list[np.ndarray] = []
    beside = packed.quarters_of(levels)[density]
    split = walks.REPEAT_CONTEXTS
    for k in range(1, sh.shape[1]):
        vectors = np.ascontiguousarray(sh[:, k], np.float32)
        palette, codes = clustered(vectors, voxels.worth, entries, seed=k)
        codes, palette = _sorted(codes, palette)
        before = beside.copy()

        for _ in range(PASSES):
            counts, situation = np.zeros((split + walks.CODE_CONTEXTS, 256), np.int64), before.copy()
            for piece in _pieces(count):
                choices.count_codes(codes, voxels.neighbours, situation, counts, piece.start, piece.stop)
            repeat_bits, code_bits = _bits(counts[:split, :4]), _bits(counts[split:, : len(palette)])
            beside = before.copy()
            for piece in _pieces(count):
                choices.choose_codes(
                    vectors, weight, palette, voxels.neighbours, beside, repeat_bits, code_bits, code_bits.min(axis=1), codes, piece.start, piece.stop
                )  # fmt: skip
            palette = _centred(palette, codes, vectors, weight)
        out[:, k - 1] = codes
        palettes.append(palette)
    if not palettes:
        return out, np.zeros((0, 0, 3), np.float32)
    length = max(map(len, palettes))
    return out, np.stack([np.pad(palette, ((0, length - len(palette)), (0, 0))) for palette in palettes], axis=1)


def _sorted(codes: np.ndarray, palette: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Codes (N,) uint8 and palette with the entries that occur most first."""
    order = np.argsort(-np.bincount(codes, minlength=len(palette)), kind="stable")
    return np.argsort(order)[codes].astype(np.uint8), np.ascontiguousarray(palette[order], np.float32)


def _centred(palette: np.ndarray, codes: np.ndarray, vectors: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Each entry at the weighted mean of its vectors, as a half."""
    total = np.bincount(codes, weight, minlength=len(palette))
    sums = [np.bincount(codes, weight * vectors[:, d], minlength=len(palette)) for d in range(vectors.shape[1])]
    moved = np.where(total[:, None] > 0, np.stack(sums, axis=1) / np.maximum(total, 1e-30)[:, None], palette)
    return np.ascontiguousarray(moved.astype(np.float16).astype(np.float32))
