"""Work in order on several threads."""

import threading
import time

import pytest

from pipeline.executors.cores import cores
from stages.cores import count_cores, in_order


@pytest.mark.parametrize(("text", "count"), [("3", 3), (" 4,2", 4), ("", None), ("0", None), ("²", None)])
def test_threads_are_those_that_openmp_is_given(text: str, count: int | None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", text)
    assert count_cores() == (count or cores())


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
