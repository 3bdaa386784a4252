"""The benchmark of scaling: Amdahl's law backwards, and which function of the project the main thread is in."""

import time

import numpy as np
import pytest

from benchmarks.scaling import Watch, predicted, serial_seconds
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
