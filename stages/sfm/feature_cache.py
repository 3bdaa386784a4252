"""A cache of features, shared by all runs. The key is the content of a photograph's copy, of its mask, and COLMAP's options.

One file an image, in `$ENERF_CACHE_DIR/features`, else in `features` of the user's cache folder, in a folder for the build of pycolmap: the SHA-256 of the
rest, and the rows of COLMAP's database without the image's number, as MessagePack. The least recently used are removed beyond $ENERF_FEATURE_CACHE_MIB, 1024
without; 0 keeps none. Features are detected where there can be no such folder, or a file of it is damaged.
"""

import contextlib
import functools
import hashlib
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec

from efficientnerf.backends.kernel_cache import cache_folder, first_private
from pipeline.files import open_plain, remove, write_atomically
from stages.sfm.colmap import import_pycolmap
from stages.sfm.database import FEATURES, Row, insert_features, rows_of

LAYOUT = 1  # of the files; raise it when what is written there, or how features are detected, changes meaning
MAX_MIB = 1024  # MiB of all files
MAX_FILE = 2**28  # bytes
SUFFIX = ".features"


def max_bytes() -> int:
    """Of all files."""
    chosen = os.environ.get("ENERF_FEATURE_CACHE_MIB", "")
    return (int(chosen) if chosen.isdecimal() else MAX_MIB) * 2**20


@functools.cache
def folder() -> Path | None:
    """The folder of the files, made if need be; None where none are kept, or where no folder is writable by the user alone."""
    if not max_bytes():
        return None
    pycolmap = import_pycolmap()
    try:
        return first_private([cache_folder() / "features"], _sha256(f"{LAYOUT} {pycolmap.__version__} {pycolmap.COLMAP_build}".encode())[:16])[0]
    except RuntimeError:  # no home
        return None


def keys_of(place: Path, files: Sequence[str], asked: Mapping[str, object]) -> dict[str, str]:
    """The key of each copy.

    place  that `images` and `masks` are in
    """
    wanted = repr(sorted(asked.items())).encode()
    keys = {}
    for file in files:
        mask = place / "masks" / f"{file}.png"
        parts = [hashlib.sha256(path.read_bytes()).digest() if path.exists() else b"" for path in (place / "images" / file, mask)]
        keys[file] = _sha256(b"\n".join([*parts, wanted]))
    return keys


def take(database: Path, wanted: Mapping[int, str]) -> list[int]:
    """Put the features that are there into COLMAP's database, which has none of these images; the ids of those images, in order.

    wanted  key of each image by its id
    """
    found = []
    if (cache := folder()) is not None:
        for image, key in sorted(wanted.items()):
            if (rows := _read(cache / f"{key}{SUFFIX}")) is not None and insert_features(database, image, rows):
                found.append(image)
    return found


def put(database: Path, made: Mapping[int, str]) -> None:
    """Keep the features of these images; silent where there is no space.

    made  key of each image by its id
    """
    if (cache := folder()) is None:
        return
    try:
        for image, rows in rows_of(database, FEATURES, made):
            data = msgspec.msgpack.encode(rows)
            write_atomically(cache / f"{made[image]}{SUFFIX}", hashlib.sha256(data).digest() + data, durable=False)
        # Remove the least recently used files beyond the limit.
        kept, most, listed = 0, max_bytes(), []
        for path in cache.glob(f"*{SUFFIX}"):
            with contextlib.suppress(FileNotFoundError):  # another process has removed it
                about = path.lstat()
                listed.append((about.st_mtime, about.st_size, path))
        for _, size, path in sorted(listed, reverse=True):
            kept += size
            if kept > most:
                with contextlib.suppress(OSError):
                    remove(path)
    except OSError:
        return


def _read(path: Path) -> list[Row] | None:
    """The rows of a file; None where it is not there, or not as it was written."""
    try:
        with open(open_plain(path, follow=False), "rb") as file:
            whole = file.read(MAX_FILE)
        if hashlib.sha256(whole[32:]).digest() != whole[:32]:
            raise ValueError
        rows = msgspec.msgpack.decode(whole[32:], type=list[dict[str, Any]])
        os.utime(path)
        return rows
    except FileNotFoundError:
        return None
    except (OSError, ValueError):
        with contextlib.suppress(OSError):
            remove(path)
        return None


def _sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()
