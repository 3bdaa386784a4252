"""Displays: what is shown of the engine's events, and how often."""

from __future__ import annotations

import io
import json
import math
from pathlib import Path

import numpy as np
import pytest

from workflows.cli import progress
from workflows.cli.progress import Bars, JsonLines, Lines, Quiet, duration, plain, sentence, size


def event(kind: str, **facts: object) -> dict[str, object]:
    return {"event": kind, "stage": "train", "time": 0.0, **facts}


@pytest.mark.parametrize(("seconds", "words"), [(0.04, "0.0 s"), (59.9, "59.9 s"), (59.96, "1 min 00 s"), (125, "2 min 05 s"), (3725, "1 h 02 min")])
def test_durations(seconds: float, words: str) -> None:
    assert duration(seconds) == words


@pytest.mark.parametrize(("count", "words"), [(0, "0 B"), (999, "999 B"), (1000, "1.0 kB"), (99_960, "100 kB"), (3_400_000, "3.4 MB"), (2e15, "2000.0 TB")])
def test_sizes(count: float, words: str) -> None:
    assert size(count) == words


def test_a_finished_stage_says_how_busy_the_cores_were() -> None:
    assert sentence(event("stage_done", seconds=143.0, cores_busy=1.7, cores=2)) == "done in 2 min 23 s, 1.7 of 2 cores busy"
    assert sentence(event("stage_done", seconds=143.0, cores_busy=0.0, cores=0)) == "done in 2 min 23 s"


def test_lines_are_throttled(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    stream = io.StringIO()
    lines = Lines(stream)
    lines(event("stage_started", reason="never run"))
    for step in range(1000):
        now[0] = 0.1 * step  # 100 s in all, a tenth every ten seconds
        lines(event("progress", done=step + 1, total=1000, text="training", loss=0.5))
    lines(event("stage_done", seconds=100.0))
    shown = stream.getvalue().splitlines()
    assert shown[0] == "train     started (never run)"
    assert shown[-1] == "train     done in 1 min 40 s"
    assert 9 <= len(shown) - 2 <= 11
    assert shown[1].split() == ["train", "10%", "training", "loss", "0.5"]


def test_bars_take_every_event(capsys: pytest.CaptureFixture[str]) -> None:
    with Bars() as bars:
        bars(event("stage_started", reason="never run"))
        bars(event("progress", done=1, total=4, text="[odd] text"))
        bars(event("progress", done=2, total=0, text="no total"))
        bars(event("warning", text="[red]careful"))
        bars(event("stage_done", seconds=1.0))
        bars(event("interrupted"))
    shown = capsys.readouterr().err
    assert "warning: [red]careful" in shown
    assert "done in 1.0 s" in shown


def test_quiet_and_json(capsys: pytest.CaptureFixture[str]) -> None:
    for each in (event("progress", done=1, total=2), event("warning", text="careful"), event("stage_failed", text="no")):
        Quiet()(each)
        JsonLines(quiet=True)(each)
    out, err = capsys.readouterr()
    assert err == "train     warning: careful\n"
    assert [json.loads(line)["event"] for line in out.splitlines()] == ["warning", "stage_failed"]


def test_a_line_says_what_time_is_left() -> None:
    stream = io.StringIO()
    lines = Lines(stream)
    lines.last_time = -1e9
    lines(event("progress", done=1, total=4, text="training", psnr=24.0, left=125.0))
    assert stream.getvalue() == "train      25%  training  psnr 24  2 min 05 s left\n"


def test_every_event_has_its_sentence() -> None:
    assert sentence(event("stage_failed", text="no")) == ""
    assert sentence(event("message", text="12 images")) == "12 images"
    assert sentence(event("stage_skipped")) == "up to date"


def test_json_holds_only_what_json_can() -> None:
    value = {"path": Path("a"), 1: (np.float64(2), np.arange(2)), "bad": [math.nan, math.inf], "none": None, "flag": True}
    assert plain(value) == {"path": "a", "1": [2.0, [0, 1]], "bad": [None, None], "none": None, "flag": True}
