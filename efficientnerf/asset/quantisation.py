"""From floats to codes: palettes for harmonics, a table for densities.

Palettes are found by k-means over a sample of the voxels, drawn in proportion to their opacity, starting from k-means++
(Arthur & Vassilvitskii 2007). Every draw is from a seeded generator and every sum has one order: the same tree gives the same codes.
Vectors few enough for an entry each keep their values, apart from the palette's rounding to halves.

N voxels, K harmonics, G groups, P entries.
"""

import math
from dataclasses import replace

import numpy as np

from efficientnerf.asset.cascades import voxel_sides
from efficientnerf.asset.palettes import MAX_HALF, PaletteHarmonics
from efficientnerf.asset.tree import NerfTree
from efficientnerf.backends.numba import kmeans
from efficientnerf.backends.pieces import pieces
from efficientnerf.rendering.colour import sigmoid
from efficientnerf.rendering.harmonics import C0

ENTRIES = 256  # of a table whose codes are bytes
SAMPLES = 2**16
ITERATIONS = 12
MIN_DEPTH = 1e-3  # optical depth of a voxel below which its density is rounded to zero
MAX_DEPTH = 50.0  # optical depth above which a voxel looks the same


def compacted(tree: NerfTree, entries: int = ENTRIES, groups: tuple[int, ...] | None = None) -> NerfTree:
    """The same tree with its harmonics as codes and at most 256 different densities: what the layout `compact` can hold.

    entries  of the palette, at most 65536
    groups   harmonics above the base that share a code, in order; one each by default
    """
    groups = (1,) * (tree.harmonics_count - 1) if groups is None else groups
    side = voxel_sides(tree) if tree.outer else tree.voxel
    opacity = -np.expm1(-tree.density_values * np.float32(side))
    density = quantised_density(tree.density_values, side)
    return replace(tree, density_values=density, harmonics=quantised_harmonics(tree.sh, opacity, entries, groups))


def quantised_density(density: np.ndarray, voxel: float | np.ndarray) -> np.ndarray:
    """Densities (N,) rounded to at most 256 values: 0, and 255 whose logarithms are evenly spaced.

    voxel  side of the voxels, or of each, (N,)

    Up to 2.2 % away from what they were at an optical depth (density times side of the voxel) from 0.001 to 50, 0 below, 50 above; with sides of several
    lengths 0.14 % more for each doubling.
    """
    known = np.unique(density)
    if len(known) <= ENTRIES:
        return density
    side = np.asarray(voxel, np.float64)
    unit, widest = float(side.min()), float(side.max())  # optical depths are of the smallest voxel
    depth = density.astype(np.float64) * unit
    most = MAX_DEPTH * (unit / side)
    low, high = MIN_DEPTH * (unit / widest), float(np.minimum(depth, most).max())
    if high <= low:
        return np.zeros_like(density)
    level = np.rint(np.log(np.maximum(np.minimum(depth, most), low) / low) / math.log(high / low) * (ENTRIES - 2)).clip(0, ENTRIES - 2)
    table = (low * (high / low) ** (np.arange(ENTRIES - 1) / (ENTRIES - 2)) / unit).astype(np.float32)
    return np.where(depth < MIN_DEPTH * (unit / side) / 2, np.float32(0), table[level.astype(np.int64)])


def quantised_harmonics(sh: np.ndarray, opacity: np.ndarray, entries: int, groups: tuple[int, ...]) -> PaletteHarmonics:
    """Coefficients (N, K, 3) as codes.

    opacity  (N,) of each voxel, >= 0: the weight of its vector
    """
    if sum(groups) != sh.shape[1] - 1:
        raise ValueError(f"groups {groups} hold {sum(groups)} harmonics; expected {sh.shape[1] - 1}")
    sh = np.clip(sh, -MAX_HALF, MAX_HALF)
    base, table = base_codes(sh[:, 0])
    palette = np.zeros((0, sh.shape[1] - 1, 3), np.float32)
    codes = np.zeros((len(sh), len(groups)), np.uint16 if entries > ENTRIES else np.uint8)
    first = 0
    for group, size in enumerate(groups):
        vectors = np.ascontiguousarray(sh[:, 1 + first : 1 + first + size].reshape(len(sh), 3 * size))
        centroids, codes[:, group] = clustered(vectors, opacity, entries, seed=group)
        if len(centroids) > len(palette):
            palette = np.concatenate([palette, np.zeros((len(centroids) - len(palette), *palette.shape[1:]), np.float32)])
        palette[: len(centroids), first : first + size] = centroids.reshape(-1, size, 3)
        first += size
    return PaletteHarmonics(base, table, codes, palette, groups)


def base_codes(base: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Codes (N, 3) uint8 and table (T, 3) float32 of the base colour's coefficients (N, 3).

    The levels are evenly spaced on a curve that is four parts the colour that a coefficient makes by itself and one part the coefficient:
    fine where colour changes, yet not flat where the other harmonics counter a saturated base.
    """
    codes, table = np.zeros(base.shape, np.uint8), np.zeros((ENTRIES, 3), np.float32)
    for channel in range(3) if len(base) else ():
        values = base[:, channel]
        known = np.unique(values)
        if len(known) <= ENTRIES:
            levels = known.astype(np.float64)
        else:
            fine = np.linspace(known[0], known[-1], 2**14)
            colour = sigmoid(C0 * fine)
            curve = 0.8 * (colour - colour[0]) / (colour[-1] - colour[0]) + 0.2 * (fine - fine[0]) / (fine[-1] - fine[0])
            levels = np.interp(np.linspace(0, 1, ENTRIES), curve, fine)
        rounded = levels.astype(np.float32)
        codes[:, channel] = np.searchsorted((rounded[1:] + rounded[:-1]) / 2, values)
        table[: len(rounded), channel] = rounded
    return codes, table[: int(codes.max(initial=0)) + 1]


def clustered(vectors: np.ndarray, weight: np.ndarray, entries: int, seed: int, samples: int = SAMPLES) -> tuple[np.ndarray, np.ndarray]:
    """Centroids (P, D) float32, halves in value, P <= entries, and the code (n,) of each vector (n, D) float32.

    samples  vectors that the centroids are found from, or 16 for each entry where those are more
    """
    rng = np.random.Generator(np.random.Philox(key=seed))
    sample = _sample(vectors, weight, max(samples, 16 * entries), rng)
    centroids = _seeded(sample, entries, rng)
    for _ in range(ITERATIONS):
        found, distance = _nearest(sample, centroids)
        total, count = np.zeros(centroids.shape), np.zeros(len(centroids), np.int64)
        kmeans.sum_clusters(sample, found, total, count)
        moved = np.where(count[:, None] > 0, total / np.maximum(count, 1)[:, None], centroids).astype(np.float32)
        idle = np.flatnonzero(count == 0)
        if len(idle):  # an empty cluster moves to the vector furthest from its centroid
            moved[idle] = sample[np.argsort(-distance, kind="stable")[: len(idle)]]
        if np.array_equal(moved, centroids):
            break
        centroids = moved
    centroids = centroids.astype(np.float16).astype(np.float32)
    return centroids, _nearest(vectors, centroids)[0]


def _sample(vectors: np.ndarray, weight: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """All vectors if they are few, else `count` of them, in proportion to their weight (plus a hundredth of its mean, so that none is left out)."""
    if len(vectors) <= count:
        return vectors
    weight = weight.astype(np.float64)
    weight += 0.01 * weight.mean() + 1e-12
    reached = np.cumsum(weight)
    return vectors[np.searchsorted(reached, (np.arange(count) + rng.random(count)) / count * reached[-1]).clip(0, len(vectors) - 1)]


def _seeded(sample: np.ndarray, entries: int, rng: np.random.Generator) -> np.ndarray:
    """k-means++: each next centroid a vector drawn in proportion to its squared distance from those before; fewer where all distances are zero."""
    if not len(sample):
        return np.zeros((0, sample.shape[1]), np.float32)
    most = max(SAMPLES // 4, 4 * entries)
    few = sample if len(sample) <= most else sample[rng.permutation(len(sample))[:most]]
    transposed = np.ascontiguousarray(few.T)
    chosen = [few[int(rng.integers(len(few)))]]
    distance = np.full(len(few), np.inf, np.float32)
    for _ in range(entries - 1):
        kmeans.lower_distances(transposed, chosen[-1], distance)
        reached = np.cumsum(distance, dtype=np.float64)
        if reached[-1] <= 0:
            break
        chosen.append(few[min(int(np.searchsorted(reached, rng.random() * reached[-1], side="right")), len(few) - 1)])
    return np.array(chosen)


def _nearest(vectors: np.ndarray, centroids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Index of the nearest centroid of each vector, and the squared distance to it."""
    found, distance = np.zeros(len(vectors), np.int32), np.zeros(len(vectors), np.float32)
    for part in pieces(len(vectors), first=4096):
        kmeans.nearest_centroids(np.ascontiguousarray(vectors[part].T), centroids, found[part], distance[part])
    return found, distance
