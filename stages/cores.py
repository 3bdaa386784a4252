"""How many cores a stage computes on, and how pictures are read on several."""

import os
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from pipeline.executors.cores import cores

T = TypeVar("T")
R = TypeVar("R")


def use_all_cores() -> None:
    """Let torch compute on all cores that this process may use (`OMP_NUM_THREADS`, or its affinity): results repeat with the same number alone."""
    import torch  # who counts cores alone needs none

    torch.set_num_threads(count_cores())


def count_cores() -> int:
    """`OMP_NUM_THREADS`, of a list of levels the first; where it is no number above 0, the cores of this process's affinity."""
    first = os.environ.get("OMP_NUM_THREADS", "").partition(",")[0].strip()
    return (int(first) if first.isascii() and first.isdigit() else 0) or cores()


def in_order(work: Callable[[T], R], items: Sequence[T], threads: int, safe_point: Callable[[], None]) -> Iterator[R]:
    """The work of each item, in order, on several threads: for what lets Python go on meanwhile, as decoding does. Between them safe points.

    What the work of an item raises is raised in its place; items a little beyond it may have been worked on.
    """
    if threads < 2:
        for item in items:
            safe_point()
            yield work(item)
        return
    # Pillow's readers ignore warnings, each for itself: several at once would undo that for each other.
    with warnings.catch_warnings(), ThreadPoolExecutor(threads) as pool:
        warnings.simplefilter("ignore")
        for start in range(0, len(items), 2 * threads):
            safe_point()
            yield from pool.map(work, items[start : start + 2 * threads])
