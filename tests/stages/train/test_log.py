"""How long training still takes, by a made clock."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from efficientnerf.training.loop import Progress
from stages.train.log import EVERY, RECENT, TrainLog


def shown(tmp_path: Path, first: int, steps: Iterator[float], goal: int) -> dict[int, dict[str, Any]]:
    """What a display shows after each step of an attempt that goes on from step `first`, whose steps take these seconds."""
    now = [100.0]
    found: dict[int, dict[str, Any]] = {}
    log = TrainLog(tmp_path / "log.jsonl", first, 60.0, lambda: 0.5, lambda: now[0])
    for step, took in enumerate(steps, first + 1):
        log.begin_step()
        now[0] += took
        done = Progress(step, 0.1, 100, 400, 30, 5, 20)
        log.end_step(done)
        found[step] = log.record(done, goal, None, last=step == goal)
    return found


def test_the_time_left_follows_the_last_steps(tmp_path: Path) -> None:
    slow, fast = [0.2] * 300, [0.05] * (RECENT * EVERY + EVERY)
    found = shown(tmp_path, 0, iter(slow + fast), 2000)
    assert found[300]["left"] == pytest.approx(0.2 * 1700, abs=0.1)
    last = len(slow) + len(fast)
    assert found[last]["left"] == pytest.approx(0.05 * (2000 - last), abs=0.1)
