"""Sets of voxels on the CPU (numba): selection and dilation by weight, and weights resampled to a coarser grid.

B coarse cells with a row of brick^3 voxels each, N voxels.
"""

from __future__ import annotations

import numpy as np

from efficientnerf.backends.numba.runtime import numba


@numba.njit(cache=True, error_model="numpy")
def threshold_and_dilate(
    cells: np.ndarray, greatest: np.ndarray, threshold: float, shape: tuple[int, int, int], brick: int, dilate: int, row_of: np.ndarray, into: np.ndarray
) -> None:
    """Set `into` for each voxel whose weight exceeds `threshold`, and for those up to `dilate` voxels away along each axis, inside the grid.

    cells     flat indices (x slowest) of the coarse cells that the rows of `greatest` (., brick^3) belong to
    row_of    (coarse cells,) int32: row of `into` (B, brick^3) bool, or -1; every cell that is reached must have one
    """
    for row in range(len(cells)):
        cell = cells[row]
        a, b, c = cell // (shape[1] * shape[2]), cell // shape[2] % shape[1], cell % shape[2]
        for local in range(brick**3):
            if not greatest[row, local] > threshold:
                continue
            i, j, k = a * brick + local // (brick * brick), b * brick + local // brick % brick, c * brick + local % brick
            for x in range(max(0, i - dilate), min(shape[0] * brick, i + dilate + 1)):
                for y in range(max(0, j - dilate), min(shape[1] * brick, j + dilate + 1)):
                    for z in range(max(0, k - dilate), min(shape[2] * brick, k + dilate + 1)):
                        owner = row_of[(x // brick * shape[1] + y // brick) * shape[2] + z // brick]
                        into[owner, (x % brick * brick + y % brick) * brick + z % brick] = True


@numba.njit(cache=True, error_model="numpy")
def flat_indices(into: np.ndarray, cells: np.ndarray, shape: tuple[int, int, int], brick: int, flat: np.ndarray) -> None:
    """Flat indices in the grid (x slowest) of the voxels set in `into` (B, brick^3) bool, whose rows belong to `cells`, to `flat` (N,)."""
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
    """Raise the voxels of a coarser grid to the weights above `threshold` of the finer voxels whose centres they hold; returns the number of rows in use.

    ratio   side of a finer voxel over that of a coarser one
    row_of  (cells of the coarser grid,) int32: row of `into`, or -1; rows are assigned as needed, from `rows` on
    into    (., brick^3) float32, zeros; where it has too few rows, only `row_of` and the count are updated
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
