"""Where compiled CPU kernels are kept: a private folder for what compiles them (versions, kind of machine), and in it one for each state of a module's sources.

    FOLDER/key()/MODULE/KEY    KEY stands for the module's source and for those of all modules of this package that it imports, directly or by others

numba compares the file of a cached function with the one it was compiled from, but not the files of the functions it calls, whose code it holds as well, nor
those of constants. Here a change to any of these leads to another KEY; what does not depend on it stays, and states of other versions or checkouts lie side by
side. Within a folder numba tells processors apart by name and features.

The first of these that can be written by the user alone is taken:

    $ENERF_CACHE_DIR/kernels
    $NUMBA_CACHE_DIR/efficientnerf   where that is set
    kernels in the user's cache folder (platformdirs: ~/.cache/efficientnerf on Linux)
    efficientnerf-UID in the folder for temporary files
    a new folder there, removed at exit

numba unpickles what it finds, so a folder that others could write to is never used.
"""

import atexit
import contextlib
import functools
import hashlib
import os
import platform
import re
import shutil
import stat
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import platformdirs

from efficientnerf.backends import Notice
from efficientnerf.backends.sources import Sources

ROOT = Path(__file__).resolve().parents[2]  # where the packages lie
KERNELS = "efficientnerf.backends.numba"  # the package that holds kernels
KEPT, UNUSED_DAYS = 8, 30  # folders of other keys: so many, unless used within a day; none that was not used for so many days
DAY = 86400.0
USUAL = 150  # functions that a run on the CPU compiles: 173 to 178 of three runs

SOURCES = Sources(ROOT)


@functools.cache
def key() -> str:
    """16 hexadecimal digits that stand for what compiles kernels."""
    python = f"{sys.implementation.cache_tag or sys.version} {sys.flags.optimize}"  # -O takes assertions out of kernels
    versions = (version("numba"), version("llvmlite"), version("numpy"), python, platform.machine())
    return hashlib.sha256("\n".join(versions).encode()).hexdigest()[:16]


@functools.cache
def folder() -> Path:
    """The folder for kernels of this key, made if need be. A RuntimeWarning says so where the preferred one cannot be used."""
    place, refusals = first_private(roots(), key())
    if place is None:
        place = Path(tempfile.mkdtemp(prefix="efficientnerf-kernels-"))
        atexit.register(shutil.rmtree, place, ignore_errors=True)
    for gone in place.iterdir():  # modules of other versions, which nothing else looks at
        if gone.is_dir() and not SOURCES.has(gone.name):
            _prune(gone, "")
    if refusals:
        warnings.warn(f"compiled kernels are kept in {place}; refused: {', '.join(refusals)}. ENERF_CACHE_DIR chooses a folder.", Notice, stacklevel=2)
    return place


@functools.cache
def folder_of(name: str, key: str) -> Path:
    """The folder of a key under a name, a module's or another, in `folder()`; made if need be. Removes those of other keys that are long out of use."""
    place = folder() / name / key
    with contextlib.suppress(OSError):  # whoever writes there sees to it
        place.mkdir(mode=0o700, parents=True, exist_ok=True)
        os.utime(place)
        _prune(place.parent, key)
    return place


def key_of_kernels() -> str:
    """16 hexadecimal digits that stand for the sources of all kernels."""
    return SOURCES.key(SOURCES.modules_below(KERNELS))


def are_compiled() -> bool:
    """Whether kernels of these sources are kept, about as many as a run uses. Writes nothing."""
    for root in roots():
        if (root / key()).is_dir():
            places = (root / key() / module / SOURCES.key([module]) for module in SOURCES.modules_below(KERNELS))
            return sum(1 for place in places for _ in place.glob("*.nbi")) >= USUAL
    return False


def first_private(roots: Iterable[Path], key: str) -> tuple[Path | None, list[str]]:
    """(the folder of a key under the first root that the user alone can write to, why those before were refused). Removes folders long out of use."""
    refusals = []
    for root in roots:
        place = root / key
        try:
            _make_private(root)
            _make_private(place)
            os.utime(place)
            _prune(root, key)
        except OSError as error:
            refusals.append(f"{root} ({error.strerror or error})")
        else:
            return place, refusals
    return None, refusals


def cache_folder() -> Path:
    """$ENERF_CACHE_DIR, else the user's cache folder. Raises RuntimeError where there is no home."""
    return Path(os.environ.get("ENERF_CACHE_DIR") or platformdirs.user_cache_dir("efficientnerf", appauthor=False)).absolute()


def roots() -> Iterator[Path]:
    """Folders that kernels may be kept in, the preferred first."""
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    if chosen and not os.environ.get("ENERF_CACHE_DIR"):
        yield Path(chosen).absolute() / "efficientnerf"
    else:
        yield cache_folder() / "kernels"
    yield Path(tempfile.gettempdir()).absolute() / (f"efficientnerf-{os.geteuid()}" if hasattr(os, "geteuid") else "efficientnerf")


def _make_private(place: Path) -> None:
    """Create a folder with mode 0700. Raises OSError where that fails, and PermissionError where others could write to it or replace it."""
    place.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    place.mkdir(mode=0o700, exist_ok=True)
    if hasattr(os, "geteuid"):
        found = place.lstat()
        if not stat.S_ISDIR(found.st_mode):
            raise PermissionError(f"{place} is a link")
        if found.st_uid != os.geteuid():
            raise PermissionError(f"{place} belongs to another user")
        if found.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
            raise PermissionError(f"others can write to {place}")
        for above in place.resolve().parents:
            if above.stat().st_uid not in (0, os.geteuid()):
                raise PermissionError(f"{above} belongs to another user")
            if above.stat().st_mode & stat.S_IWOTH and not above.stat().st_mode & stat.S_ISVTX:
                raise PermissionError(f"others can write to {above}")
    tempfile.TemporaryFile(dir=place).close()  # raises on a full or read-only disk


def _prune(root: Path, own: str) -> None:
    """Remove folders of other keys that have been out of use."""
    others = []
    for place in root.iterdir():
        if place.name != own and re.fullmatch(r"[0-9a-f]{16}", place.name):
            try:
                others.append((time.time() - place.stat().st_mtime, place))
            except FileNotFoundError:  # another process removes it too
                continue
    for rank, (age, place) in enumerate(sorted(others)):
        if age > UNUSED_DAYS * DAY or (rank >= KEPT and age > DAY):
            shutil.rmtree(place, ignore_errors=True)


@dataclass
class Compilation:
    """Kernels compiled since `compilation` was entered."""

    started: Callable[[], None]
    functions: int = 0
    seconds: float = 0.0


_watched: list[Compilation] = []


@contextlib.contextmanager
def compilation(started: Callable[[], None]) -> Iterator[Compilation]:
    """Count kernels that are compiled, rather than loaded, within; `started` is called before the first of them."""
    found = Compilation(started)
    _watched.append(found)
    try:
        yield found
    finally:
        _watched.remove(found)


def note_start() -> None:
    """A kernel is about to be compiled."""
    for each in _watched:
        if each.functions == 0:
            each.started()
        each.functions += 1


def note_end(seconds: float) -> None:
    """A kernel, and those it calls, were compiled."""
    for each in _watched:
        each.seconds += seconds
