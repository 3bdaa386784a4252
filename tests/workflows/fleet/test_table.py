"""The live table of a fleet."""

from __future__ import annotations

import io

from rich.console import Console

from tests.workflows.fleet.fleets import mixed
from workflows.fleet.table import LiveTable, overview


def console(height: int = 12, width: int = 110) -> Console:
    return Console(file=io.StringIO(), width=width, height=height, force_terminal=True, color_system=None, legacy_windows=False)


def printed(table: LiveTable) -> str:
    out = console()
    out.print(table.table())
    return out.file.getvalue()  # type: ignore[attr-defined, no-any-return]


def test_what_runs_stands_first_and_the_rest_is_counted() -> None:
    table = LiveTable(console())
    assert "no scenes" in printed(table)
    assert overview(mixed(0)).startswith("no scenes")
    table.written(mixed(40))
    lines = printed(table).splitlines()
    assert [line.split()[1] for line in lines[1:8]] == ["running"] * 4 + ["quarantined"] * 3
    assert "33" in lines[8]
    assert all(figure in lines[-1] for figure in ("28 done", "4 running", "4 waiting", "4 quarantined", "1 min 30 s"))
    assert len(lines) <= 12
    table({"event": "progress", "scene": "scene-017", "stage": "train", "done": 30, "total": 60, "text": "training\x1b"})
    (row,) = (line for line in printed(table).splitlines() if line.startswith("scene-017"))
    assert "50% training\\x1b" in row
    table({"event": "stage_done", "scene": "scene-017", "stage": "train"})
    assert "%" not in printed(table)
    state = mixed(40, state="done")
    state.scenes = [scene for scene in state.scenes if scene.state == "done"]
    table = LiveTable(console())
    table.written(state)
    for name in ("scene-001", "scene-020"):
        table({"event": "scene_done", "scene": name})
    assert [line.split()[0] for line in printed(table).splitlines()[1:4]] == ["scene-020", "scene-001", "scene-000"], "what ended last"
