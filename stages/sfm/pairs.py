"""Which pairs of photographs are compared.

    exhaustive  every pair
    sequential  each photograph with those that follow, and key frames with each other
    retrieval   each photograph with those that look most like it, and with its neighbours in sorted order

Likeness is that of VLAD vectors (Jegou et al. 2010, "Aggregating local descriptors into a compact image representation"; power and intra-normalised) of the
photographs' own SIFT features, over words that are found in them by k-means: nothing is read but the photographs. Words are whole numbers and sums of
whole numbers are exact, so that the pairs are the same on any machine. docs/experiments/sfm.md
"""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

Pair = tuple[int, int]  # positions in the sorted list of images, the smaller first

MAX_EXHAUSTIVE = 60  # photographs; of more, not every pair is matched: that would take longer than the rest of the stage
OF_FEW, OF_MANY = 4096, 2048  # features of a photograph, at most: OF_MANY of more than MAX_EXHAUSTIVE photographs
WIDER = 48  # photographs that are most like one, which it is compared with where it overlaps with few
BLOCK_SIZE = 8  # images along a side of a block of pairs: between two blocks lies a safe point, a second or three apart
OVERLAP = 10  # of sequential matching: images that follow each one
KEYFRAMES = 40  # images of a sequence that are all matched with each other, for loop closure
MOST_LIKE = 16  # of retrieval: images that each is matched with for its likeness; docs/experiments/sfm.md
LESS_LIKE = (20, 26, 34, 44)  # and ranks of some more, for long baselines
FOLLOWING = (1, 2, 3, 5, 8)  # and those that follow it in sorted order

VOCABULARY = 64
WORD_SAMPLES = 20_000  # descriptors that the words are found in
WORD_ROUNDS = 8
AGGREGATED = 1500  # descriptors of an image, at most
_LEVELS = 2**14  # of a component of a vector


def features_for(count: int) -> int:
    """The default limit for each of `count` photographs."""
    return OF_FEW if count <= MAX_EXHAUSTIVE else OF_MANY


def matching_for(count: int) -> str:
    """The meaning of "auto"."""
    return "exhaustive" if count <= MAX_EXHAUSTIVE else "retrieval"


def all_pairs(count: int) -> set[Pair]:
    return {(i, j) for i in range(count) for j in range(i + 1, count)}


def pairs_with(some: Iterable[int], count: int) -> set[Pair]:
    """Each of some images with all others."""
    return {ordered(i, j) for i in some for j in range(count) if i != j}


def sequential_pairs(count: int) -> set[Pair]:
    """Each image with the OVERLAP that follow and those 2, 4, 8 times as far; and up to KEYFRAMES images, evenly spaced, with each other."""
    offsets = [*range(1, OVERLAP + 1), *(OVERLAP * 2**k for k in range(1, 4))]
    wanted = {(i, i + offset) for i in range(count) for offset in offsets if i + offset < count}
    key = range(0, count, max(1, -(-count // KEYFRAMES)))
    return wanted | {(i, j) for i in key for j in key if i < j}


def retrieved_pairs(likeness: np.ndarray) -> set[Pair]:
    """Each image with the MOST_LIKE that are most like it, with those of the ranks LESS_LIKE, and with some that follow it."""
    count = len(likeness)
    ranked = ranks(likeness)
    wanted = {ordered(i, int(ranked[i, rank])) for i in range(count) for rank in (*range(MOST_LIKE), *LESS_LIKE) if rank < count - 1}
    return wanted | {(i, i + offset) for i in range(count) for offset in FOLLOWING if i + offset < count}


def wider_pairs(likeness: np.ndarray, weak: Iterable[int], neighbours: Mapping[int, set[int]]) -> set[Pair]:
    """More pairs for the images that too few others were found to overlap with: the WIDER that are most like each, and the neighbours of its neighbours.

    neighbours  images that each overlaps with
    """
    ranked, count = ranks(likeness), len(likeness)
    wanted: set[Pair] = set()
    for i in sorted(set(weak)):
        wanted |= {ordered(i, int(j)) for j in ranked[i, : min(WIDER, count - 1)]}
        wanted |= {ordered(i, k) for j in neighbours.get(i, set()) for k in neighbours.get(j, set()) if k != i}
    return wanted


def ranks(likeness: np.ndarray) -> np.ndarray:
    """(n, n - 1) the other images in order of likeness to each; of equals the first."""
    own = np.array(likeness, np.float64)
    np.fill_diagonal(own, -np.inf)
    return np.argsort(-own, axis=1, kind="stable")[:, :-1]


def ordered(i: int, j: int) -> Pair:
    return min(i, j), max(i, j)


def in_blocks(wanted: Iterable[Pair]) -> list[list[Pair]]:
    """Blocks of at most BLOCK_SIZE^2 pairs of near images: what is read of an image serves several pairs."""
    most = BLOCK_SIZE**2
    blocks: list[list[Pair]] = []
    for i, j in sorted(wanted, key=lambda pair: (pair[0] // BLOCK_SIZE, pair[1] // BLOCK_SIZE, pair)):
        fits = blocks and len(blocks[-1]) < most and blocks[-1][-1][0] // BLOCK_SIZE == i // BLOCK_SIZE
        if fits and (blocks[-1][-1][1] // BLOCK_SIZE == j // BLOCK_SIZE or len(blocks[-1]) < most // 2):
            blocks[-1].append((i, j))
        else:
            blocks.append([(i, j)])
    return blocks


def components(near: Mapping[int, set[int]]) -> list[list[int]]:
    """Images that are joined by overlaps, the largest component first."""
    left, found = set(near), []
    while left:
        part, edge = set[int](), {min(left)}
        while edge:
            part |= edge
            edge = {j for i in edge for j in near[i]} - part
        left -= part
        found.append(sorted(part))
    return sorted(found, key=lambda part: (-len(part), part))


# ------------------------------------------------------------------------------------------------------------ likeness


def likeness_of(descriptors: Sequence[np.ndarray], seed: int) -> np.ndarray:
    """(n, n) whole numbers, larger is more alike.

    descriptors  of each image, (N, 128) uint8
    """
    some = [aggregated(image) for image in descriptors]
    words = visual_words(some, seed)
    vectors = np.stack([vlad(image, words) for image in some]) if some else np.zeros((0, 0))
    return vectors @ vectors.T


def aggregated(descriptors: np.ndarray) -> np.ndarray:
    """The rows that an image's vector is made of: all, or an even choice."""
    return descriptors[:: max(1, -(-len(descriptors) // AGGREGATED))]


def visual_words(descriptors: Sequence[np.ndarray], seed: int) -> np.ndarray:
    """(K, 128) uint8, by k-means in an even sample of all images; at most VOCABULARY."""
    each = max(1, WORD_SAMPLES // max(1, len(descriptors)))
    sample = np.concatenate([image[:: max(1, -(-len(image) // each))] for image in descriptors] or [np.zeros((0, 128), np.uint8)])
    if len(sample) <= VOCABULARY:
        return sample
    words = sample[np.sort(np.random.Generator(np.random.PCG64(seed)).choice(len(sample), VOCABULARY, replace=False))]
    for _ in range(WORD_ROUNDS):
        nearest = _nearest(sample, words)
        sums, counts = _sums(sample.astype(np.int64), nearest, len(words))
        there = counts > 0
        words = words.copy()
        words[there] = (2 * sums[there] + counts[there, None]) // (2 * counts[there, None])  # rounded
    return words


def vlad(descriptors: np.ndarray, words: np.ndarray) -> np.ndarray:
    """(K 128,) float64 of whole numbers: sums of what each descriptor differs from its word by; their signed roots, each word's of length one."""
    if not len(descriptors) or not len(words):
        return np.zeros(words.size)
    nearest = _nearest(descriptors, words)
    sums, _ = _sums(descriptors.astype(np.int64) - words.astype(np.int64)[nearest], nearest, len(words))
    lengths = np.abs(sums).sum(1)  # squared, of the roots
    used = lengths > 0
    scale = np.zeros(len(words))
    scale[used] = _LEVELS / np.sqrt(lengths[used] * max(1, used.sum()))
    return np.rint(np.sign(sums) * np.sqrt(np.abs(sums)) * scale[:, None]).ravel()


def _nearest(descriptors: np.ndarray, words: np.ndarray) -> np.ndarray:
    """(N,) the nearest word of each; of equals the first. Every sum is a whole number below 2^24, exact in 32 bits in any order."""
    w = words.astype(np.float32)
    norms = (words.astype(np.int64) ** 2).sum(1).astype(np.float32)
    found = [np.argmax(2.0 * (descriptors[start : start + 4096].astype(np.float32) @ w.T) - norms, axis=1) for start in range(0, len(descriptors), 4096)]
    return np.concatenate(found)


def _sums(values: np.ndarray, groups: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """(count, ...) sums of the rows of each group, and how many there are."""
    counts = np.bincount(groups, minlength=count)
    order = np.argsort(groups, kind="stable")
    sums = np.zeros((count, values.shape[1]), np.int64)
    there = np.flatnonzero(counts)
    starts = (np.cumsum(counts) - counts)[there]
    sums[there] = np.add.reduceat(values[order], starts, axis=0)
    return sums, counts
