"""The live table of a fleet."""

from __future__ import annotations

import io

from rich.console import Console

from tests.workflows.fleet.fleets import NASTY, mixed
from workflows.fleet.table import LiveTable, overview


def console(height: int = 12, width: int = 110) -> Console:
    return Console(file=io.StringIO(), width=width, height=height, force_terminal=True, color_system=None, legacy_windows=False)


def printed(table: LiveTable) -> str:
    out = console()
    out.print(table.table())
    return out.file.getvalue()  # type: ignore[attr-defined, no-any-return]


def test_what_runs_stands_first_and_the_rest_is_counted() -> None:
    table = LiveTable(console())
    table.written(mixed(40))
    lines = printed(table).splitlines()
    assert [line.split()[1] for line in lines[1:8]] == ["running"] * 4 + ["quarantined"] * 3
    assert "and 33 more" in lines[8]
    assert lines[-1].strip() == "28 done, 4 running, 4 waiting, 4 quarantined, 28 with a poor result; about 1 min 30 s to go"
    assert len(lines) <= 12


def test_progress_is_in_the_row_of_its_scene_until_its_stage_ends() -> None:
    table = LiveTable(console())
    table.written(mixed(40))
    table({"event": "progress", "scene": "scene-017", "stage": "train", "done": 30, "total": 60, "text": "training\x1b"})
    (row,) = (line for line in printed(table).splitlines() if line.startswith("scene-017"))
    assert "━━━━━╌╌╌╌╌  50% training\\x1b" in row
    table({"event": "stage_done", "scene": "scene-017", "stage": "train"})
    assert "%" not in printed(table)


def test_what_ended_last_is_shown_of_what_ended() -> None:
    table = LiveTable(console())
    state = mixed(40, state="done")
    state.scenes = [scene for scene in state.scenes if scene.state == "done"]
    table.written(state)
    for name in ("scene-001", "scene-020"):
        table({"event": "scene_done", "scene": name})
    assert [line.split()[0] for line in printed(table).splitlines()[1:4]] == ["scene-020", "scene-001", "scene-000"]


def test_names_and_messages_do_nothing_to_the_terminal() -> None:
    out = console()
    with LiveTable(out) as table:
        table.written(mixed(10))
        table.say(NASTY)
    text = out.file.getvalue()  # type: ignore[attr-defined]
    assert "\\x1b[2J" in text
    assert "\x1b[2J" not in text
    assert "\x1b[2J" not in printed(table)


def test_a_fleet_of_nothing() -> None:
    assert "no scenes" in printed(LiveTable(console()))
    assert overview(mixed(0)).startswith("no scenes")
