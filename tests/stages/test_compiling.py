from pathlib import Path
from typing import Any

import pytest

from efficientnerf.backends import kernel_cache
from pipeline.stage import Job
from stages import compiling
from stages.compiling import compiling_kernels
from tests.stages.balls import job


def test_a_stage_says_that_it_compiles_kernels(tmp_path: Path) -> None:
    events: list[dict[str, Any]] = []
    heard = []

    @compiling_kernels
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

    @compiling_kernels
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
