"""One failing operation: the run that meets it, what it leaves, and the next run."""

import contextlib
import errno
import os
import shutil
import signal
import stat
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TextIO

from benchmarks.torture import processes, report
from benchmarks.torture.comparison import differences, digests
from benchmarks.torture.kills import Prepared
from benchmarks.torture.processes import Child
from benchmarks.torture.trap import CHANGING, KINDS, Armed, Trap

NEW = "new"  # the scenario without a run
NOBODY = 65534  # a user who owns nothing


@dataclass(frozen=True)
class Case:
    """source and scenario: whose undisturbed run has the operation; where, kind and number: the operation, as in `Trap`."""

    source: str
    scenario: str
    where: str
    kind: str
    number: int
    errno: int
    lasting: bool
    deadly: int = 0


def base(prepared: Prepared, scenario: str, run: Path) -> None:
    """The run before the case: complete, but for an older artifact of the stage; or none."""
    if scenario == NEW:
        return
    finished = prepared.older.parent / "run"
    shutil.copytree(finished, run, symlinks=True)
    shutil.rmtree(run / scenario)
    shutil.copytree(prepared.older / scenario, run / scenario, symlinks=True)


class Cases:
    """The cases of one worker. Records are written to `book`, an object on each line."""

    def __init__(self, folder: Path, prepared: Sequence[Prepared], book: TextIO, workflow: Any = None) -> None:
        """workflow: of the command line, that of `workflows.asset` by default"""
        self.folder, self.book, self.workflow = folder, book, workflow
        self.prepared = {each.source.kind: each for each in prepared}
        self.done = 0
        folder.mkdir(parents=True)
        folder.chmod(0o755)

    def carry_out(self, case: Case) -> list[str]:
        """Returns what was wrong."""
        prepared = self.prepared[case.source]
        run = self.folder / f"case_{self.done}"
        self.done += 1
        base(prepared, case.scenario, run)
        before = digests(run, prepared.stages)
        armed = Armed(_trap(case), run, prepared.source.folder, self.folder / "state")
        child = self._start(prepared.source.arguments(run), armed)
        child.end()
        errors = child.errors.strip()
        wrong, names = [], ""
        if armed.fired:
            names, wrong = _judged(case, child, armed, errors, prepared.stages)
            found, wanted = digests(run, prepared.stages), prepared.expected.digests
            if child.code == 0:
                wrong += [f"{stage}: other bytes at once" for stage, digest in found.items() if digest != wanted[stage]]
            elif lost := [stage for stage, digest in found.items() if digest not in (before[stage], wanted[stage]) and not _aside(run, stage, case)]:
                wrong.append(f"lost: {', '.join(lost)}")
            wrong += self._after(prepared, run)
        elif child.code != 0:
            wrong.append(f"it ended with {child.code} without a fault: {errors[:300]}")
        if wrong:
            print(f"WRONG: {case} in {run}: {'; '.join(wrong)}\n       {armed.place} {errors[:300]}", flush=True)
        else:
            shutil.rmtree(run, ignore_errors=True)
        about = {"error": errno.errorcode[case.errno], "reached": armed.fired, "failed": armed.failed, "code": child.code, "names": names}
        place = " ".join(armed.place[1:]).replace(str(run), "RUN")
        about |= {"place": place, "errors": errors.replace(str(run), "RUN")[:500]} if wrong else {}
        report.record(self.book, {"event": "case", **asdict(case), **about, "wrong": wrong})
        return wrong

    def _after(self, prepared: Prepared, run: Path) -> list[str]:
        """What does not verify, and what the next run does not put right."""
        wrong = []
        if (run / "run.json").exists():
            verified = self._start(["verify", str(run)], None)
            if verified.end() != 0:
                wrong.append(f"verify ended with {verified.code}: {verified.errors.strip()[:300]}")
        child = self._start(prepared.source.arguments(run), None)
        if child.end() != 0:
            wrong.append(f"the next run ended with {child.code}: {child.errors.strip()[:300]}")
        return wrong + differences(run, prepared.expected)

    def read_only(self, prepared: Prepared) -> None:
        """A run folder that may not be written: by the system's word (EROFS), and by its owner's where another user runs."""
        reachable = all(parent.stat().st_mode & stat.S_IXOTH for parent in self.folder.absolute().parents)  # a temporary folder may be its owner's alone
        for how in ("EROFS", "another user") if reachable else ("EROFS",):
            run = self.folder / "read_only"
            base(prepared, "train", run)
            if how != "EROFS":
                for path in (run, *run.rglob("*")):  # safetensors writes files that nobody else may read
                    path.chmod(0o755 if path.is_dir() else 0o644)
            armed = Armed(Trap(1, "", CHANGING, "", errno.EROFS, True), run, prepared.source.folder, self.folder / "state") if how == "EROFS" else None
            if armed is None and os.geteuid() != 0:
                run.chmod(0o555)
            user = NOBODY if armed is None and os.geteuid() == 0 else None
            codes, wrong = {}, []
            for name, arguments, good in (
                ("run", prepared.source.arguments(run), 2),
                ("status", ["status", str(run)], 0),
                ("verify", ["verify", str(run)], 0),
            ):
                child = processes.start(arguments, self.folder / f"errors_{how}_{name}.txt", armed, user=user)
                codes[name] = child.end()
                if child.code != good or "Traceback" in child.errors:
                    wrong.append(f"{name} ended with {child.code}: {child.errors.strip()[:300]}")
            with contextlib.suppress(OSError):
                run.chmod(0o755)
            wrong += self._after(prepared, run)
            shutil.rmtree(run)
            if wrong:
                print(f"WRONG: read-only run folder ({how}): {'; '.join(wrong)}", flush=True)
            report.record(self.book, {"event": "read-only", "how": how, "codes": codes, "wrong": wrong})

    def _start(self, arguments: Sequence[str], armed: Armed | None) -> Child:
        return processes.start(arguments, self.folder / "errors.txt", armed, workflow=self.workflow)


def _aside(run: Path, stage: str, case: Case) -> bool:
    """Whether an artifact that was being replaced waits for the next run: where nothing can be renamed any more it cannot be put back."""
    return case.lasting and (run / ".work" / f"old-{stage}" / "manifest.json").is_file()


def _trap(case: Case) -> Trap:
    """Which operations go on failing: all, on a broken disk; those that need a new descriptor; else those that change something."""
    fault_kinds = {errno.EIO: KINDS, errno.EMFILE: ("read", "open")}.get(case.errno, CHANGING)
    return Trap(case.number, case.where, (case.kind,), "", case.errno, case.lasting, fault_kinds, case.deadly)


def _judged(case: Case, child: Child, armed: Armed, errors: str, stages: Sequence[str]) -> tuple[str, list[str]]:
    """(what the message names: "file", "folder", "stage" or nothing; what is wrong with how the run ended)."""
    wrong = []
    if case.deadly:
        met = armed.failed >= case.deadly
        return "", [] if not met or child.code == -signal.SIGKILL else [f"it was to be killed, and ended with {child.code}"]
    allowed = {0, 3}
    if case.where == "source" or case.errno in (errno.EACCES, errno.EROFS) or not child.started:
        allowed.add(2)
    if case.errno == errno.EIO and (case.kind == "read" or case.lasting):
        allowed.add(4)
    if child.code not in allowed:
        wrong.append(f"exit code {child.code}")
    if "Traceback" in errors:
        wrong.append("a traceback")
    if child.code == 0:
        return "", wrong
    lines = errors.splitlines()
    message = [line for line in lines if line.startswith("enerf: ")]
    if len(message) != 1 or len(lines) > 2:
        wrong.append(f"{len(lines)} lines, {len(message)} of them a message")
    path = Path(armed.place[2])
    parts = path.name.strip(".").split(".")
    if path.name in errors or ".".join(parts[:2]) in errors:
        return "file", wrong
    if str(path.parent) in errors or str(armed.run) in errors or str(armed.source) in errors:
        return "folder", wrong
    if errors.removeprefix("enerf: ").partition(":")[0] in stages:
        return "stage", wrong
    return "nothing", [*wrong, "the message names neither file nor stage"]
