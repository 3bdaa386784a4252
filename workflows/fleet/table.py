"""The live table of a fleet on a terminal: what runs, what went wrong, what was done last, and when all will be."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from pipeline.fleet.state import FleetState, SceneState, Totals
from pipeline.text import printable
from workflows.cli.progress import duration, size
from workflows.fleet.pages.index import quality_of

BAR = 10  # characters
BAD_GRADES = ("poor", "failed")  # of a result, that a fleet points out
_ORDER = ("running", "failed", "quarantined", "done", "waiting")
_STYLES = {"running": "cyan", "failed": "red", "quarantined": "red", "done": "green", "waiting": "dim"}
_BELOW_AND_ABOVE = 5  # lines of the terminal that rows do not take


class LiveTable:
    """Takes the scheduler's events, and the state whenever it was written. While it is open, messages are printed above it."""

    def __init__(self, console: Console | None = None) -> None:
        self.console = console or Console(stderr=True, highlight=False)
        self.state = FleetState()
        self._progress: dict[str, tuple[float, float, str]] = {}  # scene -> done, total, text
        self._done: list[str] = []  # scenes in the order in which they ended
        self._live = Live(console=self.console, get_renderable=self.table, refresh_per_second=4, transient=True)

    def __enter__(self) -> LiveTable:
        self._live.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._live.stop()

    def written(self, state: FleetState) -> None:
        """The state that was written last; its scenes change while the fleet goes on."""
        self.state = state

    def __call__(self, event: dict[str, Any]) -> None:
        """An event of a scene: what is under way is shown in its row."""
        scene = str(event.get("scene", ""))
        if event["event"] == "progress":
            self._progress[scene] = float(event.get("done") or 0), float(event.get("total") or 0), printable(event.get("text") or "", 60)
            return
        self._progress.pop(scene, None)
        if event["event"] in ("scene_done", "scene_failed", "scene_quarantined"):
            self._done.append(scene)

    def say(self, line: str) -> None:
        """A line above the table."""
        self.console.print(printable(line), style="yellow", markup=False, soft_wrap=True)

    def table(self) -> Table:
        """As many rows as fit on the terminal: what runs first, then what ended last."""
        made = Table(expand=True, box=None, pad_edge=False, caption=Text(overview(self.state)), caption_justify="left")
        for title in ("scene", "state", "stage", "time", "result", "PSNR", "size"):
            made.add_column(title, justify="right" if title in ("time", "PSNR", "size") else "left", no_wrap=True, overflow="ellipsis")
        made.add_column("", ratio=1, no_wrap=True, overflow="ellipsis")
        shown = self.chosen(max(3, self.console.height - _BELOW_AND_ABOVE))
        for scene in shown:
            made.add_row(*map(Text, self.cells(scene)), style=_STYLES[scene.state])
        left = len(self.state.scenes) - len(shown)
        if left:
            made.add_row(Text(f"and {left} more"), style="dim")
        return made

    def chosen(self, count: int) -> list[SceneState]:
        """The scenes to show, at most so many."""
        ended = {name: place for place, name in enumerate(self._done)}
        places = {id(scene): place for place, scene in enumerate(self.state.scenes)}
        ordered = sorted(self.state.scenes, key=lambda scene: (_ORDER.index(scene.state), -ended.get(scene.name, -1), places[id(scene)]))
        return ordered[:count]

    def cells(self, scene: SceneState) -> tuple[str, ...]:
        """A row's texts."""
        psnr = quality_of(scene)["psnr"]
        done, total, text = self._progress.get(scene.name, (0.0, 0.0, ""))
        note = (scene.reason or "") if scene.state in ("failed", "quarantined") else ""
        if scene.state == "running" and total > 0:
            filled = round(BAR * min(1.0, max(0.0, done / total)))
            note = f"{'━' * filled}{'╌' * (BAR - filled)} {min(1.0, done / total):4.0%} {text}"
        grade = "" if scene.result is None else printable(scene.result.grade, 10)
        return (
            printable(scene.name, 60), scene.state, printable(scene.stage or "", 20), duration(scene.seconds) if scene.seconds else "", grade,
            f"{psnr:.2f}" if psnr is not None else "", size(scene.bytes) if scene.bytes else "", printable(note, 300),
        )  # fmt: skip


def overview(state: FleetState) -> str:
    """A line: scenes by state, how many of their results are poor or failed, and the forecast."""
    totals = Totals.of(state.scenes)
    counts = ((word, getattr(totals, word)) for word in ("done", "running", "waiting", "failed", "quarantined"))
    parts = [f"{count} {word}" for word, count in counts if count]
    grades = [scene.result.grade for scene in state.scenes if scene.result is not None]
    parts += [f"{grades.count(grade)} with a {grade} result" for grade in BAD_GRADES if grade in grades]
    ahead = "" if not state.forecast_seconds else f"; about {duration(state.forecast_seconds)} to go"
    return (", ".join(parts) or "no scenes") + ahead + (f"; {printable(state.note, 300)}" if state.note else "")
