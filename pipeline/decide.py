"""Whether a stage has to run, and why. No side effects on the run or the source.

missing  never run
fresh    nothing to do
stale    made by another request: other settings, other inputs, another version
partial  work on the present request was cut short; the published artifact, if any, is of another request
corrupt  the files are not those that were written
"""

import os
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pipeline import artifact, files, manifest
from pipeline.errors import BadInput, CorruptArtifact, Interrupted, PipelineError, UsageError
from pipeline.hashes import Hashes
from pipeline.manifest import ABSENT, Manifest, Request
from pipeline.run import Run
from pipeline.stage import Stage, hints_of, settings_dict, settings_from
from pipeline.text import printable, suggestion

_CHANGES_SHOWN = 4


@dataclass(frozen=True)
class Decision:
    """The state of one stage."""

    stage: str
    state: str  # fresh, stale, missing, partial or corrupt
    reason: str | None  # why it has to run; None if and only if fresh
    note: str | None = None  # a remark for the user
    request: Request | None = None  # of a run of the stage now; None where `obstacle` prevents that it is determined
    obstacle: PipelineError | None = None
    manifest: Manifest | None = None  # of the published artifact, if it can be read
    extra: tuple[str, ...] = ()  # files in its folder that it did not write

    @property
    def fresh(self) -> bool:
        return self.state == "fresh"


def selection(stages: Sequence[Stage], *, until: str | None, start: str | None, only: str | None, force: bool) -> tuple[list[Stage], frozenset[str]]:
    """(the stages to consider, the names of those to run even if fresh)."""
    names = [stage.name for stage in stages]
    for name in (until, start, only):
        if name is not None and name not in names:
            raise UsageError(f"{name}: no such stage. {suggestion(name, names)}")
    if only is not None:
        if until is not None or start is not None:
            raise UsageError("a single stage goes together with neither a first nor a last one")
        return [stages[names.index(only)]], frozenset([only] if force else [])
    last = len(names) - 1 if until is None else names.index(until)
    first = last + 1 if start is None else names.index(start)
    if start is not None and first > last:
        raise UsageError(f"nothing to do from {start} until {until}: {until} comes first")
    return list(stages[: last + 1]), frozenset(names[: last + 1] if force else names[first : last + 1])


def needed_by(stages: Sequence[Stage], name: str) -> list[Stage]:
    """The stages that this one needs, and those that they need, in order."""
    needed: set[str] = set()
    for stage in reversed(stages):  # each comes after those that it needs
        if stage.name == name or stage.name in needed:
            needed.update(stage.needs)
    return [stage for stage in stages if stage.name in needed]


def survey(stages: Sequence[Stage], run: Run, *, forced: Collection[str] = (), hashes: Hashes | None = None) -> list[Decision]:
    """A decision for each stage, in order. One that needs a stage which has to run is stale, too; it may yet turn out fresh.

    forced  names of stages that are stale in any case
    """
    hashes = hashes or Hashes(run.cache)
    found: dict[str, Decision] = {}
    for stage in stages:
        decision = decide(stage, run, hashes)
        if decision.fresh and stage.name in forced:
            decision = replace(decision, state="stale", reason="forced")
        pending = [found[need] for need in stage.needs if need in found and not found[need].fresh]
        if decision.fresh and pending:
            reason = "inputs changed: " + ", ".join(f"{before.stage} is {before.state}" for before in pending)
            decision = replace(decision, state="stale", reason=reason)
        found[stage.name] = decision
    return list(found.values())


def decide(stage: Stage, run: Run, hashes: Hashes | None = None) -> Decision:
    """The decision about one stage. Raises UsageError if the run's settings of the stage are invalid."""
    hashes = hashes or Hashes(run.cache)
    folder = run.folder(stage.name)
    recorded, damage = _recorded(folder, stage)
    request, obstacle, note = _request(stage, run, recorded, hashes)

    def decision(state: str, reason: str | None, extra: tuple[str, ...] = ()) -> Decision:
        return Decision(stage.name, state, reason, note, request, obstacle, recorded, extra)

    if damage is not None:
        return decision("corrupt", damage)
    if recorded is None:
        return decision(*(_cut_short(stage, run, request) or ("missing", "never run")))
    found = artifact.differences(folder, recorded.outputs, hashes)
    changes = _changes(recorded.request, request, obstacle)
    if found.damaged:
        return decision("corrupt", "; ".join([f"output altered on disk: {found.text()}", *changes]), found.extra)
    if not changes:
        return decision("fresh", None, found.extra)
    state, reason = _cut_short(stage, run, request) or ("stale", "")
    return decision(state, "; ".join([reason, *changes] if reason else changes), found.extra)


def _recorded(folder: Path, stage: Stage) -> tuple[Manifest | None, str | None]:
    """The manifest of the published artifact, or what is wrong with it."""
    if not files.exists(folder):
        return None, None
    if not files.is_folder(folder):
        return None, "it is no folder"
    try:
        recorded = manifest.read_manifest(folder)
    except CorruptArtifact as error:
        return None, f"manifest unreadable: {error}"
    if recorded.request.stage != stage.name:
        return None, f"manifest unreadable: it is of the stage {recorded.request.stage!r:.40}"
    return recorded, None


def _cut_short(stage: Stage, run: Run, request: Request | None) -> tuple[str, str] | None:
    """State and reason if there is unfinished work on this request."""
    if files.exists(run.path / artifact.WORK / f"old-{stage.name}") and not files.exists(run.folder(stage.name)):
        return "partial", "incomplete: its replacement was cut short; the next run completes it"
    if request is None:
        return None
    place = artifact.workplace(run.path, stage.name, request)
    if not place.folder.is_dir():
        return None
    if files.exists(place.out / manifest.NAME):
        return "partial", "incomplete: done, but cut short before it was published"
    has_scratch = place.scratch.is_dir() and not files.is_empty(place.scratch)
    return "partial", "incomplete: cut short; it goes on where it stopped" if has_scratch else "incomplete: cut short; it starts anew"


def _request(stage: Stage, run: Run, recorded: Manifest | None, hashes: Hashes) -> tuple[Request | None, PipelineError | None, str | None]:
    """(the request of a run now, or None; then the error that prevents it; a note)."""
    known = hints_of(stage.settings)  # a run of another version may have more: `enerf run` leaves those out, with a warning
    settings: Any = settings_from(stage.settings, {name: value for name, value in run.settings.get(stage.name, {}).items() if name in known}, where=stage.name)
    inputs = {}
    for need in stage.needs:
        try:
            inputs[need] = manifest.read_manifest(run.folder(need)).digest
        except CorruptArtifact as error:
            if files.exists(run.folder(need)):
                return None, CorruptArtifact(f"{stage.name} needs {need}, which is corrupt ({error}).", error.files), None
            return None, BadInput(f"{stage.name} needs {need}, which this run does not have."), None
    source, note = None, None
    if stage.reads_source:
        former = None if recorded is None else recorded.request.source
        try:
            source, note = _source(stage, run, settings, former, hashes)
        except Interrupted:
            raise
        except PipelineError as error:
            return None, error, None
    return Request(stage.name, stage.version, settings_dict(settings), inputs, source), None, note


def _source(stage: Stage, run: Run, settings: Any, former: dict[str, str] | None, hashes: Hashes) -> tuple[dict[str, str], str | None]:
    """Digests of the files of the source by path relative to it, of several by name and path, and a note. Raises BadInput if one cannot be used."""
    gone = next((source for source in run.sources.values() if _is_gone(source)), None)
    if run.source is None or gone is not None:
        what = "the run names no source" if gone is None else f"{gone} is not there, or empty"
        if former is not None:
            return former, f"{what}; {stage.name} stays as it was made"
        raise BadInput(f"{stage.name} needs the source: {what}. Name it: {run.how_to_resume(with_source=True)}")
    prefix, digests = f"source of {stage.name}:", {}
    for called, source in run.sources.items():
        base = source if source.is_dir() else source.parent
        try:
            for path in _source_files(stage, source, settings):
                name = Path(called, os.path.relpath(path, base)).as_posix()
                digests[name] = hashes.digest(f"{prefix}{name}", path) if path.is_file() else ABSENT
        except (OSError, ValueError) as error:
            raise BadInput(f"{source}: cannot be read ({printable(error, 300)})") from error
    hashes.forget(prefix, {prefix + name for name in digests})
    return dict(sorted(digests.items())), None


def _is_gone(source: Path) -> bool:
    """An empty folder counts as gone: it may be the mount point of a disk that is not mounted."""
    try:
        return not source.exists() or (source.is_dir() and files.is_empty(source))
    except OSError:
        return True


def _source_files(stage: Stage, source: Path, settings: Any) -> list[Path]:
    if stage.source_files is not None:
        return stage.source_files(source, settings)
    return [source / name for name, _ in files.walk(source)] if source.is_dir() else [source]


def _changes(old: Request, new: Request | None, obstacle: PipelineError | None) -> list[str]:
    """In words, what differs between two requests."""
    if new is None:
        return [f"inputs changed: {obstacle}"]
    changes = []
    if old.version != new.version:
        changes.append(f"version changed: {old.version} -> {new.version}")
    if old.settings != new.settings:
        changes.append("settings changed: " + _settings_changes(old.settings, new.settings))
    inputs = [need for need in sorted(old.inputs.keys() | new.inputs.keys()) if old.inputs.get(need) != new.inputs.get(need)]
    if inputs:
        changes.append("inputs changed: " + ", ".join(inputs))
    if old.source != new.source:
        changes.append("inputs changed: " + _source_changes(old.source or {}, new.source or {}))
    return changes


def _settings_changes(old: dict[str, Any], new: dict[str, Any]) -> str:
    changed = [name for name in sorted(old.keys() | new.keys()) if old.get(name, ...) != new.get(name, ...)]
    texts = [f"{name} {_value(old.get(name, ...))} -> {_value(new.get(name, ...))}" for name in changed[:_CHANGES_SHOWN]]
    more = len(changed) - _CHANGES_SHOWN
    return ", ".join(texts) + (f" and {more} more" if more > 0 else "")


def _value(value: Any) -> str:
    if value is ...:
        return "(not there)"
    text = files.canonical_json(value).decode("ascii")
    return text if len(text) <= 60 else text[:57] + "..."


def _source_changes(old: dict[str, str], new: dict[str, str]) -> str:
    """ "3 source files (1 changed: a.jpg; 1 new: b.jpg; 1 gone: c.jpg)"."""
    kinds = {
        "changed": [name for name in sorted(old.keys() & new.keys()) if old[name] != new[name]],
        "new": sorted(new.keys() - old.keys()),
        "gone": sorted(old.keys() - new.keys()),
    }
    count = sum(map(len, kinds.values()))
    parts = [f"{len(names)} {kind}: {artifact.listed(names)}" for kind, names in kinds.items() if names]
    return f"{count} source file{'s' if count != 1 else ''} ({'; '.join(parts)})"
