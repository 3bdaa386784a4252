"""Displays: what is shown of the engine's events, and how often."""

from __future__ import annotations

import json

import pytest

from workflows.cli.progress import Bars, JsonLines, Lines, Quiet


def event(kind: str, **facts: object) -> dict[str, object]:
    return {"event": kind, "stage": "train", "time": 0.0, **facts}


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
        Quiet()(each)
        JsonLines(quiet=True)(each)
    out, err = capsys.readouterr()
    assert "[red]careful" in err
    assert len(err.splitlines()) == 1
    assert "progress" not in {json.loads(line)["event"] for line in out.splitlines()} >= {"warning", "stage_failed"}


HOSTILE = "a\x1b]0;title\x07\n\u202eb\udcff\x9b"
ESCAPED = "a\\x1b]0;title\\x07\\n\\u202eb\\udcff\\x9b"


def test_hostile_text_reaches_no_display_raw(capsys: pytest.CaptureFixture[str]) -> None:
    told = [event("warning", text=HOSTILE), event("stage_started", reason=HOSTILE), event("progress", done=1, total=2, text=HOSTILE, name=HOSTILE)]
    for each in told:
        Quiet()(each)
        lines = Lines()
        lines(each)
        JsonLines()(each)
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
