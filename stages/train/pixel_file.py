"""Training pixels in a file, for images that take more memory than there is. The same bytes come out as of an array."""

import errno
import os
import tempfile
import weakref
from pathlib import Path
from typing import Any

import numpy as np

UNSUPPORTED = (errno.EOPNOTSUPP, errno.EINVAL, errno.ENOSYS)  # of file systems that cannot reserve space


class PixelFile:
    """Rows (P, 3 or 4) uint8 in a file without a name: it goes when it is closed, or with the process, whatever ends it.

    A row is read by a system call of its own. A mapped file would count as memory of the process, and as addresses where these are limited; and each
    row of it would bring its neighbours along.
    """

    def __init__(self, count: int, channels: int, folder: Path) -> None:
        """Reserves space for all rows at once, so that a full disk shows before an image is read. Raises OSError."""
        self.shape = (count, channels)
        with tempfile.TemporaryFile(dir=folder, buffering=0) as file:
            self._number = os.dup(file.fileno())
        self._closed = weakref.finalize(self, os.close, self._number)
        try:
            if hasattr(os, "posix_fallocate"):
                os.posix_fallocate(self._number, 0, max(1, self.nbytes))
        except OSError as error:
            if error.errno not in UNSUPPORTED:
                raise
        os.ftruncate(self._number, self.nbytes)
        self._advised = hasattr(os, "posix_fadvise")  # not on macOS
        if self._advised:
            os.posix_fadvise(self._number, 0, 0, os.POSIX_FADV_RANDOM)

    @property
    def nbytes(self) -> int:
        return self.shape[0] * self.shape[1]

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, index: Any) -> np.ndarray:
        """Rows of a slice without a step, or of an array (R,) of numbers >= 0. Raises OSError."""
        channels = self.shape[1]
        if isinstance(index, slice):
            first, last, _ = index.indices(len(self))
            return np.frombuffer(self._read(first * channels, max(0, last - first) * channels), np.uint8).reshape(-1, channels)
        at = np.asarray(index, np.int64)
        if len(at) and not (at.min() >= 0 and at.max() < len(self)):
            raise IndexError(f"row {at.min() if at.min() < 0 else at.max()} of {len(self)}")
        places = (at * channels).tolist()
        for place in places if self._advised else ():  # where the disk has to be read, for all of them at once
            os.posix_fadvise(self._number, place, channels, os.POSIX_FADV_WILLNEED)
        return np.frombuffer(b"".join([self._read(place, channels) for place in places]), np.uint8).reshape(-1, channels)

    def __setitem__(self, index: slice, rows: np.ndarray) -> None:
        """Write the rows of a slice without a step. Raises OSError."""
        first, last, _ = index.indices(len(self))
        if rows.shape != (last - first, self.shape[1]) or rows.dtype != np.uint8:
            raise ValueError(f"rows {rows.shape} {rows.dtype} for {(last - first, self.shape[1])} uint8")
        data, at = np.ascontiguousarray(rows).reshape(-1).data, first * self.shape[1]
        while data:
            written = os.pwrite(self._number, data, at)
            data, at = data[written:], at + written

    def _read(self, at: int, count: int) -> bytes:
        found = os.pread(self._number, count, at)
        while len(found) < count:  # a read stops at 2 GiB, and a signal may cut one short
            more = os.pread(self._number, count - len(found), at + len(found))
            if not more:
                raise OSError(errno.EIO, os.strerror(errno.EIO), "file of training pixels")
            found += more
        return found

    def close(self) -> None:
        """Free the space on the disk."""
        self._closed()
