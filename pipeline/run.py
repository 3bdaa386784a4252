"""The run folder: its source and settings, and its layout.

    RUN/run.json     {"format": "enerf-run", "version": 1, "source", "settings", "preset", "seed", "device", "created"}
    RUN/<stage>/     an artifact (artifact.py)
    RUN/.work/       what is being written
    RUN/.cache/      digests of files that have not changed since they were hashed; may be deleted at any time
    RUN/.lock        held while the run is written (lock.py)

Nothing in it but the source is an absolute path: a run may be moved or copied.
"""

from __future__ import annotations

import errno
import os
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from pipeline import files
from pipeline.errors import BadInput, CorruptArtifact, DiskFull
from pipeline.lock import HOLDER, LOCK, Holder, holder_of, lock

NAME = "run.json"
FORMAT = "enerf-run"
VERSION = 1
_CHANGEABLE = ("source", "settings", "preset", "seed", "device")


class ResumeText(Protocol):
    """What messages say of how to go on with a run: a workflow gives the command, the engine knows none.

    until        the last stage to run; None: all
    only         the one stage to run
    with_source  whether the source has to be named
    """

    def __call__(self, run: Path, *, until: str | None = None, only: str | None = None, with_source: bool = False) -> str: ...


def resume_in_words(run: Path, *, until: str | None = None, only: str | None = None, with_source: bool = False) -> str:
    """The ResumeText of a run that was given none."""
    what = f"the stage {only}" if only is not None else "the stages" if until is None else f"the stages until {until}"
    return f"run {what} of {run}" + (" with a source" if with_source else "")


@dataclass
class Run:
    """A run folder and its run.json. `Run(path, ...)` alone writes nothing: a planned run, for a dry run.

    path         absolute
    source       absolute, or None
    settings     stage -> the resolved values of its settings, plain JSON
    resume_text  how to go on with the run, for messages
    """

    path: Path
    source: Path | None = None
    settings: dict[str, dict[str, Any]] = field(default_factory=dict)
    preset: str | None = None
    seed: int | None = None
    device: str | None = None
    created: float = field(default_factory=time.time)
    resume_text: ResumeText = field(default=resume_in_words, repr=False, compare=False)
    _holds: int = field(default=0, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        self.path = _absolute(self.path)
        self.source = None if self.source is None else _absolute(self.source)

    @classmethod
    def create(cls, path: Path, source: Path | None = None, settings: dict[str, dict[str, Any]] | None = None, **more: Any) -> Run:
        """Make the folder and write run.json. Raises BadInput if something else is there, RunLocked while another creates it."""
        run = cls(path, source, settings or {}, **more)
        run.check_free()
        try:
            run.path.mkdir(parents=True, exist_ok=True)
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
    def open(cls, path: Path, resume_text: ResumeText = resume_in_words) -> Run:
        """Read run.json. Raises BadInput if it is no run or one of a newer format, CorruptArtifact if it is damaged."""
        path = _absolute(path)
        if not path.is_dir():
            raise BadInput(f"{path}: {'is not a folder' if files.exists(path) else 'no such folder'}. Give the folder of a run.")
        try:
            value = files.read_json(path / NAME, limit=16 * 2**20)
        except FileNotFoundError:
            raise BadInput(f"{path}: is not a run (it has no {NAME}).") from None
        except files.Unreadable as error:
            raise CorruptArtifact(f"{path / NAME}: {error}. Restore it, or start a new run.", (NAME,)) from None
        return cls(path, **_checked(path / NAME, value), resume_text=resume_text)

    def update(self, **changes: Any) -> None:
        """Change source, settings (all of them), preset, seed or device, and write run.json if that makes a difference."""
        unknown = sorted(changes.keys() - set(_CHANGEABLE))
        if unknown:
            raise TypeError(f"a run has no {unknown[0]!r} to change")
        former = {name: getattr(self, name) for name in changes}
        before = self.plain()
        self._set(changes)
        if self.plain() == before:
            return
        try:
            with self.locked():
                self._save()
        except BaseException:
            self._set(former)
            raise

    def folder(self, stage: str) -> Path:
        return self.path / stage

    @property
    def cache(self) -> Path:
        """The file that remembers digests."""
        return self.path / ".cache" / "hashes.json"

    def how_to_resume(self, *, until: str | None = None, only: str | None = None, with_source: bool = False) -> str:
        """How to go on with this run; see ResumeText."""
        return self.resume_text(self.path, until=until, only=only, with_source=with_source)

    def holder(self) -> Holder | None:
        """Who is writing the run, for messages; takes no lock."""
        return holder_of(self.path)

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Hold the lock; may be nested. Raises RunLocked if another process holds it."""
        if self._holds:
            self._holds += 1
            try:
                yield
            finally:
                self._holds -= 1
            return
        with lock(self.path):
            self._holds = 1
            for name in (NAME, HOLDER):  # what a kill left of writing these
                files.remove_temporaries(self.path / name)
            try:
                yield
            finally:
                self._holds = 0

    def plain(self) -> dict[str, Any]:
        """What run.json holds."""
        return {
            "format": FORMAT,
            "version": VERSION,
            "source": None if self.source is None else str(self.source),
            "settings": self.settings,
            "preset": self.preset,
            "seed": self.seed,
            "device": self.device,
            "created": self.created,
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


def disk_full(folder: Path, what: str) -> DiskFull:
    """The error that names the disk that is full and the space left on it."""
    there = next((path for path in (folder, *folder.parents) if path.is_dir()), Path("/"))
    free = shutil.disk_usage(there).free / 2**20
    return DiskFull(f"{what}: no space (or quota) left in {there} ({free:.1f} MiB free). Make room and go on; what was published before is not lost.")


def is_disk_full(error: BaseException) -> bool:
    return isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT)


def cannot_write(path: Path, error: OSError) -> BadInput | DiskFull:
    """What to raise where a file of a run could not be written."""
    if is_disk_full(error):
        return disk_full(path, str(path))
    return BadInput(f"{path}: cannot be written ({error.strerror or error}).")


def _is_ours(name: str) -> bool:
    """Whether a kill while a run was created may have left a file of this name."""
    return name in (LOCK, HOLDER) or files.is_temporary(name, NAME) or files.is_temporary(name, HOLDER)


def _absolute(path: Path) -> Path:
    return Path(os.path.abspath(path))


def _checked(path: Path, value: Any) -> dict[str, Any]:
    """The fields of a run.json that anybody may have written."""
    if not isinstance(value, dict) or value.get("format") != FORMAT:
        raise BadInput(f"{path}: not of a run (expected format {FORMAT!r}).")
    version = value.get("version")
    if type(version) is int and version > VERSION:
        raise BadInput(f"{path}: made by a newer version: run format {version}; this build reads {VERSION}. Upgrade efficientnerf.")
    settings = value.get("settings", {})
    good = {
        "version": version == VERSION and type(version) is int,
        "source": isinstance(value.get("source"), str | None) and "\0" not in (value.get("source") or ""),
        "settings": isinstance(settings, dict) and all(isinstance(of_stage, dict) for of_stage in settings.values()),
        "preset": isinstance(value.get("preset"), str | None),
        "seed": type(value.get("seed")) in (int, type(None)),
        "device": isinstance(value.get("device"), str | None),
        "created": type(value.get("created", 0.0)) in (int, float) and abs(value.get("created", 0.0)) < 1e15,
    }
    for name, is_good in good.items():
        if not is_good:
            raise CorruptArtifact(f"{path}: {name} is {value.get(name)!r:.60}. Restore the file, or start a new run.", (NAME,))
    source = value.get("source")
    return {
        "source": None if source is None else Path(source),
        "settings": settings,
        "preset": value.get("preset"),
        "seed": value.get("seed"),
        "device": value.get("device"),
        "created": float(value.get("created", 0.0)),
    }
