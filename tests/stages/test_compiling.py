from __future__ import annotations

from pathlib import Path
from typing import Any

from efficientnerf.backends import kernel_cache
from pipeline.stage import Job
from stages.compiling import compiling_kernels
from tests.stages.balls import job


def test_a_stage_says_that_it_compiles_kernels_when_the_first_is_and_how_long_that_took(tmp_path: Path) -> None:
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


def test_a_stage_that_finds_its_kernels_says_nothing(tmp_path: Path) -> None:
    events: list[dict[str, Any]] = []
    compiling_kernels(lambda job: None)(job(tmp_path, None, events=events))
    assert events == []
