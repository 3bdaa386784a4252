"""The benchmark of scaling: Amdahl's law backwards, and which function of the project the main thread is in."""

import time

import numpy as np
import pytest

from benchmarks.scaling import CACHED, Bytes, Watch, bandwidth, predicted, serial_seconds
from efficientnerf.backends.numba.adam import adam
from pipeline.text import printable


@pytest.mark.parametrize("serial", [0.0, 1.0, 2.5, 10.0])
def test_serial_seconds_are_what_amdahl_says(serial: float) -> None:
    one, two, sixteen = (serial + (10.0 - serial) / cores for cores in (1, 2, 16))
    assert serial_seconds(one, two) == pytest.approx(serial)
    assert predicted(one, two, 16) == pytest.approx(sixteen)
    assert predicted(one, two, 1) == pytest.approx(one)


def test_noise_gives_no_negative_parts() -> None:
    assert serial_seconds(10.0, 4.0) == 0.0
    assert serial_seconds(10.0, 11.0) == 10.0


def test_time_counts_with_the_innermost_function_of_the_project() -> None:
    with Watch() as watch:
        deadline = time.perf_counter() + 0.5
        while time.perf_counter() < deadline:
            printable("\x1b" * 20_000)  # the project's own
        deadline = time.perf_counter() + 0.5
        while time.perf_counter() < deadline:
            np.sort(np.arange(1000))  # a library's, called by no function of the project
    ours = sum(seconds for name, seconds in watch.seconds.items() if name.startswith("pipeline/text "))
    assert 0.2 < ours < 2 * watch.seconds["libraries"] + 0.5
    assert watch.seconds["libraries"] > 0.2


def test_seconds_are_no_fewer_than_bytes_take() -> None:
    # Of 10 s, 2 are serial; 80 GB take 8 s at 10 GB/s.
    assert predicted(10.0, 6.0, 4, 8e10, 4e10) == pytest.approx(4.0)  # either takes 2 s
    assert predicted(10.0, 6.0, 16, 8e10, 4e10) == pytest.approx(4.0)  # the bytes take longer
    assert predicted(10.0, 6.0, 16, 8e10, 16e10) == pytest.approx(2.5)


def test_bandwidth_grows_with_the_cores_up_to_the_machines() -> None:
    machine = {4: 3e10, 64: 1e11}
    assert [bandwidth(cores, 1e10, machine) for cores in (1, 2, 4, 64)] == [1e10, 2e10, 3e10, 1e11]
    assert bandwidth(4, 5e9, machine) == 2e10


def test_large_arrays_of_kernels_are_counted_once_a_call() -> None:
    large, small = (np.zeros(count, np.float32) for count in (CACHED // 4, 8))
    with Bytes() as counted:
        counted.add((large, (small, large), 3, (large[: CACHED // 8],)))
    assert counted.moved == CACHED
    rates = (np.float32(0.1),) * 6
    with Bytes() as counted:
        adam(*(large.copy() for _ in range(4)), *rates, False)
        adam(*(small.copy() for _ in range(4)), *rates, False)
    assert counted.moved == 4 * CACHED
    adam(*(large.copy() for _ in range(4)), *rates, False)
    assert counted.moved == 4 * CACHED
