"""A workflow of four toy stages: photos are listed, counted slowly with checkpoints, doubled, and put into a report with a volatile log."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pipeline.run import Run
from pipeline.stage import Job, Stage, settings_dict


@dataclass(frozen=True)
class ListSettings:
    upper: bool = False


@dataclass(frozen=True)
class CountSettings:
    steps: int = 6
    rate: float = 0.5
    name: str | None = None


@dataclass(frozen=True)
class NoSettings:
    pass


def source_files(source: Path, settings: Any) -> list[Path]:
    return sorted(source.glob("*.jpg"))


def run_list(job: Job) -> None:
    assert job.source is not None
    names = [f"{path.name} {len(path.read_bytes())}" for path in source_files(job.source, job.settings)]
    text = "\n".join(names)
    (job.out / "list.txt").write_text(text.upper() if job.settings.upper else text)
    (job.out / "images").mkdir()
    for path in source_files(job.source, job.settings):
        (job.out / "images" / path.name).write_bytes(path.read_bytes())


def run_count(job: Job) -> None:
    """Goes on from its checkpoint to the same bytes."""
    checkpoint = job.work / "state.txt"
    lines = checkpoint.read_text().splitlines() if checkpoint.exists() else []
    listed = (job.inputs["list"] / "list.txt").read_text()
    for step in range(len(lines), job.settings.steps):
        lines.append(f"{step} {job.settings.rate * step} {len(listed)}")
        aside = job.work / "state.tmp"
        aside.write_text("\n".join(lines))
        aside.rename(checkpoint)
        job.progress(step + 1, job.settings.steps)
        job.safe_point()
    job.record("counted", {"steps": len(lines)})
    (job.out / "count.txt").write_text("\n".join(lines))
    (job.out / "log.jsonl").write_text(str(time.time_ns()))


def run_double(job: Job) -> None:
    (job.out / "double.txt").write_text((job.inputs["count"] / "count.txt").read_text() * 2)


def run_report(job: Job) -> None:
    texts = [(job.inputs["list"] / "list.txt").read_text(), (job.inputs["double"] / "double.txt").read_text()]
    (job.out / "report.txt").write_text("\n--\n".join(texts))


LIST = Stage("list", 1, ListSettings, (), run_list, reads_source=True, source_files=source_files)
COUNT = Stage("count", 1, CountSettings, ("list",), run_count, volatile=("log.*",))
DOUBLE = Stage("double", 1, NoSettings, ("count",), run_double)
REPORT = Stage("report", 1, NoSettings, ("list", "double"), run_report)
STAGES = (LIST, COUNT, DOUBLE, REPORT)


def make_source(folder: Path) -> Path:
    folder.mkdir(parents=True)
    for index in range(3):
        (folder / f"{index}.jpg").write_bytes(b"x" * (index + 1))
    (folder / "notes.txt").write_text("not a photo")
    return folder


def make_run(folder: Path, **settings: dict[str, Any]) -> Run:
    resolved = {stage.name: {**settings_dict(stage.settings()), **settings.get(stage.name, {})} for stage in STAGES}
    return Run.create(folder / "run", make_source(folder / "photos"), resolved)


def set_one(run: Run, stage: str, **values: Any) -> None:
    run.update(settings={**run.settings, stage: {**run.settings[stage], **values}})


def contents(folder: Path) -> dict[str, bytes]:
    """Every file below a folder, without what depends on the clock, and the lease."""
    found = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.is_file() and not name.endswith(("manifest.json", "log.jsonl", "hashes.json")) and not name.startswith(".lease/"):
            found[name] = path.read_bytes()
    return found


class Events(list[dict[str, Any]]):
    """Takes events and answers questions about them."""

    def __call__(self, event: dict[str, Any]) -> None:
        self.append(event)

    def named(self, name: str) -> list[dict[str, Any]]:
        return [event for event in self if event["event"] == name]

    def text(self) -> str:
        return "\n".join(str(event.get("text", "")) for event in self)


def actions(outcomes: list[Any]) -> dict[str, str]:
    return {outcome.stage: outcome.action for outcome in outcomes}


def raising(error: BaseException) -> Callable[[Job], None]:
    def run(job: Job) -> None:
        (job.out / "half.txt").write_text("half")
        raise error

    return run


def replaced(name: str, **changes: Any) -> list[Stage]:
    """The stages, one of them with other fields."""
    return [replace(stage, **changes) if stage.name == name else stage for stage in STAGES]
