"""Pages of a running fleet: each written atomically, now and then, and at the end."""

import os
import time
from pathlib import Path

from pipeline.files import write_atomically
from pipeline.fleet.state import FleetState, SceneState
from stages.artifacts import PosesOutputs, TurntableOutputs
from stages.figures.thumbnails import write_thumbnail
from stages.io.pictures import UnreadableImage
from workflows.fleet.pages import comparison, index, spreadsheet
from workflows.report.page import NAME as REPORT
from workflows.report.signature import is_newer, is_own

FILES = (index.NAME, index.THUMBNAILS, spreadsheet.NAME, comparison.NAME, comparison.FOLDER)  # what pages consist of
SECONDS = 5.0  # between two writings, and WRITE_INTERVAL_RATIO as long as one takes
WRITE_INTERVAL_RATIO = 20.0
THUMBNAIL_SECONDS = 1.0  # of work on thumbnails in one writing, while the fleet runs


class Pages:
    """Writes index.html, fleet.csv, thumbnails and, of a sweep, comparison.html. Call it with each new state."""

    def __init__(self, fleet: Path) -> None:
        self.fleet = fleet  # its folder
        self.trouble: str | None = None  # why the last writing failed, or None: pages that cannot be written end no fleet
        self._next = 0.0
        self._pending: FleetState | None = None
        self._pictures: dict[str, tuple[str, int]] = {}  # scene -> what its thumbnail is of, and when it was made
        self._reports: set[str] = set()  # scenes whose report was seen

    def __call__(self, state: FleetState) -> None:
        """Write the pages if it is time, and in any case once the fleet has ended."""
        self._pending = state
        self.catch_up()

    def catch_up(self) -> None:
        """Write a state that came too soon after the one before, once it is time: the next change may be long in coming."""
        state, began = self._pending, time.monotonic()
        if state is None or (state.state == "running" and began < self._next):
            return
        self._pending = None
        try:
            self._write(state)
            self.trouble = None
        except OSError as error:
            self.trouble = f"{error.filename or self.fleet}: {error.strerror or error}"
        self._next = time.monotonic() + max(SECONDS, WRITE_INTERVAL_RATIO * (time.monotonic() - began))

    def _write(self, state: FleetState) -> None:
        self._make_thumbnails(state)
        ended = state.state != "running"
        reports = self._reports_of(state)
        compared = comparison.write_comparison(self.fleet, state, reports, plots=ended)
        pictures = {name: made for name, (_, made) in self._pictures.items() if made}
        title, compared_in = self.fleet.absolute().name, comparison.NAME if compared else None
        page = index.index_page(state, title=title, pictures=pictures, reports=reports, comparison=compared_in)
        write_atomically(self.fleet / index.NAME, page.encode("utf-8"), durable=ended)
        write_atomically(self.fleet / spreadsheet.NAME, spreadsheet.fleet_csv(state).encode("utf-8"), durable=ended)

    def _reports_of(self, state: FleetState) -> set[str]:
        """Scenes with a report of our own, in any state: the outputs of a failed scene can still be read. A scene without a stage has none."""
        begun = (scene for scene in state.scenes if scene.name not in self._reports and any(stage.state == "done" for stage in scene.stages.values()))
        self._reports |= {scene.name for scene in begun if is_own(self.fleet / scene.run / REPORT)}
        return self._reports

    def _make_thumbnails(self, state: FleetState) -> None:
        """Of scenes whose turntable, or whose photographs before that, have come since; as many as there is time for."""
        began, running = time.monotonic(), state.state == "running"
        folder = self.fleet / index.THUMBNAILS
        folder.mkdir(exist_ok=True)
        for scene in state.scenes:
            stage = _shown_stage(scene)
            known = self._pictures.get(scene.name)
            if stage is None or (known is not None and known[0] == stage):
                continue
            if running and time.monotonic() - began > THUMBNAIL_SECONDS:
                return
            target = folder / f"{scene.name}.webp"
            picture = _picture(self.fleet / scene.name, stage)
            if picture is None:
                continue
            try:
                if not is_newer(target, [picture]):
                    write_thumbnail(picture, target)
                self._pictures[scene.name] = stage, os.stat(target).st_mtime_ns
            except UnreadableImage:
                self._pictures[scene.name] = stage, 0  # it is not tried again


def _shown_stage(scene: SceneState) -> str | None:
    """The stage whose picture stands for a scene: the last that is done of those that have one."""
    for stage in (TurntableOutputs.stage, PosesOutputs.stage):
        found = scene.stages.get(stage)
        if found is not None and found.state == "done":
            return stage
    return None


def _picture(run: Path, stage: str) -> Path | None:
    if stage == TurntableOutputs.stage:
        return TurntableOutputs.of_run(run).poster
    for parent, folders, names in os.walk(PosesOutputs.of_run(run).images):  # the first by name
        folders.sort()
        if names:
            return Path(parent, min(names))
    return None
