"""Long work in pieces, so that Python answers to signals between kernel calls."""

import time
from collections.abc import Iterator

SECONDS = 0.15  # that a piece should take


def pieces(count: int, first: int = 256, most: int = 2**20) -> Iterator[slice]:
    """Slices that cover 0 to `count` in order: `first` items, then as many as were done in about SECONDS before, and no more than `most`.

    The time of an item depends on the file that is rendered: a ray may end at its first sample or pass a million.
    """
    begin, size = 0, first
    while begin < count:
        end = min(count, begin + size)
        clock = time.perf_counter()
        yield slice(begin, end)
        spent = time.perf_counter() - clock
        size = int(min(max(size * min(8.0, SECONDS / max(spent, 1e-9)), 1), most))
        begin = end
