"""Codes for the layout `packed`, chosen for what they cost: rate-distortion optimisation against the contexts that the file is coded with.

A voxel's code minimises bits + errors squared x worth / `rate`: most repeat the code of a neighbour, which costs less than a bit (docs/experiments/packed.md).
The worth of an error follows from the voxel's greatest weight in a photograph. Every pass is sequential and its tables come from the pass before: the
same tree gives the same codes.

N voxels, K harmonics, P entries of a palette.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from efficientnerf.asset.cascades import bricks_of, cascades_of, order_of, voxel_sides
from efficientnerf.asset.file import packed, streams
from efficientnerf.asset.palettes import MAX_HALF, PaletteHarmonics
from efficientnerf.asset.quantisation import ENTRIES, base_codes, clustered, quantised_density
from efficientnerf.asset.tree import NerfTree
from efficientnerf.backends.numba.entropy import choices, walks
from efficientnerf.backends.pieces import pieces
from efficientnerf.rendering.colour import sigmoid
from efficientnerf.rendering.harmonics import C0

PASSES = 3  # docs/experiments/packed.md
CONTRAST = 0.1  # mean squared difference of a colour from what is behind it
DEFAULT_RATE = 3e-6  # squared error of a colour, times weight, that a bit is worth
COST_PRIOR = 8.0  # symbols of all contexts together that each context is begun with


@dataclass(frozen=True, eq=False)
class _Voxels:
    """The values of a tree's voxels in the order of the file."""

    density: np.ndarray
    opacity: np.ndarray
    sh: np.ndarray
    worth: np.ndarray  # (N,) float32: what a squared error of the colour counts
    neighbours: np.ndarray  # (3 N,) int32, see `packed.neighbours_of`
    first: np.ndarray  # (S + 1,), likewise
    side: Any

    def pieces(self) -> Any:
        """Slices of the voxels of the longest slice of the file."""
        return pieces(int(np.diff(self.first).max()), first=1024)


@dataclass(frozen=True, eq=False)
class Economy:
    """A tree with the candidates for its codes at any rate: the nearest codes and the palettes that the passes begin with."""

    tree: NerfTree
    order: np.ndarray  # (N,) voxels in the order of the file
    voxels: _Voxels
    clusters: list[tuple[np.ndarray, np.ndarray]]  # (codes (N,) uint8, palette (P, 3)) of each harmonic above the base

    def at(self, rate: float) -> NerfTree:
        """The tree with codes for `packed`.

        rate  distortion that a bit has to be worth: the greater, the smaller the file
        """
        density, levels = _densities(self.voxels, rate)
        base, table = _bases(self.voxels, rate)
        codes, palette = _harmonics(self.voxels, density, len(levels), rate, self.clusters)
        back = np.argsort(self.order)
        harmonics = PaletteHarmonics(base[back], table, codes[back], palette, (1,) * len(self.clusters))
        return replace(self.tree, density_values=levels[density][back], harmonics=harmonics)


def economy_of(tree: NerfTree, weight: np.ndarray | None = None, entries: int = ENTRIES) -> Economy:
    """The candidates for the codes of a tree with voxels.

    weight   (N,) greatest weight of each voxel in a photograph, as `refinement.fit.max_weights` finds it; by default its opacity
    entries  of the palette, at most 256
    """
    order = order_of(tree)
    voxels = _voxels_of(tree, order, weight)
    found = []
    for k in range(1, tree.harmonics_count):
        palette, codes = clustered(np.ascontiguousarray(voxels.sh[:, k], np.float32), voxels.worth, entries, seed=k)
        order_of_entries = np.argsort(-np.bincount(codes, minlength=len(palette)), kind="stable")  # those that occur most first
        ranked = np.argsort(order_of_entries)[codes].astype(np.uint8)
        found.append((ranked, np.ascontiguousarray(palette[order_of_entries], np.float32)))
    return Economy(tree, order, voxels, found)


def _voxels_of(tree: NerfTree, order: np.ndarray, weight: np.ndarray | None) -> _Voxels:
    side = voxel_sides(tree)[order] if tree.outer else np.float32(tree.voxel)
    density = tree.density_values[order]
    opacity = -np.expm1(-density * side).astype(np.float32)
    worth = opacity if weight is None else np.asarray(weight, np.float32)[order]
    grids = [packed.padded(cascade.brick_index >= 0) for cascade in cascades_of(tree)]
    stored = (tree.voxel_index[bricks_of(tree)] >= 0).astype(np.uint8)
    neighbours, first = packed.neighbours_of(grids, stored, tree.brick)
    return _Voxels(density, opacity, np.clip(tree.sh[order], -MAX_HALF, MAX_HALF), worth, neighbours.reshape(-1), first, side)


def _bits(counts: np.ndarray) -> np.ndarray:
    """Bits of the symbols of each context (n, S) float32, from how often they occurred."""
    overall = counts.sum(axis=0) + 0.02
    smooth = counts + COST_PRIOR * overall / overall.sum()
    return np.ascontiguousarray(-np.log2(smooth / smooth.sum(axis=1, keepdims=True)), np.float32)


def _counted(symbols: np.ndarray, contexts: int, walk: Callable[[Any], None]) -> np.ndarray:
    """How often (n, 256) each symbol of each context occurs on a walk of so many symbols of each slice."""
    coder = streams.recorder(symbols.tolist())
    walk(coder)
    return streams.counts(coder, contexts)


def _densities(voxels: _Voxels, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Codes (N,) uint8 and their table (T,) float32."""
    table, codes = np.unique(quantised_density(voxels.density, voxels.side), return_inverse=True)
    codes = codes.reshape(-1).astype(np.uint8)
    side = float(np.max(voxels.side))
    # The light that reaches a voxel is its weight over its opacity.
    weight = (CONTRAST / rate) * voxels.worth / np.maximum(voxels.opacity, 0.05)
    shown = -np.expm1(-table * np.float32(side)).astype(np.float32)

    def walk(coder: Any) -> None:
        for piece in voxels.pieces():
            walks.walk_densities(coder, codes, voxels.neighbours, len(table), voxels.first, piece.start, piece.stop)

    for _ in range(PASSES):
        bits = _bits(_counted(np.diff(voxels.first), walks.DENSITY_CONTEXTS, walk)[:, : len(table)])
        for piece in voxels.pieces():
            choices.choose_densities(
                voxels.opacity, weight.astype(np.float32), shown, voxels.neighbours, bits, codes, voxels.first, piece.start, piece.stop
            )  # fmt: skip
    return codes, table.astype(np.float32)


def _bases(voxels: _Voxels, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Codes (N, 3) uint8 and their table (U, 3) float32."""
    values = np.ascontiguousarray(voxels.sh[:, 0], np.float32)
    nearest, table = base_codes(values)
    codes = nearest.copy()
    weight = ((C0 * _slopes(values)) ** 2 * (voxels.worth / np.float32(rate))[:, None]).astype(np.float32)

    def walk(coder: Any) -> None:
        for piece in voxels.pieces():
            walks.walk_bases(coder, codes, voxels.neighbours, len(table), voxels.first, piece.start, piece.stop)

    for _ in range(PASSES):
        bits = _bits(_counted(3 * np.diff(voxels.first), walks.BASE_CONTEXTS, walk))
        codes[:] = nearest
        for channel in (1, 0, 2):
            for piece in voxels.pieces():
                choices.choose_bases(values, weight, table, voxels.neighbours, bits, codes.reshape(-1), channel, voxels.first, piece.start, piece.stop)
    return codes, table


def _slopes(base: np.ndarray) -> np.ndarray:
    """How fast a colour changes with its coefficients; a little more than nothing where it is saturated."""
    colour = sigmoid(C0 * base)
    return np.maximum(colour * (1 - colour), 0.05)


def _harmonics(voxels: _Voxels, density: np.ndarray, levels: int, rate: float, clusters: list[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Codes (N, K - 1) uint8 and palette (P, K - 1, 3) float32, halves in value; entries lie by how often the nearest codes name them."""
    sh, count = voxels.sh, len(voxels.sh)
    slope = np.square(_slopes(sh[:, 0])).mean(axis=1)
    weight = (voxels.worth * slope / (4 * math.pi * rate)).astype(np.float32)
    out = np.zeros((count, sh.shape[1] - 1), np.uint8)
    palettes: list[np.ndarray] = []
    beside = packed.quarters_of(levels)[density]
    for k, (nearest, palette) in enumerate(clusters, 1):
        vectors = np.ascontiguousarray(sh[:, k], np.float32)
        codes, before = nearest.copy(), beside.copy()
        for _ in range(PASSES):
            repeat_bits, code_bits = _code_bits(codes, voxels, before, len(palette))
            beside = before.copy()
            for piece in voxels.pieces():
                choices.choose_codes(
                    vectors, weight, palette, voxels.neighbours, beside, repeat_bits, code_bits, code_bits.min(axis=1), codes, voxels.first, piece.start,
                    piece.stop,
                )  # fmt: skip
            palette = _centred(palette, codes, vectors, weight)
        out[:, k - 1] = codes
        palettes.append(palette)
    if not palettes:
        return out, np.zeros((0, 0, 3), np.float32)
    length = max(map(len, palettes))
    return out, np.stack([np.pad(palette, ((0, length - len(palette)), (0, 0))) for palette in palettes], axis=1)


def _code_bits(codes: np.ndarray, voxels: _Voxels, beside: np.ndarray, entries: int) -> tuple[np.ndarray, np.ndarray]:
    """Bits to repeat a neighbour or not (112, 4), and to name an entry (160, P), in the contexts of one group's codes (N,)."""
    split, situation = walks.REPEAT_CONTEXTS, beside.copy()
    counts = np.zeros((split + walks.CODE_CONTEXTS, 256), np.int64)
    for begin in range(0, len(codes), streams.PIECE):
        choices.count_codes(codes, voxels.neighbours, situation, counts, begin, min(len(codes), begin + streams.PIECE))
    return _bits(counts[:split, :4]), _bits(counts[split:, :entries])


def _centred(palette: np.ndarray, codes: np.ndarray, vectors: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Each entry at the weighted mean of its vectors, as a half."""
    total = np.bincount(codes, weight, minlength=len(palette))
    sums = [np.bincount(codes, weight * vectors[:, d], minlength=len(palette)) for d in range(vectors.shape[1])]
    moved = np.where(total[:, None] > 0, np.stack(sums, axis=1) / np.maximum(total, 1e-30)[:, None], palette)
    return np.ascontiguousarray(moved.astype(np.float16).astype(np.float32))
