"""Let file operations of a run fail, each of them in turn, and see what the run says, what it leaves, and what the next run makes of that.

    python -m benchmarks.torture.faults [--jobs 1] [--sources blender,photographs,llff] [--json FILE]

A case is one operation of one stage, which fails with one of ENOSPC, EIO, EROFS, EACCES, EMFILE, once or with all that follow. The stage replaces an
older artifact; those before and after it are there. Then

    the exit code is 3. It is 2 where the user can help: the source cannot be read, the run may not be read or written (EACCES, EROFS), or it could not begin;
    4 where a broken disk (EIO) keeps a file of the run from being read, which then counts as damaged; 0 where the run can do without the operation, or
    makes anew what it lost, with the right artifacts
    the message has one or two lines, names the file, its folder or its stage, and is no traceback
    every artifact that is there verifies
    the next run, without faults, ends with the artifacts of an undisturbed run and an empty .work

A place is a kind of operation on a path, without numbers and random parts: all previews are one place, and so are all photographs of a source. Each place
meets one error: in turns at its first operation, once, and at its last, lasting. What the engine does, and what the stage poses of the other sources does, is
met where it occurs first; their later stages do the same as those of the Blender set. The errors change from place to place, and all five meet every kind of
operation in every stage.
"""

import argparse
import errno
import itertools
import random
import re
import shutil
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TextIO

from benchmarks.torture import processes, report
from benchmarks.torture.cases import NEW, Case, Cases, base
from benchmarks.torture.comparison import STAGES
from benchmarks.torture.kills import Prepared
from benchmarks.torture.preparation import begin, end, records, wait_for
from benchmarks.torture.trap import Armed, Operation, Trap, operations

ERRORS = (errno.ENOSPC, errno.EIO, errno.EROFS, errno.EACCES, errno.EMFILE)
OF_READING = (errno.EIO, errno.EACCES, errno.EMFILE)
DEADLY = (1, 2, 3, 5)  # the failing operation at which a run on a full disk is killed


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--stages", default=",".join((NEW, *STAGES)), help="of the Blender set; of the others it is poses")
    parser.add_argument("--share", type=int, default=1, help="one case in so many")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="stop then, and say how many cases are left; they come in a random order")
    given, prepared = begin(parser, "faults")
    logs = given.folder / "logs"
    wait_for([processes.forked(lambda: _log_all(prepared, given.stages.split(","), logs))])
    cases, seen = planned(prepared, given.stages.split(","), logs)
    random.Random(0).shuffle(cases)
    cases = cases[: -(-len(cases) // given.share)]
    print(f"{len(cases)} cases", flush=True)
    lines = _all(cases, prepared, given.folder, given.jobs, given.minutes)
    result = summary(lines, seen, len(cases)) | report.circumstances(given.begun, given.jobs, seed=0)
    found = f"{result['cases']} cases at {result['operations_covered']} operations, {result['elapsed_seconds']:.0f} s: {len(result['wrong'])} wrong"
    print(f"{found}; {given.json}")
    return end(given, result, bool(result["wrong"]))


def _scenarios(prepared: Sequence[Prepared], stages: Sequence[str]) -> list[tuple[Prepared, str]]:
    return [(each, stage) for each in prepared for stage in (stages if each.source.kind == "blender" else ["poses"])]


def _log_all(prepared: Sequence[Prepared], stages: Sequence[str], logs: Path) -> None:
    """Write what an undisturbed run does in each scenario."""
    logs.mkdir()
    for each, stage in _scenarios(prepared, stages):
        run = logs / "run"
        base(each, stage, run)
        armed = Armed(Trap(), run, each.source.folder, logs / "state", logs / f"{each.source.kind}_{stage}")
        child = processes.start(each.source.arguments(run), logs / "errors.txt", armed)
        if child.end() != 0:
            raise SystemExit(f"an undisturbed run ended with {child.code}: {child.errors}")
        shutil.rmtree(run)


def planned(prepared: Sequence[Prepared], stages: Sequence[str], logs: Path) -> tuple[list[Case], dict[str, dict[str, int]]]:
    """(all cases, scenario -> "stage kind" -> number of places that an undisturbed run has)."""
    cases: list[Case] = []
    known: set[tuple[str, str, str]] = set()
    seen = {}  # of a new run, up to its second stage: later ones are met where a stage is replaced
    for each, stage in _scenarios(prepared, stages):
        of_kind: dict[tuple[str, str], dict[str, list[Operation]]] = defaultdict(lambda: defaultdict(list))
        found = operations(logs / f"{each.source.kind}_{stage}")
        second = next((index for index, operation in enumerate(found) if operation.stage == STAGES[1] and operation.kind == "mkdir"), len(found))
        for operation in found[:second] if stage == NEW else found:
            of_kind[operation.stage, operation.kind][place_of(operation, logs / "run", each.source.folder)].append(operation)
        seen[f"{each.source.kind} {stage}"] = {" ".join(which): len(some) for which, some in sorted(of_kind.items())}
        for (where, kind), some in sorted(of_kind.items()):
            if where not in (stage, "engine") and (where != "source" or stage != "poses"):
                continue
            new = {place: some[place] for place in some if (where, kind, place) not in known}
            known |= {(where, kind, place) for place in new}
            cases += _of_kind(each.source.kind, stage, kind, list(new.values()))
        if stage != NEW:
            cases += [Case(each.source.kind, stage, stage, "write", 1, errno.ENOSPC, True, deadly) for deadly in DEADLY]
    return cases, seen


def place_of(operation: Operation, run: Path, source: Path) -> str:
    """The path of an operation without what differs between files of one sort, and between stages where it is the engine's."""
    path = operation.path.removeprefix(f"{run}/").removeprefix(f"{source}/")
    path = re.sub(r"[0-9a-f]{8,}|[0-9]+", "#", path)
    return re.sub(rf"\b(?:{'|'.join(STAGES)})\b", "STAGE", path) if operation.stage == "engine" else path


def _of_kind(source: str, stage: str, kind: str, places: Sequence[Sequence[Operation]]) -> list[Case]:
    """A case for each place; errors in turn, and all of them where there are fewer places than errors."""
    errors = OF_READING if kind == "read" else ERRORS
    cases = []
    for index in range(max(len(places), len(errors)) if places else 0):
        lasting, place = bool(index % 2), places[index % len(places)]
        operation = place[-1] if lasting else place[0]
        cases.append(Case(source, stage, operation.stage, kind, operation.number, errors[index % len(errors)], lasting))
    return cases


def _all(cases: Sequence[Case], prepared: Sequence[Prepared], folder: Path, jobs: int, minutes: float) -> list[dict[str, Any]]:
    """Carry out all cases; the records."""
    until = time.monotonic() + 60 * minutes

    def work(job: int, book: TextIO) -> None:
        worker = Cases(folder / f"worker_{job}", prepared, book)
        if job == 0:
            worker.read_only(prepared[0])
        for case in itertools.takewhile(lambda _: time.monotonic() < until, cases[job::jobs]):
            worker.carry_out(case)

    return records(folder, jobs, work)


def summary(lines: Sequence[dict[str, Any]], seen: dict[str, dict[str, int]], planned: int) -> dict[str, Any]:
    """Counts of what was done, and all that was wrong."""
    read_only = [line for line in lines if line["event"] == "read-only"]
    cases = [line for line in lines if line["event"] == "case"]
    reached = [case for case in cases if case["reached"]]

    def counted(*names: str) -> dict[str, int]:
        return dict(sorted(Counter(" ".join(str(case[name]) for name in names) for case in reached).items()))

    tolerated = Counter(f"{case['where']} {case['kind']} {(case['lasting'] and 'lasting') or 'once'}" for case in reached if case["code"] == 0)
    met = {(case["where"], case["kind"], case["error"]) for case in reached}
    wanted = {(where, kind, name) for where, kind, _ in met for name in map(errno.errorcode.get, OF_READING if kind == "read" else ERRORS)}
    return {
        "cases": len(reached),
        "planned_and_not_carried_out": planned - len(cases),
        "not_reached": len(cases) - len(reached),
        "wrong": [line for line in lines if line["wrong"]],
        "operations_covered": len({(case["source"], case["scenario"], case["where"], case["kind"], case["number"]) for case in reached}),
        "places_of_undisturbed_runs": seen,
        "cases_per_scenario": counted("source", "scenario"),
        "cases_per_kind_and_error": counted("kind", "error"),
        "stages_kinds_and_errors_that_did_not_meet": sorted(" ".join(map(str, which)) for which in wanted - met),
        "once_and_lasting": dict(Counter("lasting" if case["lasting"] else "once" for case in reached)),
        "killed_while_the_disk_is_full": sum(bool(case["deadly"]) for case in reached),
        "read_only_run_folder": read_only,
        "exit_codes": counted("code"),
        "exit_codes_by_place": counted("where", "code"),
        "done_without_the_operation": dict(sorted(tolerated.items())),
        "the_message_names": counted("names"),
    }


if __name__ == "__main__":
    sys.exit(main())
