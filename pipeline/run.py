"""The run folder: its source and settings, and its layout.

    RUN/run.json     {"format": "enerf-run", "version": 1, "source", "also", "settings", "preset", "seed", "device", "memory", "viewer", "created"}
    RUN/<stage>/     an artifact (artifact.py)
    RUN/.work/       what is being written
    RUN/.cache/      digests of files that have not changed since they were hashed; may be deleted at any time
    RUN/.lock        held while the run is written (locks/lock.py)
    RUN/.lease/      the same for other machines (locks/lease.py)

Nothing in it but the sources is an absolute path: a run may be moved or copied.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import msgspec

from pipeline import files
from pipeline.errors import BadInput, CorruptArtifact, RunLocked
from pipeline.executors.memory import NO_LIMIT
from pipeline.failures import cannot_write, failed
from pipeline.links import CACHE, HOLDER, LEASE, LOCK, RUN, refuse_links
from pipeline.locks.lease import Lease
from pipeline.locks.lock import lock
from pipeline.text import printable

NAME = RUN
FORMAT = "enerf-run"
VERSION = 1
MOST_SOURCES = 100
_ABANDONED = 24 * 3600.0  # seconds after which no process still writes to a temporary file, such as that of a report
_Path = Annotated[str, msgspec.Meta(max_length=4096)]
_Word = Annotated[str, msgspec.Meta(max_length=200)]


class _Document(msgspec.Struct):
    """run.json, untrusted. Settings are checked by the stages that have them."""

    source: _Path | None = None
    also: Annotated[list[_Path], msgspec.Meta(max_length=MOST_SOURCES)] = []
    settings: dict[str, dict[str, Any]] = {}
    preset: _Word | None = None
    seed: Annotated[int, msgspec.Meta(ge=-(2**63), le=2**63 - 1)] | None = None
    device: _Word | None = None
    memory: Annotated[int, msgspec.Meta(ge=1, le=NO_LIMIT)] | None = None
    viewer: _Word | None = None
    created: Annotated[float, msgspec.Meta(gt=-1e15, lt=1e15)] = 0.0


@dataclass(frozen=True)
class Resumption:
    """How a run is resumed."""

    until: str | None = None  # the last stage to run; None: all
    start: str | None = None  # the first stage to run even if it is up to date; None: none
    only: str | None = None  # the one stage to run
    force: bool = False  # whether that one is to run even if it is up to date
    with_source: bool = False  # whether the source has to be given


ResumeText = Callable[[Path, Resumption], str]  # how to resume the run in a folder, for messages: a workflow gives the command, the engine knows none


def resume_in_words(run: Path, how: Resumption) -> str:
    """The ResumeText of a run that was given none."""
    some = (f" from {how.start}" if how.start else "") + (f" until {how.until}" if how.until else "")
    what = f"the stages{some}" if how.only is None else f"the stage {how.only}"
    return f"run {what} of {run}" + (", forced" if how.force else "") + (" with a source" if how.with_source else "")


@dataclass
class Run:
    """A run folder and its run.json. `Run(path, ...)` alone writes nothing: a planned run, for a dry run."""

    path: Path  # absolute
    source: Path | None = None  # absolute, or None
    settings: dict[str, dict[str, Any]] = field(default_factory=dict)  # stage -> the resolved values of its settings, plain JSON
    preset: str | None = None
    seed: int | None = None
    device: str | None = None
    memory: int | None = None  # bytes that stages may take; None: what the machine has
    viewer: str | None = None  # what its page in a browser shows; None: what there is
    also: tuple[Path, ...] = ()  # further sources, absolute: of one scene, together with the first
    created: float = field(default_factory=time.time)
    resume_text: ResumeText = field(default=resume_in_words, repr=False, compare=False)  # how to go on with the run, for messages
    stages: frozenset[str] | None = field(default=None, repr=False, compare=False)  # names of the stages that it may have, see `refuse_links`
    _lease: Lease | None = field(default=None, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        self.path = _absolute(self.path)
        self.source = None if self.source is None else _absolute(self.source)
        self.also = tuple(_absolute(path) for path in self.also)

    @classmethod
    def create(cls, path: Path, source: Path | None = None, settings: dict[str, dict[str, Any]] | None = None, **more: Any) -> Run:
        """Make the folder and write run.json. Raises BadInput if something else is there, RunLocked while another creates it."""
        run = cls(path, source, settings or {}, **more)
        run.check_free()
        try:
            _make_folder(run.path)
        except OSError as error:
            raise cannot_write(run.path, error) from None
        with run.locked():
            run.check_free()  # another may have been quicker
            run._save()
        return run

    def check_free(self) -> None:
        """Raise BadInput unless a run may be created here: nothing, or an empty folder."""
        if not files.exists(self.path):
            return
        if not self.path.is_dir():
            raise BadInput(f"{self.path}: exists and is not a folder. Give a new folder for the run.")
        found = sorted(entry.name for entry in os.scandir(self.path) if not _is_ours(entry.name))
        if NAME in found:
            raise BadInput(f"{self.path}: is a run already. Go on with it ({self.how_to_resume()}), or give a new folder.")
        if found:
            raise BadInput(f"{self.path}: exists and is not a run (no {NAME}; it holds {found[0]!r}). Give a new or an empty folder.")

    @classmethod
    def open(cls, path: Path, resume_text: ResumeText = resume_in_words, stages: frozenset[str] | None = None) -> Run:
        """Read run.json. Raises BadInput if it is no run or one of a newer format, CorruptArtifact if it is damaged or the run holds links."""
        path = _absolute(path)
        if not path.is_dir():
            raise BadInput(f"{path}: {'is not a folder' if files.exists(path) else 'no such folder'}. Give the folder of a run.")
        if not files.exists(path / NAME):
            raise _no_run(path)  # and nothing in it is read
        refuse_links(path, stages)
        return cls(path, **_recorded(path), resume_text=resume_text, stages=stages)

    def update(self, **changes: Any) -> None:
        """Change source, further sources, settings (all of them), preset, seed, device, memory or viewer, and write run.json if that makes a difference.

        What is not changed is as another process may have left it. What is read first, and changed for that, is read in `locked`.
        """
        with self.locked():
            before = self.plain()
            self._set(changes)
            if self.plain() != before:
                self._save()

    @property
    def sources(self) -> dict[str, Path]:
        """All sources by name, none where there is none; see `named`."""
        return {} if self.source is None else named([self.source, *self.also])

    def folder(self, stage: str) -> Path:
        return self.path / stage

    @property
    def cache(self) -> Path:
        """The file that remembers digests."""
        return self.path / CACHE / "hashes.json"

    def how_to_resume(self, **how: Any) -> str:
        """How to go on with this run, for messages; `how` has the fields of Resumption."""
        return self.resume_text(self.path, Resumption(**how))

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Hold the lock; may be nested. Source, settings and the rest are read anew: another process may have changed them since.

        Raises RunLocked if another process holds it, CorruptArtifact if the run holds links.
        """
        if self._lease is not None:
            yield
            return
        refuse_links(self.path, self.stages)  # before the lock's file is opened
        with lock(self.path) as self._lease:
            try:
                self._clear_temporaries()
                if files.exists(self.path / NAME):
                    self._set(_recorded(self.path))
                yield
            finally:
                self._lease = None

    def check_held(self) -> None:
        """Raise RunLocked where the lock that this process held was taken over: a machine may sleep, or lose the file server for a while."""
        why = None if self._lease is None else self._lease.lost()
        if why is not None:
            raise RunLocked(f"{self.path}: no longer this process's to write: {why}. What is done is kept. Go on with: {self.how_to_resume()}")

    def _clear_temporaries(self) -> None:
        """Remove files outside of artifacts that killed writers left; those that cannot be removed do no harm."""
        with contextlib.suppress(OSError):
            files.remove_temporaries(self.path, NAME, HOLDER)
            files.remove_temporaries(self.path, seconds=_ABANDONED)
            files.remove_temporaries(self.cache.parent, self.cache.name)

    def plain(self) -> dict[str, Any]:
        """What run.json holds."""
        return {
            "format": FORMAT,
            "version": VERSION,
            "source": None if self.source is None else str(self.source),
            **({"also": [str(path) for path in self.also]} if self.also else {}),
            **{name: getattr(self, name) for name in ("settings", "preset", "seed", "device", "memory", "created")},
            **({"viewer": self.viewer} if self.viewer else {}),
        }

    def _set(self, values: dict[str, Any]) -> None:
        for name, value in values.items():
            setattr(self, name, value)
        self.__post_init__()

    def _save(self) -> None:
        try:
            files.write_atomically(self.path / NAME, files.pretty_json(self.plain()))
        except OSError as error:
            raise cannot_write(self.path, error) from None


def named(sources: Sequence[Path]) -> dict[str, Path]:
    """Sources by name: "" for one alone; else the name of the folder or file, with a number where another has it."""
    if len(sources) == 1:
        return {"": sources[0]}
    found: dict[str, Path] = {}
    for path in sources:
        plain = printable(path.name or "source")
        name, again = plain, 2
        while name in found:
            name, again = f"{plain} ({again})", again + 1
        found[name] = path
    return found


def _make_folder(path: Path) -> None:
    """With those above it, durable."""
    made = [folder for folder in (path, *path.parents) if not folder.exists()]
    path.mkdir(parents=True, exist_ok=True)
    for folder in made:
        with contextlib.suppress(PermissionError):  # a folder that may be written but not read cannot be opened
            files.sync_folder(folder.parent)


def _is_ours(name: str) -> bool:
    """Whether a kill while a run was created may have left a file of this name."""
    return name in (LOCK, HOLDER, LEASE) or files.is_temporary(name, NAME, HOLDER)


def _absolute(path: Path) -> Path:
    return Path(os.path.abspath(path))


def _no_run(path: Path) -> BadInput:
    return BadInput(f"{path}: is not a run (it has no {NAME}).")


def _recorded(run: Path) -> dict[str, Any]:
    """What run.json holds, checked."""
    path = run / NAME
    try:
        value = files.read_json(path, limit=16 * 2**20, follow=False)
    except FileNotFoundError:
        raise _no_run(run) from None
    except files.Unreadable as error:
        if error.denied is not None:
            raise failed(run, error.denied) from None
        raise CorruptArtifact(f"{path}: {error}. Restore it, or start a new run.", (NAME,)) from None
    if not isinstance(value, dict) or value.get("format") != FORMAT:
        raise BadInput(f"{path}: not of a run (expected format {FORMAT!r}).")
    version = value.get("version")
    if type(version) is int and version > VERSION:
        raise BadInput(f"{path}: made by a newer version: run format {version!r:.20}; this build reads {VERSION}. Upgrade efficientnerf.")
    try:
        if version != VERSION or type(version) is not int:
            raise ValueError(f"version is {version!r:.60}")
        document = msgspec.convert(value, _Document)
        paths = [each for each in (document.source, *document.also) if each is not None]
        if any("\0" in each or not os.path.isabs(os.fsencode(each)) for each in paths):
            raise ValueError("source, also: expected absolute paths")
    except (ValueError, OverflowError) as error:  # a path that no file system can name is a ValueError, too
        raise CorruptArtifact(f"{path}: {printable(error, 300)}. Restore the file, or start a new run.", (NAME,)) from None
    source = None if document.source is None else Path(document.source)
    return {**msgspec.structs.asdict(document), "source": source, "also": tuple(map(Path, document.also))}
