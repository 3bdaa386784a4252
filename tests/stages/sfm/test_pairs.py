"""Which pairs of photographs are compared."""

import numpy as np
import pytest

from stages.sfm import pairs


def views(count: int, seen: int, step: int, rng: np.random.Generator) -> list[np.ndarray]:
    """Descriptors of images along a closed path: each shows `seen` of a ring of things, `step` on from the one before, with noise."""
    things = rng.gamma(0.6, 25.0, (count * step, 128)).clip(0, 255)
    rows = [[(i * step + k) % len(things) for k in range(seen)] for i in range(count)]
    return [(things[some] + rng.normal(0, 4.0, (seen, 128))).clip(0, 255).astype(np.uint8) for some in rows]


@pytest.mark.parametrize("share", [0.01, 1.0])
def test_blocks_hold_every_pair_once_and_stay_small(share: float) -> None:
    rng = np.random.default_rng(0)
    wanted = {pair for pair in pairs.all_pairs(60) if rng.random() < share}
    blocks = pairs.in_blocks(wanted)
    assert sorted(pair for block in blocks for pair in block) == sorted(wanted)
    assert max(map(len, blocks)) <= pairs.BLOCK_SIZE**2
    assert len(blocks) <= 2 * len(wanted) / pairs.BLOCK_SIZE**2 + 2 * 60 / pairs.BLOCK_SIZE
    assert pairs.in_blocks(sorted(wanted, reverse=True)) == blocks


def test_sequential_pairs_reach_neighbours_and_close_loops() -> None:
    found = pairs.sequential_pairs(400)
    assert all((i, i + 1) in found for i in range(399))
    assert any(i < 10 and j > 385 for i, j in found)
    assert len(found) < 400 * 20


def test_retrieval_finds_what_shows_the_same_in_any_order_of_files() -> None:
    rng = np.random.default_rng(1)
    count = 90
    ring = views(count, 120, 12, rng)  # each shares things with the nine before and after it
    order = rng.permutation(count)
    likeness = pairs.likeness_of([ring[i] for i in order], seed=0)
    found = {pairs.ordered(int(order[i]), int(order[j])) for i, j in pairs.retrieved_pairs(likeness)}
    near = {pairs.ordered(i, (i + k) % count) for i in range(count) for k in range(1, 7)}  # also from the last to the first
    assert len(near & found) > 0.98 * len(near)
    assert len(found) < 0.5 * count * (count - 1) / 2


def test_weak_images_are_compared_with_neighbours_of_neighbours() -> None:
    likeness = -np.abs(np.subtract.outer(np.arange(100.0), np.arange(100.0)))
    near = {i: {i - 1, i + 1} & set(range(100)) for i in range(100)} | {0: {30}, 30: {0, 90}}
    assert pairs.wider_pairs(likeness, [0], near) == {(0, j) for j in [*range(1, pairs.WIDER + 1), 90]}
    assert pairs.wider_pairs(likeness, [], near) == set()
