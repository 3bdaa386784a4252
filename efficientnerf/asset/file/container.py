"""The container of an asset: a safetensors file with one metadata entry, opened without trusting it.

Every claim of a file is checked against the file's size before memory for it is allocated, and nothing in it is run.
"""

import hashlib
import json
import math
import os
import secrets
import stat
from pathlib import Path
from typing import Any

import numpy as np

METADATA_KEY = "nerftree"
HEADER_LIMIT = 16 * 2**20
MARKS_LIMIT = 2**20  # commas, brackets and braces of a header: each may become an object of a hundred bytes
PIECE = 2**26
DTYPES: dict[str, np.dtype[Any]] = {
    "U8": np.dtype("<u1"), "U16": np.dtype("<u2"), "U64": np.dtype("<u8"), "F16": np.dtype("<f2"), "F32": np.dtype("<f4"),
}  # fmt: skip


class FormatError(ValueError):
    """A file that is not a NerfTree, is damaged, or is of a format that this build does not read."""


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    out = dict(pairs)
    if len(out) != len(pairs):
        raise FormatError("a JSON object names a key twice")
    return out


def _json(name: str, text: bytes | str) -> dict[str, Any]:
    def refuse(token: str) -> float:
        raise FormatError(f"JSON holds {token[:60]}, which is no finite number")

    def finite(token: str) -> float:
        return float(token) if math.isfinite(float(token)) else refuse(token)

    try:
        text = text.decode("utf-8") if isinstance(text, bytes) else text
        value = json.loads(text, object_pairs_hook=_unique, parse_constant=refuse, parse_float=finite)
    except FormatError as error:
        raise FormatError(f"{name}: {error}") from None
    except (ValueError, RecursionError) as error:
        raise FormatError(f"{name}: header is not JSON ({type(error).__name__})") from None
    if not isinstance(value, dict):
        raise FormatError(f"{name}: header is not a JSON object")
    return value


def _regular(path: str, flags: int) -> int:
    """A descriptor of a file, as `open` wants it; FormatError for a pipe or a device, which might never end. They are not waited for."""
    descriptor = os.open(path, flags | getattr(os, "O_NONBLOCK", 0))
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise FormatError(f"{Path(path).name}: can't be read (not a regular file)")
    return descriptor


def _digest(values: np.ndarray) -> str:
    """SHA-256 of an array's bytes, in pieces, so that signals are answered between."""
    digest, content = hashlib.sha256(), values.reshape(-1).view(np.uint8)
    for begin in range(0, len(content), PIECE):
        digest.update(content[begin : begin + PIECE])  # type: ignore[arg-type]
    return digest.hexdigest()


def write_whole(path: Path, data: bytes) -> None:
    """Write a file whole or not at all, on the disk when this returns. A file at `path` is replaced; links there or next to it are not followed."""
    aside = path.with_name(f".{path.name[:100]}.{secrets.token_hex(8)}.part")
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_BINARY", 0)
    descriptor = os.open(aside, flags, 0o666)  # less the umask
    try:
        with open(descriptor, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(aside, path)
    except BaseException:
        aside.unlink(missing_ok=True)
        raise
    if hasattr(os, "O_DIRECTORY"):
        folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


class Header:
    """The safetensors header, checked against the file's size: name -> (dtype, shape, first byte, last byte)."""

    def __init__(self, path: Path) -> None:
        self.path, self.name = path, path.name
        try:
            with open(path, "rb", opener=_regular) as file:
                self.size = os.fstat(file.fileno()).st_size
                first = file.read(8)
                if len(first) < 8:
                    raise FormatError(f"{self.name}: {self.size} bytes; a NerfTree begins with an 8-byte header length. The file is cut short or is none.")
                length = int.from_bytes(first, "little")
                if length > HEADER_LIMIT or 8 + length > self.size:
                    raise FormatError(f"{self.name}: header of {length} bytes in a file of {self.size}; the file is cut short or is no NerfTree.")
                raw = file.read(length)
        except (OSError, IsADirectoryError) as error:
            raise FormatError(f"{self.name}: can't be read ({error.strerror})") from error
        if sum(raw.count(mark) for mark in (b",", b"[", b"{")) > MARKS_LIMIT:
            raise FormatError(f"{self.name}: header of more than {MARKS_LIMIT} commas, brackets and braces; no NerfTree needs so many.")
        header = _json(self.name, raw)
        strings = header.pop("__metadata__", None)
        if not isinstance(strings, dict) or not isinstance(strings.get(METADATA_KEY), str):
            raise FormatError(f"{self.name}: a safetensors file without '{METADATA_KEY}' metadata; not a NerfTree.")
        self.meta = _json(self.name, strings[METADATA_KEY])
        self.start = 8 + length
        self.tensors = {str(name): self._entry(str(name), entry) for name, entry in header.items()}
        self._check_cover()

    def _entry(self, name: str, entry: Any) -> tuple[str, tuple[int, ...], int, int]:
        where = f"{self.name}: tensor '{name}'"
        if not isinstance(entry, dict) or set(entry) != {"dtype", "shape", "data_offsets"}:
            raise FormatError(f"{where}: expected dtype, shape and data_offsets")
        shape, offsets, dtype = entry["shape"], entry["data_offsets"], entry["dtype"]
        if not (isinstance(shape, list) and len(shape) <= 8 and all(type(n) is int and 0 <= n < 2**48 for n in shape)):
            raise FormatError(f"{where}: shape {str(shape)[:60]} is not a list of counts")
        if not (isinstance(offsets, list) and len(offsets) == 2 and all(type(n) is int and n >= 0 for n in offsets) and offsets[0] <= offsets[1]):
            raise FormatError(f"{where}: data_offsets {str(offsets)[:60]} are not a range")
        if self.start + offsets[1] > self.size:
            raise FormatError(f"{where}: ends at byte {self.start + offsets[1]} of a file of {self.size}; the file is cut short.")
        if isinstance(dtype, str) and dtype in DTYPES and math.prod(shape) * DTYPES[dtype].itemsize != offsets[1] - offsets[0]:
            raise FormatError(f"{where}: {dtype} of shape {shape} does not fill its {offsets[1] - offsets[0]} bytes")
        return str(dtype), tuple(shape), offsets[0], offsets[1]

    def _check_cover(self) -> None:
        at = 0
        for name, (_, _, begin, end) in sorted(self.tensors.items(), key=lambda item: item[1][2:]):
            if begin != at:
                raise FormatError(f"{self.name}: tensor '{name}' begins at {begin}, expected {at}; tensors must lie end to end")
            at = end
        if self.start + at != self.size:
            raise FormatError(f"{self.name}: {self.size - self.start - at} bytes after the last tensor; the file was appended to.")

    def read(self, name: str) -> np.ndarray:
        """The tensor, if its bytes have the digest in the metadata."""
        dtype, shape, begin, _ = self.tensors[name]
        with open(self.path, "rb", opener=_regular) as file:
            values = np.fromfile(file, DTYPES[dtype], count=math.prod(shape), offset=self.start + begin)
        if len(values) != math.prod(shape):
            raise FormatError(f"{self.name}: tensor '{name}' could not be read whole; the file changed while it was read")
        digests, found = self.meta.get("sha256"), _digest(values)
        want = digests.get(name) if isinstance(digests, dict) else None
        if found != want:
            problem = f"has SHA-256 {found[:12]}…, the file says {str(want)[:12]}…"
            raise FormatError(f"{self.name}: tensor '{name}' {problem}; the file is damaged. Bake it again or copy it anew.")
        return values.reshape(shape)
