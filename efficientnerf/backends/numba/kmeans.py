"""k-means on the CPU (numba, all cores): assignment, sums of clusters, and the distances of k-means++.

Each sum is taken in one order on any number of threads, without fastmath: the same vectors give the same palettes.

n vectors of D numbers, P centroids.
"""

import numpy as np

from efficientnerf.backends.numba.runtime import PRANGE, numba

LANES = 64  # vectors that are compared together
ALONE = 64 * LANES  # vectors that one thread has compared before others have begun


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def nearest_centroids(vectors_t, centroids, index, distance):
    """Index of the nearest centroid of each vector, the first of equals, and the squared distance to it.

    vectors_t  (D, n) float32, transposed: the inner loops run over vectors, and are vectorised
    centroids  (P, D) float32
    index      (n,) int32, written
    distance   (n,) float32, written
    """
    size, count = vectors_t.shape
    for block in numba.prange((count + LANES - 1) // LANES):
        squared, least, best = np.empty(LANES, np.float32), np.empty(LANES, np.float32), np.empty(LANES, np.int32)
        begin = block * LANES
        lanes = min(LANES, count - begin)
        least[:] = np.inf
        best[:] = 0
        for p in range(np.int32(centroids.shape[0])):
            squared[:] = 0
            for d in range(size):
                x = centroids[p, d]
                row = vectors_t[d, begin : begin + lanes]
                for lane in range(lanes):
                    difference = row[lane] - x
                    squared[lane] += difference * difference
            for lane in range(lanes):
                nearer = squared[lane] < least[lane]
                least[lane] = squared[lane] if nearer else least[lane]
                best[lane] = np.int32(p) if nearer else best[lane]
        for lane in range(lanes):
            index[begin + lane], distance[begin + lane] = best[lane], least[lane]


@numba.njit(cache=True, error_model="numpy")
def sum_clusters(vectors, index, total, count):
    """Add each vector to the sum of its cluster `index` (n,), in order: total (P, D) float64, count (P,) int64."""
    for n in range(vectors.shape[0]):
        count[index[n]] += 1
        for d in range(vectors.shape[1]):
            total[index[n], d] += vectors[n, d]


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def lower_distances(vectors_t, centroid, distance):
    """Lower distance (n,) to the squared distance from `centroid` (D,) to each of vectors_t (D, n) where that is less."""
    count = vectors_t.shape[1]
    if count <= ALONE:
        _lower(vectors_t, centroid, distance, 0, count)
    else:
        for block in numba.prange((count + 16 * LANES - 1) // (16 * LANES)):
            begin = block * 16 * LANES
            _lower(vectors_t, centroid, distance, begin, min(16 * LANES, count - begin))


@numba.njit(cache=True, error_model="numpy")
def _lower(vectors_t, centroid, distance, begin, lanes):
    """The same for so many vectors from `begin` on."""
    squared = np.zeros(lanes, np.float32)
    for d in range(vectors_t.shape[0]):
        x = centroid[d]
        row = vectors_t[d, begin : begin + lanes]
        for lane in range(lanes):
            difference = row[lane] - x
            squared[lane] += difference * difference
    for lane in range(lanes):
        distance[begin + lane] = min(distance[begin + lane], squared[lane])
