"""Chunks of rows side by side: a thread of Python for each of torch's threads, in which torch computes alone.

torch's own threads divide each product among them and wait for each other after it. For networks 64 wide a product takes about as long as the waiting
(measured: two threads 1.28 times as fast as one); whole chunks of rows, through all layers, hardly wait, and stay in a core's own cache. Chunks are of
the same rows however many threads there are, and results come in their order, so that sums over them do not depend on the number.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import TypeVar

import torch

S = TypeVar("S")
T = TypeVar("T")


@cache
def _workers(threads: int, process: int) -> ThreadPoolExecutor:
    """Threads that each compute alone. `process` is the process that they live in: a fork has none of them."""
    pool = ThreadPoolExecutor(threads, "rows", initializer=torch.set_num_threads, initargs=(1,))
    for done in [pool.submit(os.getpid) for _ in range(threads)]:
        done.result()
    torch.set_num_threads(threads)  # the number that threads not yet seen by torch begin with was changed, too
    return pool


def chunks_of(count: int, most: int) -> list[slice]:
    """An even number of chunks of about as many rows each, `most` at most: two cores then end together."""
    chunks = 2 * max(1, -(-count // (2 * most)))
    each = max(1, -(-count // chunks))
    return [slice(begin, min(count, begin + each)) for begin in range(0, count, each)]


def side_by_side(work: Callable[[S], T], parts: Sequence[S]) -> list[T]:
    """[work(part) for part in parts], on as many threads as torch may use here.

    `work` must not call kernels that are parallel themselves: numba's simplest threading layer refuses two at once.
    """
    threads = torch.get_num_threads()
    if threads < 2 or len(parts) < 2:
        return [work(part) for part in parts]
    return list(_workers(threads, os.getpid()).map(work, parts))
