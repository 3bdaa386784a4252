"""Ways in which a file of a scratch folder may be found after a power cut, or from someone else."""

import os
from collections.abc import Callable
from pathlib import Path


def _rewritten(change: Callable[[bytes], bytes]) -> Callable[[Path], None]:
    def spoil(path: Path) -> None:
        data = path.read_bytes()
        path.unlink()
        path.write_bytes(change(data))

    return spoil


def _pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def _link(path: Path) -> None:
    path.unlink()
    path.symlink_to("/dev/zero")


SPOILERS: dict[str, Callable[[Path], None]] = {
    "empty": _rewritten(lambda data: b""),
    "cut": _rewritten(lambda data: data[: len(data) // 2]),
    "zero": _rewritten(lambda data: bytes(len(data))),
    "half zero": _rewritten(lambda data: data[: len(data) // 2] + bytes(len(data) - len(data) // 2)),
    "text": _rewritten(lambda data: b'{"value": 1' + b"0" * 400 + b"}\n"),
    "pipe": _pipe,
    "link": _link,
}
