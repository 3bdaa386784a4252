"""What comes before the first disturbance: sources, undisturbed runs, and a process that has everything imported."""

import argparse
import json
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, TextIO

from benchmarks.project import RESULTS
from benchmarks.torture import processes, sources, trap
from benchmarks.torture.comparison import Expected, differences, expected
from benchmarks.torture.kills import Prepared
from benchmarks.torture.sources import Source
from benchmarks.torture.trap import Armed, Operation, Trap
from pipeline.files import write_json

READY = "TORTURE_READY"


def begin(parser: argparse.ArgumentParser, name: str) -> tuple[argparse.Namespace, list[Prepared]]:
    """The options, with those of all torments, and the undisturbed runs; where the results go is NAME.json."""
    parser.add_argument("--jobs", type=int, default=1, help="how many runs at a time")
    parser.add_argument("--sources", default=",".join(sources.KINDS))
    parser.add_argument("--json", type=Path, default=RESULTS / f"{name}.json", help="where the result goes")
    parser.add_argument("--folder", type=Path, help="where the runs go; default: a temporary folder, removed unless something is wrong")
    given = parser.parse_args()
    given.folder = given.folder or Path(tempfile.mkdtemp(prefix=f"{name}-"))
    given.folder.mkdir(parents=True, exist_ok=True)
    in_prepared_process(given.folder)
    given.begun = time.monotonic()
    return given, prepare(given.folder, given.sources.split(","))


def end(given: argparse.Namespace, result: dict[str, Any], wrong: bool) -> int:
    """Write the result, and remove the runs where all is right; the exit code."""
    given.json.parent.mkdir(parents=True, exist_ok=True)
    write_json(given.json, result)
    if not wrong:
        shutil.rmtree(given.folder, ignore_errors=True)
    return int(wrong)


def in_prepared_process(folder: Path) -> None:
    """Begin this program anew with one thread and the library that counts operations, unless that is done."""
    if os.environ.get(READY):
        return
    library = trap.build(folder)
    environment = {**processes.single_threaded_environment(library), READY: "yes"}
    os.execve(sys.executable, [sys.executable, *sys.orig_argv[1:], "--folder", str(folder)], environment)


def undisturbed(source: Source, folder: Path) -> None:
    """Write the reference of a source, how long its stages took and what they did; and a run with other artifacts. Raises SystemExit."""
    place = folder / "undisturbed" / source.kind
    place.mkdir(parents=True)
    run, log = place / "run", place / "log"
    armed = Armed(Trap(), run, source.folder, place / "state", log)
    os.environ["TORTURE_MODULES"] = str(place / "modules")
    _complete(source.arguments(run), place, armed)
    del os.environ["TORTURE_MODULES"]
    child = _complete(source.arguments(place / "again"), place)
    real = _complete(source.arguments(place / "real"), place, fresh=True)
    wanted = expected(run)
    for name in ("again", "real"):
        if wrong := differences(place / name, wanted):
            raise SystemExit(f"{source.kind}: two undisturbed runs ({name}) differ: {'; '.join(wrong)}")
    _complete(source.arguments(place / "older", "--set", sources.OTHER), place)
    same = [stage for stage, digest in expected(place / "older").digests.items() if digest == wanted.digests[stage]]
    if same:
        raise SystemExit(f"{source.kind}: with {sources.OTHER} there is no other artifact of {', '.join(same)}")
    facts = {"digests": wanted.digests, "names": sorted(wanted.names), "seconds": child.seconds, "real_seconds": real.seconds}
    facts["operations"] = [asdict(operation) for operation in trap.operations(log)]
    (place / "facts.json").write_text(json.dumps(facts), encoding="utf-8")


def _complete(arguments: Sequence[str], place: Path, armed: Armed | None = None, *, fresh: bool = False) -> processes.Child:
    child = processes.start(arguments, place / "errors.txt", armed, fresh=fresh)
    if child.end() != 0:
        raise SystemExit(f"an undisturbed run ended with {child.code}: {child.errors.strip()}")
    return child


def read(source: Source, folder: Path) -> Prepared:
    """What `undisturbed` wrote."""
    place = folder / "undisturbed" / source.kind
    facts = json.loads((place / "facts.json").read_text(encoding="utf-8"))
    found = [Operation(**operation) for operation in facts["operations"]]
    return Prepared(source, Expected(facts["digests"], frozenset(facts["names"])), facts["seconds"], found, place / "older")


def prepare(folder: Path, kinds: Sequence[str]) -> list[Prepared]:
    """Make the sources, run each undisturbed, and import what those runs needed. Raises SystemExit."""
    made = [sources.make(kind, folder / "sources") for kind in kinds]
    processes.preload()

    def all_undisturbed() -> None:
        for source in made:
            undisturbed(source, folder)

    if wait_for([processes.forked(all_undisturbed)]):
        raise SystemExit(1)
    for source in made:
        processes.preload_modules((folder / "undisturbed" / source.kind / "modules").read_text(encoding="utf-8").splitlines())
    return [read(source, folder) for source in made]


def records(folder: Path, jobs: int, work: Callable[[int, TextIO], None]) -> list[dict[str, Any]]:
    """What so many workers write, each a process with a number and a book of its own: an object on each line. Raises SystemExit."""
    books = [folder / f"book_{job}.jsonl" for job in range(jobs)]

    def write(job: int) -> None:
        with books[job].open("w", encoding="utf-8") as book:
            work(job, book)

    if wait_for([processes.forked(lambda job=job: write(job)) for job in range(jobs)]):  # type: ignore[misc]
        raise SystemExit("a worker failed")
    return [json.loads(line) for book in books for line in book.read_text(encoding="utf-8").splitlines()]


def wait_for(workers: Sequence[int]) -> int:
    """How many workers did not end well."""
    return sum(os.waitstatus_to_exitcode(os.waitpid(worker, 0)[1]) != 0 for worker in workers)
