"""Refuses runs with links, pipes, sockets or devices: a run that a stranger packed may hold them, to lead what opens its files elsewhere.

The engine writes and deletes within a run, and stages append to files of their scratch folders. One rule makes that safe: under the names that the
engine and its stages use, a run holds plain files and folders, and in its scratch folders no file has a second name (a hard link). Artifacts may have
such: they are replaced, never written in place (sharing.py). A run that breaks the rule is refused before anything in it is opened. The run's folder
itself, and what lies above it, may be reached by links.
"""

import os
import re
import stat
from collections.abc import Collection, Iterator
from pathlib import Path

from pipeline import files
from pipeline.errors import CorruptArtifact
from pipeline.failures import failed
from pipeline.text import printable

RUN = "run.json"
LOCK = ".lock"
HOLDER = ".lock.json"
WORK = ".work"
CACHE = ".cache"
LEASE = ".lease"
MAX_DEPTH = 200  # folders in folders; what deletes them goes down by recursion

_FILES = (RUN, LOCK, HOLDER)
_FOLDERS = (WORK, CACHE, LEASE)
_STAGE = re.compile(r"[a-z][a-z0-9_]*")  # the folder of an artifact has the name of its stage


def is_stage_name(name: str) -> bool:
    return _STAGE.fullmatch(name) is not None


def refuse_links(run: Path, stages: Collection[str] | None = None) -> None:
    """Raise CorruptArtifact if a run holds what is neither a file nor a folder under a name that is used; see `failed` where it cannot be listed.

    stages  names of the stages that the run may have; None: all that a stage could have. Other names are not checked

    Takes no lock: what another process removes meanwhile is not there.
    """
    try:
        for name, status in _used(run, stages):
            _check(run, name, status)
    except OSError as error:
        raise failed(run, error) from None


def _used(run: Path, stages: Collection[str] | None) -> Iterator[tuple[str, os.stat_result]]:
    """(name relative to the run, lstat) of all that the engine or a stage may open, write or delete."""
    own = (name for name in _names(run) if name in _FILES or name in _FOLDERS or (is_stage_name(name) if stages is None else name in stages))
    pending = [(name, 1) for name in own]
    while pending:
        name, depth = pending.pop()
        try:
            status = os.lstat(run / name)
        except FileNotFoundError:
            continue
        yield name, status
        if stat.S_ISDIR(status.st_mode):
            if depth == MAX_DEPTH:
                top = name.partition("/")[0]
                raise CorruptArtifact(f"{run}: {top} holds folders nested more than {MAX_DEPTH} deep. Remove it.", (top,))
            pending.extend((f"{name}/{each}", depth + 1) for each in _names(run / name))


def _names(folder: Path) -> list[str]:
    try:
        return os.listdir(folder)
    except FileNotFoundError:
        return []


def _check(run: Path, name: str, status: os.stat_result) -> None:
    shown, kind = printable(name, 200), files.kind_of(status.st_mode)
    if stat.S_ISDIR(status.st_mode):
        return
    if not stat.S_ISREG(status.st_mode):
        remedy = "Remove it, or put a copy of what it points to in its place." if stat.S_ISLNK(status.st_mode) else "Remove it."
        raise CorruptArtifact(f"{run}: {shown} is {kind}; a run holds plain files and folders, and nothing that leads out of it. {remedy}", (name,))
    if name in _FOLDERS:
        raise CorruptArtifact(f"{run}: {shown} is {kind}, expected a folder. Remove it.", (name,))
    if status.st_nlink > 1 and status.st_size and (name == LOCK or _may_be_appended_to(name)):
        text = f"{shown} is one file with another elsewhere (a hard link) that would be written with it"
        raise CorruptArtifact(f"{run}: {text}. Copy the run without hard links, or remove the file.", (name,))


def _may_be_appended_to(name: str) -> bool:
    """Whether it lies in a scratch folder: what else .work holds is an artifact on its way in, out or away; see artifact.py."""
    parts = name.split("/")
    if parts[0] != WORK or len(parts) < 2:
        return False
    return not (parts[1].startswith(("old-", "trash-")) or parts[3:4] == ["out"])
