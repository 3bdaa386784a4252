"""Text files of a source, read within bounds, and the numbers in them."""

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pipeline import files
from pipeline.errors import BadInput
from pipeline.text import printable
from stages.io.json_file import LARGEST_NUMBER

MAX_BYTES = 256 << 20  # bytes of a text file
_REMEDY = "Export it again."


def read_bytes(path: Path, limit: int = MAX_BYTES) -> bytes:
    """What a plain file of at most `limit` bytes holds. Raises BadInput, and OSError where the system does not read it."""
    with open(files.open_plain(path), "rb") as file:
        size = os.fstat(file.fileno()).st_size
        data = b"" if size > limit else file.read(limit + 1)
    if max(size, len(data)) > limit:
        raise BadInput(f"{path}: larger than {limit} bytes. Name the folder of a data set, or choose a format with --as.")
    return data


def read_text(path: Path, limit: int = MAX_BYTES) -> str:
    """As `read_bytes`, decoded: UTF-8, with or without a byte order mark, or UTF-16 with one. Raises BadInput."""
    data = read_bytes(path, limit)
    encoding = "utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    try:
        return data.decode(encoding)
    except UnicodeDecodeError as error:
        raise BadInput(f"{path}: no text ({error.reason} at byte {error.start}). {_REMEDY}") from None


def head(path: Path, size: int = 4096) -> str:
    """The first characters of a plain file, to recognise it by; empty where it cannot be read."""
    try:
        with open(files.open_plain(path), "rb") as file:
            data = file.read(size)
    except OSError:
        return ""
    encoding = "utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    return data.decode(encoding, "replace")


def number(text: str, where: str) -> float:
    """A finite number. Raises BadInput."""
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not abs(value) <= LARGEST_NUMBER:
        raise BadInput(f"{where}: {printable(text, 40) or 'nothing'}; expected a finite number. {_REMEDY}")
    return value


def numbers(texts: Sequence[str], count: int, where: str) -> np.ndarray:
    """(count,) float64 of as many words. Raises BadInput."""
    if len(texts) != count:
        raise BadInput(f"{where}: {len(texts)} numbers, expected {count}. {_REMEDY}")
    return np.array([number(text, where) for text in texts])
