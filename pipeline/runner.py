"""Runs the stages that `decide` finds not fresh, and verifies a run."""

import contextlib
import signal
import threading
import time
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from typing import Any, NoReturn

from pipeline import artifact, files, manifest
from pipeline.artifact import Workplace
from pipeline.decide import Decision, decide, needed_by, selection, survey
from pipeline.errors import BadInput, CorruptArtifact, Interrupted, PipelineError, UsageError
from pipeline.executors import local
from pipeline.executors.local import Usage
from pipeline.executors.memory import Limit
from pipeline.executors.side_by_side import SideBySide
from pipeline.failures import failed, interruption_in, translated
from pipeline.hashes import Hashes
from pipeline.interrupt import Stop, stopping
from pipeline.manifest import Manifest, Request
from pipeline.run import Run
from pipeline.stage import Job, Report, Stage, settings_of

Executor = Callable[[Stage, Job], Usage]

POLL = 0.1  # seconds between two looks for a signal while stages run at the same time


@dataclass(frozen=True)
class Outcome:
    """What became of one stage."""

    stage: str
    action: str  # "ran", "skipped" (it was fresh), "would run" or, of a dry run, "may run" (if those before it give something new)
    reason: str | None = None  # why it ran; None if it was fresh
    seconds: float = 0.0  # that it took, also when it was fresh
    size: int = 0  # bytes of its artifact
    digest: str | None = None  # of its artifact


def run_stages(
    run: Run,
    stages: Sequence[Stage],
    *,
    until: str | None = None,
    start: str | None = None,
    only: str | None = None,
    force: bool = False,
    device: str = "cpu",
    memory: Limit | None = None,
    report: Report | None = None,
    dry_run: bool = False,
    execute: Executor = local.execute,
    side_by_side: SideBySide | None = None,
) -> list[Outcome]:
    """Bring a run up to date; returns an outcome for each stage considered, in order.

    stages        the workflow: each after those that it needs
    until         the last stage to consider, in the order of the list
    start         run this stage and those after it even if they are fresh; those before it if they are not
    only          consider this stage alone, with the artifacts of those before it; warns if they are not fresh
    force         run the stages considered even if they are fresh
    memory        handed to the stages; None: no limit
    report        takes events: stage_started, progress, message, warning, stage_done, stage_skipped, stage_failed, interrupted
    side_by_side  runs stages that do not need each other, at the same time, where the memory admits it; None: one stage after another

    Raises PipelineError. What was published before stays; the next call resumes what was interrupted.
    """
    chosen, forced = selection(stages, until=until, start=start, only=only, force=force)
    refuse_what_cannot_work(chosen, run, forced)
    if dry_run:
        if only is not None:
            _warn_of_stale_needs(run, stages, only, report, Hashes(run.cache))
        return _plan(run, chosen, forced, report)

    def go_on(stage: str) -> str:
        """How to go on after an interruption in this stage: what was to run although it was up to date is, still."""
        if only is not None:
            return run.how_to_resume(only=only, force=force)
        first = stage if stage in forced else next((each.name for each in chosen if each.name in forced), None)
        return run.how_to_resume(until=until, start=first)

    with run.locked(), stopping() as stop:
        return _Runner(run, stages, device, memory, report, stop, execute, side_by_side).all(chosen, forced, only, go_on)


@dataclass
class _Runner:
    """One call of run_stages."""

    run: Run
    stages: Sequence[Stage]
    device: str
    memory: Limit | None
    report: Report | None
    stop: Stop
    execute: Executor
    side_by_side: SideBySide | None

    def __post_init__(self) -> None:
        self.work = self.run.path / artifact.WORK
        self._report = None if self.report is None else _one_at_a_time(self.report)
        self._lock = threading.Lock()  # of everything but the work of a stage
        self.hashes = Hashes(self.run.cache, safe_point=self.safe_point)

    def all(self, chosen: Sequence[Stage], forced: frozenset[str], only: str | None, go_on: Callable[[str], str]) -> list[Outcome]:
        outcomes: list[Outcome] = []
        current = ""
        try:
            for text in self._recover():
                self.emit("message", text.partition(":")[0], text=text)
            if only is not None:
                _warn_of_stale_needs(self.run, self.stages, only, self._report, self.hashes)
            waiting = list(chosen)
            while waiting:
                ready = _ready(waiting)
                current = ready[0].name
                self.safe_point()
                together = self._are_admitted(ready, forced, sum(outcome.seconds for outcome in outcomes))
                outcomes += self._together(waiting, forced) if together else [self.one(ready[0], current in forced, self.execute, self.memory)]
                waiting = [stage for stage in waiting if stage.name not in {outcome.stage for outcome in outcomes}]
        except (Interrupted, KeyboardInterrupt) as error:
            raise self._interrupted(error, current, go_on(current)) from error
        except OSError as error:  # outside of a stage: while looking, or while putting right
            raise failed(self.run.path, error) from error
        finally:
            self.hashes.save()
        order = [stage.name for stage in chosen]
        return sorted(outcomes, key=lambda outcome: order.index(outcome.stage))

    def _are_admitted(self, ready: Sequence[Stage], forced: Collection[str], seconds: float) -> bool:
        """Whether these run at the same time: it is worth it after so many seconds, more than one has to run, and each has enough memory in a share of it."""
        if self.side_by_side is None or self.side_by_side.jobs < 2 or len(ready) < 2 or seconds < self.side_by_side.least:
            return False
        stale = [stage for stage in ready if stage.name in forced or not decide(stage, self.run, self.hashes).fresh]
        return len(stale) > 1 and self._have_memory(stale)

    def _have_memory(self, stages: Sequence[Stage]) -> bool:
        """Whether each has enough in the share of the memory that a stage has which runs next to others."""
        assert self.side_by_side is not None
        if self.memory is None:
            return True
        share = self.memory.bytes // self.side_by_side.jobs
        return all((need := self.side_by_side.need(stage)) is not None and need <= share for stage in stages)

    def _together(self, waiting: Sequence[Stage], forced: Collection[str]) -> list[Outcome]:
        """`one` for each that is ready, at the same time, and for those that become ready while others still run.
        The first error is raised once all have ended; no other stage begins after it."""
        assert self.side_by_side is not None
        side_by_side, left, begun = self.side_by_side, list(waiting), dict[Future[Outcome], Stage]()
        memory = None if self.memory is None else Limit(self.memory.bytes // side_by_side.jobs, self.memory.whose)
        with ThreadPoolExecutor(side_by_side.jobs, thread_name_prefix="stage") as pool:
            pending, new = set[Future[Outcome]](), _ready(left)
            while new or pending:
                submitted = {pool.submit(self.one, stage, stage.name in forced, side_by_side.execute, memory): stage for stage in new}
                begun |= submitted
                pending |= submitted.keys()
                wait(pending, timeout=POLL, return_when=FIRST_COMPLETED)
                ended = {future for future in pending if future.done()}
                pending -= ended
                stop = self._is_to_stop()
                if stop or any(future.cancelled() or future.exception() is not None for future in ended):
                    pool.shutdown(wait=False, cancel_futures=True)
                    left = []
                if stop:
                    side_by_side.stop()  # a child heeds the first
                left = [stage for stage in left if stage.name not in {begun[future].name for future in ended}]
                free = [stage for stage in _ready(left) if stage.name not in {each.name for each in begun.values()}] if ended and pending else []
                new = [stage for stage in free if self._have_memory([stage])]
        side_by_side.rest()
        self.safe_point()
        for future in begun:
            if not future.cancelled() and (error := future.exception()) is not None:
                raise error
        return [future.result() for future in begun]

    def one(self, stage: Stage, forced: bool, execute: Executor, memory: Limit | None) -> Outcome:
        """Decide about one stage, and run it if needed."""
        with self._lock:
            decision = decide(stage, self.run, self.hashes)
            if decision.note:
                self.emit("warning" if not decision.fresh else "message", stage.name, text=decision.note)
            if decision.fresh and not forced and decision.manifest is not None:
                self._clear(stage, decision.manifest)
                self.emit("stage_skipped", stage.name, reason="up to date", digest=decision.manifest.digest)
                return _outcome(stage, "skipped", None, decision.manifest)
            reason = decision.reason or "forced"
            request = self._runnable(stage, decision, reason)
            place = artifact.workplace(self.run.path, stage.name, request)
            started = time.monotonic()
            try:
                made = artifact.finished(place, stage.name)
                if made is None:
                    made = self._make(stage, request, place, reason, execute, memory)
                else:
                    self.emit("message", stage.name, text=f"{stage.name} was done before; only its publication had been cut short")
                self.run.check_held()
                artifact.publish(self.run.path, stage.name, place)
            except (Exception, KeyboardInterrupt) as error:
                self._failed(stage, place, error)
            self.hashes.forget(f"{stage.name}/", {f"{stage.name}/{name}" for name in made.outputs})
            facts = {"seconds": time.monotonic() - started, "size": made.size, "digest": made.digest, "files": len(made.outputs)}
            facts |= {"peak_memory": made.peak_memory, "cpu_seconds": made.cpu_seconds, "cores_busy": made.cores_busy, "cores": made.cores}
            self.emit("stage_done", stage.name, reason=reason, **facts)
            return _outcome(stage, "ran", reason, made)

    def _make(self, stage: Stage, request: Request, place: Workplace, reason: str, execute: Executor, memory: Limit | None) -> Manifest:
        """Run the stage and seal its outputs."""
        resumed = artifact.prepare(place, self.work)
        self.emit("stage_started", stage.name, reason=reason, resumed=resumed)
        job = Job(
            settings=settings_of([stage], self.run.settings)[stage.name],
            inputs={need: self.run.folder(need) for need in stage.needs},
            source=self.run.source if stage.reads_source else None,
            also=self.run.also if stage.reads_source else (),
            out=place.out,
            work=place.scratch,
            device=self.device,
            memory=memory,
            stage=stage.name,
            report=self._report,
            stop=self.stopped,
        )
        self._lock.release()
        try:
            usage = execute(stage, job)
        finally:
            self._lock.acquire()
        outputs = artifact.outputs_of(place.out, stage, self.hashes)
        made = Manifest(request, outputs, usage.seconds, usage.peak_memory, resumed, cpu_seconds=usage.cpu_seconds, cores=usage.cores, facts=job.facts)
        artifact.seal(place.out, made)
        return made

    def _runnable(self, stage: Stage, decision: Decision, reason: str) -> Request:
        """The request to run; raises the error that prevents it."""
        until = self.run.how_to_resume(until=stage.name)
        if decision.request is None:
            obstacle = decision.obstacle
            if isinstance(obstacle, CorruptArtifact):
                raise CorruptArtifact(f"{obstacle} Make it anew: {until}", obstacle.files) from obstacle
            if isinstance(obstacle, BadInput) and any(not self.run.folder(need).exists() for need in stage.needs):
                raise BadInput(f"{obstacle} Make it first: {until}") from obstacle
            raise obstacle or BadInput(f"{stage.name}: cannot be run")
        if decision.note is not None:
            raise BadInput(f"{stage.name} has to run ({reason}), but {decision.note.partition(';')[0]}. Put the source back, or undo the change.")
        for need in stage.needs:
            made = manifest.read_manifest(self.run.folder(need))
            found = artifact.differences(self.run.folder(need), made.outputs, self.hashes)
            if found.damaged:
                names = tuple(f"{need}/{name}" for name in found.damaged)
                raise CorruptArtifact(f"{stage.name} needs {need}, which is corrupt: {found.text()}. Make it anew: {until}", names)
        return decision.request

    def _failed(self, stage: Stage, place: Workplace, error: BaseException) -> NoReturn:
        """Clean up after a stage that raised, and raise the error for the user."""
        failure = interruption_in(error, self.stop()) or translated(error, stage.name, self.run.path)
        with contextlib.suppress(OSError):  # else the next start cleans up; the first error is the one to report
            if files.exists(place.out / manifest.NAME) or artifact.is_published(self.run.path, stage.name, place):
                self._recover()  # it was being published
            else:
                artifact.abandon(place, self.work)
        if isinstance(failure, Interrupted):
            raise failure from error
        with contextlib.suppress(OSError):  # of who takes the events
            self.emit("stage_failed", stage.name, text=str(failure), exit_code=failure.exit_code)
        if failure is error:
            raise error
        raise failure from error

    def _recover(self) -> list[str]:
        return artifact.recover(self.run.path, [stage.name for stage in self.stages])

    def _clear(self, stage: Stage, made: Manifest) -> None:
        place = artifact.workplace(self.run.path, stage.name, made.request)
        with contextlib.suppress(OSError):  # else the next start does
            if files.exists(place.folder):
                artifact.clear_published(self.run.path, place)

    def _interrupted(self, error: BaseException, stage: str, go_on: str) -> Interrupted:
        number = error.number if isinstance(error, Interrupted) else signal.SIGINT
        during = f" in {stage}" if stage else ""
        interrupted = Interrupted(number, f"interrupted by {signal.Signals(number).name}{during}; what is done is kept. Go on with: {go_on}")
        with contextlib.suppress(OSError):
            self.emit("interrupted", stage, text=str(interrupted), resume=go_on, exit_code=interrupted.exit_code)
        return interrupted

    def stopped(self) -> int | None:
        """The signal that arrived, or None. Raises RunLocked where the run is no longer ours."""
        self.run.check_held()
        return self.stop()

    def _is_to_stop(self) -> bool:
        try:
            self.safe_point()
        except PipelineError:  # it is raised once all have ended
            return True
        return False

    def safe_point(self) -> None:
        if (number := self.stopped()) is not None:
            raise Interrupted(number)

    def emit(self, event: str, stage: str, **facts: Any) -> None:
        _emit(self._report, event, stage, **facts)


def _ready(waiting: Sequence[Stage]) -> list[Stage]:
    """Those that need none of the others."""
    return [stage for stage in waiting if not {each.name for each in waiting} & set(stage.needs)]


def _one_at_a_time(report: Report) -> Report:
    """Stages that run at the same time report from several threads."""
    lock = threading.Lock()

    def reported(event: dict[str, Any]) -> None:
        with lock:
            report(event)

    return reported


def verify(run: Run, stages: Sequence[Stage], report: Report | None = None, *, altered: Sequence[str] = ()) -> list[Outcome]:
    """Read every file of every artifact and compare it with its manifest; returns an outcome with action "verified" for each artifact.

    altered  names of other files that were found to be not as written

    Takes no lock and writes nothing. A file too many is a warning. Raises CorruptArtifact that lists what is damaged, after all was read.
    """
    damaged = list(altered)
    outcomes = []
    for name in altered:
        _emit(report, "warning", "", text=f"{name} altered", state="corrupt")
    for stage in stages:
        folder = run.folder(stage.name)
        if not folder.exists():
            continue
        try:
            made = manifest.read_manifest(folder)
        except CorruptArtifact as error:
            damaged.extend(error.files or (stage.name,))
            _emit(report, "warning", stage.name, text=str(error), state="corrupt")
            continue
        found = artifact.differences(folder, made.outputs)
        if found.extra:
            text = f"{stage.name}: {artifact.listed(found.extra)} not written by it"
            _emit(report, "warning", stage.name, text=text, extra=list(found.extra))
        if found.damaged:
            damaged.extend(f"{stage.name}/{name}" for name in found.damaged)
            facts = {"altered": list(found.altered), "missing": list(found.missing)}
            _emit(report, "warning", stage.name, text=f"{stage.name}: {found.text()}", state="corrupt", **facts)
            continue
        _emit(report, "message", stage.name, text=f"{stage.name}: {len(made.outputs)} files as they were written", size=made.size)
        outcomes.append(_outcome(stage, "verified", None, made))
    if damaged:
        raise CorruptArtifact(f"{run.path}: {artifact.listed(damaged)} not as written. Make anew what is damaged: {run.how_to_resume()}", tuple(damaged))
    return outcomes


def refuse_what_cannot_work(stages: Sequence[Stage], run: Run, forced: Collection[str] = ()) -> None:
    """Raise the UsageError of a stage that cannot work with the settings of the run (`Stage.check`), unless it does not have to run."""
    if all(stage.check is None for stage in stages):
        return
    settings = settings_of(stages, run.settings)
    for stage in stages:
        try:
            if stage.check is not None:
                stage.check(settings)
        except UsageError:
            if any(decision.stage == stage.name and not decision.fresh for decision in survey(stages, run, forced=forced)):
                raise


def _outcome(stage: Stage, action: str, reason: str | None, made: Manifest) -> Outcome:
    return Outcome(stage.name, action, reason, made.seconds, made.size, made.digest)


def _emit(report: Report | None, event: str, stage: str, **facts: Any) -> None:
    if report is not None:
        report({**facts, "event": event, "stage": stage, "time": time.time()})


def _warn_of_stale_needs(run: Run, stages: Sequence[Stage], only: str, report: Report | None, hashes: Hashes) -> None:
    """Name each stage before a single one that is not up to date, but for what it needs and cannot run without."""
    direct = next(stage.needs for stage in stages if stage.name == only)
    for decision in survey(needed_by(stages, only), run, hashes=hashes):
        if not (decision.fresh or (decision.state == "missing" and decision.stage in direct)):
            text = f"{decision.stage} is {decision.state} ({decision.reason}); {only} uses what the run has. To bring all up to date: {run.how_to_resume()}"
            _emit(report, "warning", only, text=text, about=decision.stage, state=decision.state, reason=decision.reason)


def _plan(run: Run, chosen: Sequence[Stage], forced: frozenset[str], report: Report | None) -> list[Outcome]:
    """A dry run."""
    outcomes = []
    for decision in survey(chosen, run, forced=forced):
        action = "skipped" if decision.fresh else "may run" if _only_follows(decision) else "would run"
        text = f"{decision.stage}: up to date" if decision.fresh else f"{decision.stage}: {action} ({decision.reason})"
        _emit(report, "message", decision.stage, text=text, action=action, reason=decision.reason, state=decision.state)
        made = decision.manifest
        facts = (made.seconds, made.size, made.digest) if made is not None else ()
        outcomes.append(Outcome(decision.stage, action, decision.reason, *facts))
    return outcomes


def _only_follows(decision: Decision) -> bool:
    """Whether it is stale for no other reason than that a stage before it has to run."""
    made, request = decision.manifest, decision.request
    return decision.state == "stale" and decision.reason != "forced" and made is not None and request is not None and made.request == request
