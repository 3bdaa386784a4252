"""Sets of voxels on the CPU (numba): selection and dilation by weight, and weights resampled to a coarser grid.

B coarse cells with a row of brick^3 voxels each, N voxels.
"""

from __future__ import annotations

import numpy as np

from efficientnerf.backends.numba.runtime import numba


@numba.njit(cache=True, error_model="numpy")
def threshold_and_dilate(
    cells: np.ndarray, greatest: np.ndarray, threshold: float, shape: tuple[int, int, int], brick: int, grown: int, row_of: np.ndarray, into: np.ndarray
) -> None:
    """Set `into` for each voxel whose weight exceeds `threshold`, and for those up to `grown` away along each axis, inside the grid.

    cells     flat coarse cells (x slowest) of the rows of `greatest` (., brick^3)
    row_of    (cells of the grid,) int32: row of `into` (B, brick^3) bool, -1 where there is none; every cell that is reached has one
    """
    for row in range(len(cells)):
        cell = cells[row]
        a, b, c = cell // (shape[1] * shape[2]), cell // shape[2] % shape[1], cell % shape[2]
        for local in range(brick**3):
            if not greatest[row, local] > threshold:
                continue
            i, j, k = a * brick + local // (brick * brick), b * brick + local // brick % brick, c * brick + local % brick
            for x in range(max(0, i - grown), min(shape[0] * brick, i + grown + 1)):
                for y in range(max(0, j - grown), min(shape[1] * brick, j + grown + 1)):
                    for z in range(max(0, k - grown), min(shape[2] * brick, k + grown + 1)):
                        owner = row_of[(x // brick * shape[1] + y // brick) * shape[2] + z // brick]
                        into[owner, (x % brick * brick + y % brick) * brick + z % brick] = True


@numba.njit(cache=True, error_model="numpy")
def flat_indices(into: np.ndarray, cells: np.ndarray, shape: tuple[int, int, int], brick: int, flat: np.ndarray) -> None:
    """Flat numbers in the grid (x slowest) of the voxels set in `into` (B, brick^3) bool, whose rows are the flat `cells`, to `flat` (N,)."""
    n = 0
    for row in range(len(cells)):
        cell = cells[row]
        a, b, c = cell // (shape[1] * shape[2]), cell // shape[2] % shape[1], cell % shape[2]
        for local in range(brick**3):
            if into[row, local]:
                i, j, k = a * brick + local // (brick * brick), b * brick + local // brick % brick, c * brick + local % brick
                flat[n] = (i * shape[1] * brick + j) * shape[2] * brick + k
                n += 1


@numba.njit(cache=True, error_model="numpy")
def resample_weights(
    cells: np.ndarray, greatest: np.ndarray, threshold: float, shape: tuple[int, int, int], to_shape: tuple[int, int, int], ratio: float, brick: int,
    row_of: np.ndarray, into: np.ndarray, rows: int,
) -> int:  # fmt: skip
    """Raise `into` to the weights above `threshold` of the finer voxels whose centres lie in each coarser one; returns how many rows are in use.

    ratio   side of a finer voxel over that of a coarser one
    row_of  (coarse cells of the coarser grid,) int32: row of `into`, -1 where none was needed so far
    into    (., brick^3) float32, zeros; where it has no rows left only `row_of` and the count go on
    """
    for row in range(len(cells)):
        cell = cells[row]
        a, b, c = cell // (shape[1] * shape[2]), cell // shape[2] % shape[1], cell % shape[2]
        for local in range(brick**3):
            weight = greatest[row, local]
            if not weight > threshold:
                continue
            x = min(int((a * brick + local // (brick * brick) + 0.5) * ratio), to_shape[0] * brick - 1)
            y = min(int((b * brick + local // brick % brick + 0.5) * ratio), to_shape[1] * brick - 1)
            z = min(int((c * brick + local % brick + 0.5) * ratio), to_shape[2] * brick - 1)
            owner = (x // brick * to_shape[1] + y // brick) * to_shape[2] + z // brick
            if row_of[owner] < 0:
                row_of[owner] = rows
                rows += 1
            to = row_of[owner]
            if to < len(into):
                at = (x % brick * brick + y % brick) * brick + z % brick
                into[to, at] = max(into[to, at], weight)
    return rows
