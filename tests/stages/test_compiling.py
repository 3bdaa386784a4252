import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from efficientnerf.backends import kernel_cache
from pipeline.stage import Job
from stages import compiling
from stages.compiling import running_kernels
from tests.stages.balls import job


def test_a_stage_says_that_it_compiles_kernels(tmp_path: Path) -> None:
    events: list[dict[str, Any]] = []
    heard = []

    @running_kernels
    def run(job: Job) -> None:
        heard.append(len(events))
        for seconds in (12.0, 8.4):
            kernel_cache.note_start()
            heard.append(len(events))
            kernel_cache.note_end(seconds)

    run(job(tmp_path, None, events=events))
    assert heard == [0, 1, 1]
    assert [event["text"] for event in events] == ["compiling kernels, once", "compiling kernels, once: 20 s"]
    kernel_cache.note_start()
    assert len(events) == 2


def test_the_clock_of_a_budget_stands_still_while_kernels_are_compiled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now, heard = [100.0], []
    monkeypatch.setattr(compiling.time, "monotonic", lambda: now[0])

    @running_kernels
    def run(job: Job) -> None:
        for compiled in (12.0, 0.0, 4.0):
            now[0] += 1.0
            if compiled:
                kernel_cache.note_start()
                now[0] += compiled
                kernel_cache.note_end(compiled)
            heard.append(compiling.clock())

    began = compiling.clock()
    run(job(tmp_path, None))
    assert heard == pytest.approx([began + 1, began + 2, began + 3])
    now[0] += 3.0
    assert compiling.clock() == pytest.approx(began + 6)


DENORMAL = """
import numpy as np, torch
from types import SimpleNamespace
from efficientnerf.backends.numba.runtime import numba
from stages.compiling import running_kernels

@numba.njit(parallel=True)
def halved(values, out):
    for n in numba.prange(len(values)):
        out[n] = values[n] * np.float32(0.5)

def nonzero() -> list[int]:
    least = np.full(2**16, np.finfo(np.float32).tiny)  # half of it is denormal
    halved(least, out := np.empty_like(least))
    return [int(np.count_nonzero(each)) for each in (out, torch.from_numpy(least).mul(0.5).numpy(), least * np.float32(0.5))]

torch.set_num_threads(2)
running_kernels(lambda job: print(nonzero()))(SimpleNamespace(say=lambda text, **facts: None))
print(nonzero()[2])
"""


@pytest.mark.skipif(not torch.set_flush_denormal(False), reason="this processor cannot flush denormal numbers")
def test_denormal_numbers_are_zero_on_all_threads_while_a_stage_runs() -> None:
    """In a process of its own, whose threads start in the stage; NumPy computes in the caller's."""
    found = subprocess.run([sys.executable, "-W", "error", "-c", DENORMAL], capture_output=True, text=True, check=True)
    assert found.stdout == "[0, 0, 0]\n65536\n"
