"""What holds for all tests: one thread, in this process and in those that tests start; and their folders in memory.

The kernels give the same bytes on any number of threads; bundles as small as the tests' only make threads wait for each other, many times
longer than the work takes where the machine is busy. Set before anything is imported: numba and torch read it when they are.

Artifacts are flushed to the disk step by step. On a disk, a flush waits for all that other workers write; in a file system in memory it waits for nothing.
"""

import gc
import importlib.util
import os
import shutil
import signal
import threading
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any

import pytest

for variable in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ[variable] = "1"

os.environ["ENERF_PRECOMPILE"] = "off"  # a test compiles what it uses, and no more
os.environ["ENERF_FEATURE_CACHE_MIB"] = "0"  # a test detects features itself

IN_MEMORY, ROOM = Path("/dev/shm"), 4 << 30
if "PYTEST_DEBUG_TEMPROOT" not in os.environ and os.access(IN_MEMORY, os.W_OK) and shutil.disk_usage(IN_MEMORY).free >= ROOM:
    os.environ["PYTEST_DEBUG_TEMPROOT"] = str(IN_MEMORY)

# A test run that was started in the background inherits an ignored SIGINT, and would hand it on to the programs that the tests interrupt.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN and threading.current_thread() is threading.main_thread():
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="module", autouse=True)
def _old_objects_are_left_alone() -> None:
    """What earlier modules left is not looked at again when a stage collects garbage before it begins: with all kernels loaded that takes a second."""
    gc.freeze()


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    """One browser for all tests of a module."""
    from tests.stages.viewer import browser  # after the threads above

    with browser.chromium() as found:
        yield found


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tests that may take long begin first, so that no worker is left alone with one at the end; before them those that compile what others load."""
    items.sort(key=lambda item: (item.get_closest_marker("first") is None, -max((mark.args[0] for mark in item.iter_markers("timeout")), default=0)))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Where pycolmap is not installed (Linux on arm64 has no wheel), what ends with our refusal is skipped: most tests need no cameras of photographs."""
    report = yield
    if report.failed and "need pycolmap" in str(report.longrepr) and importlib.util.find_spec("pycolmap") is None:
        report.outcome, report.longrepr = "skipped", (str(item.path), item.location[1] or 0, "pycolmap is not installed")
    return report
