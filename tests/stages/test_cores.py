"""Work in order on several threads."""

from __future__ import annotations

import threading
import time
import warnings

import pytest

from stages.cores import in_order


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_results_are_in_order_and_safe_points_between_them(threads: int) -> None:
    seen: set[int] = set()
    points = 0

    def safe_point() -> None:
        nonlocal points
        points += 1

    def work(item: int) -> int:
        seen.add(threading.get_ident())
        time.sleep(0.001 * (7 - item))
        return item * item

    assert list(in_order(work, range(7), threads, safe_point)) == [0, 1, 4, 9, 16, 25, 36]
    assert points == (7 if threads == 1 else -(-7 // (2 * threads)))
    assert (threading.get_ident() in seen) == (threads == 1)
    assert list(in_order(work, [], threads, safe_point)) == []


@pytest.mark.parametrize("threads", [1, 3])
def test_an_error_is_raised_in_its_place(threads: int) -> None:
    def work(item: int) -> int:
        if item == 4:
            raise KeyError(item)
        return item

    done: list[int] = []
    with pytest.raises(KeyError, match="4"):
        done.extend(in_order(work, range(9), threads, lambda: None))
    assert done == [0, 1, 2, 3]


def test_filters_of_warnings_are_as_before() -> None:
    def work(item: int) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            time.sleep(0.001)
            warnings.warn("of a damaged file", stacklevel=1)

    before = list(warnings.filters)
    list(in_order(work, range(12), 4, lambda: None))
    assert list(warnings.filters) == before
