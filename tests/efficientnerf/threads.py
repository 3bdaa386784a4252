"""Kernels on another number of threads."""

from collections.abc import Iterator
from contextlib import contextmanager

from efficientnerf.backends.numba.runtime import numba


@contextmanager
def on_threads(count: int) -> Iterator[None]:
    before = numba.get_num_threads()
    numba.set_num_threads(count)
    try:
        yield
    finally:
        numba.set_num_threads(before)
