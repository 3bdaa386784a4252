"""Displays: what is shown of the engine's events, and how often."""

import io
import json
import math
from pathlib import Path

import numpy as np
import pytest

from pipeline.errors import BadInput
from workflows.cli import progress
from workflows.cli.failures import report_failure
from workflows.cli.output import closing, listing, plain
from workflows.cli.progress import Bars, Lines, duration, json_line, size, warnings_only


def event(kind: str, **facts: object) -> dict[str, object]:
    return {"event": kind, "stage": "train", "time": 0.0, **facts}


def test_durations_and_sizes() -> None:
    times = {0.04: "0.0 s", 59.9: "59.9 s", 59.96: "1 min 00 s", 125: "2 min 05 s", 3725: "1 h 02 min", math.inf: "?", math.nan: "?", -1: "?"}
    assert [duration(seconds) for seconds in times] == [*times.values()]
    sizes = {0: "0 B", 999: "999 B", 1000: "1.0 kB", 99_960: "100 kB", 3_400_000: "3.4 MB", 2e15: "2000.0 TB", 10**400: "?", -1: "?"}
    assert [size(count) for count in sizes] == [*sizes.values()]


def test_lines_are_throttled(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    stream = io.StringIO()
    lines = Lines(stream)
    lines(event("stage_started", reason="never run"))
    for step in range(1000):
        now[0] = 0.1 * step  # 100 s in all
        lines(event("progress", done=step + 1, total=1000, text="training", loss=0.5, left=125.0))
    lines(event("stage_done", seconds=100.0, cores_busy=1.7, cores=2))
    shown = stream.getvalue().splitlines()
    assert 9 <= len(shown) - 2 <= 11
    for line, figures in ((0, ["never run"]), (1, ["10%", "0.5", "2 min 05 s"]), (-1, ["1 min 40 s", "1.7 of 2"])):
        assert shown[line].startswith("train ")
        assert all(figure in shown[line] for figure in figures)


def test_every_display_takes_every_event(capsys: pytest.CaptureFixture[str]) -> None:
    events = [event("stage_started", reason="never run"), event("progress", done=1, total=4, text="[odd] text"), event("progress", done=2, total=0),
              event("warning", text="[red]careful"), event("message", text="12 images"), event("stage_failed", text="no"), event("stage_skipped"),
              event("stage_done", seconds=1.0), event("interrupted")]  # fmt: skip
    with Bars() as bars:
        for each in events:
            bars(each)
            Lines()(each)
    shown = capsys.readouterr().err
    assert shown.count("[red]careful") == 2
    assert shown.count("12 images") == 2
    for each in events:
        warnings_only(each)
        json_line(each, quiet=True)
    out, err = capsys.readouterr()
    assert "[red]careful" in err
    assert len(err.splitlines()) == 1
    assert "progress" not in {json.loads(line)["event"] for line in out.splitlines()} >= {"warning", "stage_failed"}


def test_json_holds_only_what_json_and_its_readers_can() -> None:
    value = {"path": Path("a"), 1: (np.float64(2), np.arange(2)), "bad": [math.nan, math.inf], "none": None, "flag": True}
    assert plain(value) == {"path": "a", "1": [2.0, [0, 1]], "bad": [None, None], "none": None, "flag": True}
    assert plain([2**63, 2**64, 10**5000, -(10**400)]) == [2**63, hex(2**64), hex(10**5000), hex(-(10**400))]
    deep: list[object] = []
    for _ in range(5000):
        deep = [deep]
    json.dumps(plain(deep))


HOSTILE = "a\x1b]0;title\x07\n\u202eb\udcff\x9b"
ESCAPED = "a\\x1b]0;title\\x07\\n\\u202eb\\udcff\\x9b"


def test_each_of_several_stages_has_a_bar_and_lines_of_its_own() -> None:
    stream = io.StringIO()
    lines = Lines(stream)
    with Bars() as bars:
        for stage in ("mesh", "splats"):
            for each in (event("stage_started", stage=stage), event("progress", stage=stage, done=1, total=4, text=stage)):
                bars(each)
                lines(each)
        assert {task.fields["stage"]: task.completed for task in bars.progress.tasks} == {"mesh": 1, "splats": 1}
        bars(event("progress", stage="mesh", done=3, total=4))
        bars(event("stage_done", stage="splats"))
        assert {task.fields["stage"]: task.completed for task in bars.progress.tasks} == {"mesh": 3}
        lines.last["mesh"] = lines.last["splats"] = -1e9
        for share in (2, 3):
            for stage in ("mesh", "splats"):
                lines(event("progress", stage=stage, done=share, total=4))
    assert [line.split()[:2] for line in stream.getvalue().splitlines()] == [
        ["mesh", "started"], ["splats", "started"], ["mesh", "50%"], ["splats", "50%"],
    ]  # fmt: skip


def test_hostile_text_reaches_no_display_raw(capsys: pytest.CaptureFixture[str]) -> None:
    told = [event("warning", text=HOSTILE), event("stage_started", reason=HOSTILE), event("progress", done=1, total=2, text=HOSTILE, name=HOSTILE)]
    for each in told:
        warnings_only(each)
        lines = Lines()
        lines(each)
        json_line(each)
    with Bars() as bars:
        for each in told:
            bars(each)
        assert list(bars.tasks) == ["train"]
        described = next(task.description for task in bars.progress.tasks)
    out, err = capsys.readouterr()
    assert ESCAPED in described.replace("\\[", "[")
    assert err.count(ESCAPED) >= 7
    assert [json.loads(line).get("text") for line in out.splitlines()] == [HOSTILE, None, HOSTILE]
    for character in "\x1b\x07\u202e\udcff\x9b":
        assert character not in out + err


def test_lists_and_errors_are_shown_escaped(capsys: pytest.CaptureFixture[str]) -> None:
    listing("own line", HOSTILE)
    closing(HOSTILE)
    assert report_failure(BadInput(f"{HOSTILE}: no such thing."), as_json=False, debug=False) == 2
    out, err = capsys.readouterr()
    assert out == f"own line\n{ESCAPED}\n{ESCAPED}\n"
    assert err == f"enerf: {ESCAPED}: no such thing.\n"
