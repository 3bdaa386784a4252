"""Cameras of photographs: structure from motion in a process of its own (`stages.sfm.process`), and what passes to it and back."""

from __future__ import annotations

import base64
import contextlib
import fcntl
import os
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Unpack

import msgspec
import numpy as np

from stages.io.capture import Capture
from stages.sfm import process
from stages.sfm.database import database_path, remove_database
from stages.sfm.images import Callables
from stages.sfm.reconstruction import Request, reconstruct

WAIT = 0.05  # seconds between two checks of a lock


def find_cameras(request: Request, **callables: Unpack[Callables]) -> Capture:
    """Find the pose and the intrinsics of each photograph's camera: a Capture of kind "photographs"; those that were not registered are in `rejected`, with the
    reason.

    It is done in a process of its own (`stages.sfm.process`), whose callables are called here.

    Raises BadInput where fewer than 3 or less than half of the photographs are registered, StageFailed where the process aborts.
    """
    resumed = database_path(request.work).exists()
    try:
        return msgspec.convert(process.run(_plain(request), **callables), Capture, dec_hook=_from_plain)
    except process.ChildAborted:
        if resumed:  # leftovers of an earlier attempt may be what COLMAP cannot bear
            remove_database(database_path(request.work))
        raise


def capture_for(arguments: Mapping[str, Any], **callables: Unpack[Callables]) -> dict[str, Any]:
    """`reconstruct` for a request that has come through JSON; the capture as JSON can hold it, bit for bit."""
    request = msgspec.convert(arguments, Request, dec_hook=_from_plain, str_keys=True)  # numbers of markers
    with _alone(request.work, callables["safe_point"]):
        return _plain(reconstruct(request, **callables))


def _plain(value: object) -> dict[str, Any]:
    """A dataclass as JSON can hold it: arrays by their bytes."""

    def plain(part: Any) -> Any:
        if isinstance(part, np.ndarray):
            return part.dtype.str, part.shape, base64.b64encode(np.ascontiguousarray(part).tobytes()).decode()
        return part.item() if isinstance(part, np.generic) else str(part)

    return dict(msgspec.to_builtins(value, enc_hook=plain))


def _from_plain(kind: Any, value: Any) -> Any:
    """What `_plain` made of an array or a path."""
    if kind is np.ndarray:
        dtype, shape, data = value
        return np.frombuffer(base64.b64decode(data), dtype).reshape(shape).copy()
    return Path(value) if kind is Path else value


@contextlib.contextmanager
def _alone(work: Path, safe_point: Callable[[], None]) -> Iterator[None]:
    """Wait until the process of a run that was killed, which ends a moment after it, writes into the scratch folder no more."""
    work.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(work, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        while True:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                safe_point()
                time.sleep(WAIT)
            except OSError:  # a file system without locks
                break
        yield
    finally:
        os.close(descriptor)
