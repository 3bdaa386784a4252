"""Harmonics of voxels as codes into palettes: about a tenth of the memory of floats, and a renderer's reads per voxel fit a few cache lines.

The base colour (degree 0) has a table of values per channel; the K - 1 harmonics above it are cut into G groups that follow one another, and
each group of a voxel is one entry of that group's palette. One group per harmonic is what the layout `compact` writes (8 bits each, product
quantisation); one group for all is `small` (a codebook as in PlenOctree, Yu et al. 2021, and VQRF, Li et al. 2023).

N voxels, K harmonics, G groups, P entries of a palette.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

BLOCK = 2**18  # voxels decoded at once
MAX_HALF = 65000.0  # fits a half


@dataclass(frozen=True, eq=False)
class PaletteHarmonics:
    """Coefficients of N voxels, which are

        coefficient[n, 0, c] = base_table[base[n, c], c]
        coefficient[n, k, c] = palette[codes[n, group_of[k - 1]], k - 1, c]     for k = 1 ... K - 1

    Every code is below T or P; readers of untrusted files check that.
    """

    base: np.ndarray  # (N, 3) uint8
    base_table: np.ndarray  # (T, 3) float32, T at most 256
    codes: np.ndarray  # (N, G) uint8, or uint16 where P exceeds 256
    palette: np.ndarray  # (P, K - 1, 3) float32; with 256 entries and nine harmonics 24 KiB, which a core's nearest cache holds
    groups: tuple[int, ...]  # harmonics in each of the G groups; their sum is K - 1

    def __len__(self) -> int:
        return len(self.base)

    @property
    def count(self) -> int:
        """K."""
        return 1 + self.palette.shape[1]

    @cached_property
    def group_of(self) -> np.ndarray:
        """(K - 1,) int64: the group of each harmonic above the base."""
        return np.repeat(np.arange(len(self.groups)), self.groups)

    def decoded(self, voxels: np.ndarray | slice = slice(None)) -> np.ndarray:
        """Coefficients (n, K, 3) float32 of the voxels chosen, of all by default."""
        base, codes = self.base[voxels], self.codes[voxels]
        out = np.empty((len(base), self.count, 3), np.float32)
        harmonic = np.arange(self.count - 1)
        for begin in range(0, len(base), BLOCK):
            block = slice(begin, begin + BLOCK)
            out[block, 0] = self.base_table[base[block], np.arange(3)]
            out[block, 1:] = self.palette[codes[block][:, self.group_of], harmonic]
        return out

    def subset(self, voxels: np.ndarray) -> PaletteHarmonics:
        """The codes of these voxels, in this order; tables are shared."""
        return PaletteHarmonics(np.ascontiguousarray(self.base[voxels]), self.base_table, np.ascontiguousarray(self.codes[voxels]), self.palette, self.groups)
