"""Refinement of a tree of codes: its tables and palettes are fitted to the images, its codes stay. The file then has the measured quality.

In each round the voxels take steps of their own from where their codes put them; an entry moves by its voxels' mean motion, weighted by the size of
their gradients, as if gradients were summed by entries (VQRF, Li et al. 2023, section 3.4). It moves as far as the error of a sample of pixels falls.

N voxels, P entries of a palette.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from efficientnerf.asset.palettes import MAX_HALF, PaletteHarmonics
from efficientnerf.asset.refinement import fit
from efficientnerf.asset.refinement.state import RefinementState, initial_state
from efficientnerf.asset.refinement.targets import Targets
from efficientnerf.asset.tree import NerfTree

ERROR_RAYS = 2**16  # pixels that a move is judged by
FACTORS = (2.0, 1.0, 0.5, 0.25)  # of the mean move, tried in this order


def refit(
    tree: NerfTree, targets: Targets, steps: int, *, rounds: int = 2, rays: int = 32768, density_lr: float = 0.1, sh_lr: float = 0.01, seed: int = 0,
    safe_point: Callable[[], None] | None = None,
) -> NerfTree:  # fmt: skip
    """A tree of codes, as `compacted` or `Economy.at` make it, with better tables; never one of a greater error over a sample of the training pixels.

    steps       in all, in so many `rounds`
    """
    if not isinstance(tree.harmonics, PaletteHarmonics):
        raise ValueError("refit of a tree without codes; quantise it first")
    count = min(ERROR_RAYS, 4 * len(targets.pixels))
    least = fit.error(tree, targets, count, seed)
    for number in range(rounds if len(tree.density_values) else 0):
        state = initial_state(tree)
        state.step = begin = number * steps // rounds
        for _ in fit.optimise(
            state, targets, until=(number + 1) * steps // rounds, rays=rays, density_lr=density_lr, sh_lr=sh_lr, fall=lambda _: 1.0, seed=seed
        ):
            if safe_point is not None:
                safe_point()
        state.to_host()
        if state.step == begin:
            continue
        moved = _moves(tree, state)
        for factor in FACTORS:
            tried = _moved(tree, *(factor * move for move in moved))
            if (error := fit.error(tried, targets, count, seed)) < least:
                tree, least = tried, error
                break
        else:
            break
    return tree


def _moves(tree: NerfTree, state: RefinementState) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """How far each density of a table moves, by its logarithm (T,), each base (U, 3), and each entry of the palette (P, K - 1, 3)."""
    harmonics = tree.harmonics
    assert isinstance(harmonics, PaletteHarmonics)
    table, codes = np.unique(tree.density_values, return_inverse=True)
    lit = (tree.density_values > 0) & (state.density > 0)
    ratio = np.log(np.where(lit, state.density, 1) / np.where(lit, tree.density_values, 1))
    density = _mean(codes.reshape(-1), ratio, np.sqrt(state.square_density), len(table))
    weight = np.sqrt(state.square_sh)
    change = state.tree.sh - harmonics.decoded()
    base = np.stack([_mean(harmonics.base[:, c], change[:, 0, c], weight, len(harmonics.base_table)) for c in range(3)], axis=1)
    palette = np.zeros_like(harmonics.palette, np.float64)
    for k, group in enumerate(harmonics.group_of):
        for c in range(3):
            palette[:, k, c] = _mean(harmonics.codes[:, group], change[:, 1 + k, c], weight, len(palette))
    return density, base, palette


def _mean(codes: np.ndarray, values: np.ndarray, weight: np.ndarray, entries: int) -> np.ndarray:
    """Weighted mean (P,) of the values of each code, 0 of a code that no voxel with a weight has."""
    total = np.bincount(codes, weight, minlength=entries)
    return np.where(total > 0, np.bincount(codes, weight * values, minlength=entries) / np.maximum(total, 1e-30), 0)


def _moved(tree: NerfTree, density: np.ndarray, base: np.ndarray, palette: np.ndarray) -> NerfTree:
    """The tree with its entries moved; those of the palette are halves, as in a file."""
    held = tree.harmonics
    assert isinstance(held, PaletteHarmonics)
    table, codes = np.unique(tree.density_values, return_inverse=True)
    entries = np.clip(held.palette + palette, -MAX_HALF, MAX_HALF).astype(np.float16).astype(np.float32)
    harmonics = replace(held, base_table=(held.base_table + base).astype(np.float32), palette=entries)
    return replace(tree, density_values=_rising((table * np.exp(density)).astype(np.float32))[codes.reshape(-1)], harmonics=harmonics)


def _rising(table: np.ndarray) -> np.ndarray:
    """The table (T,) with each entry greater than those before it: codes, which are the ranks of densities, stay what they are, and so does a file's size."""
    out = table.copy()
    for n in range(1, len(out)):
        out[n] = max(out[n], np.nextafter(out[n - 1], np.float32(np.inf)))
    return out
