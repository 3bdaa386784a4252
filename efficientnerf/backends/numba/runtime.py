"""numba as all kernels import it, `from efficientnerf.backends.numba.runtime import numba`: its threads and its cache are set up before a function is compiled.

Threads: OpenMP; where numba's OpenMP pool cannot be loaded (no libgomp on Linux, no libomp on macOS), numba's own work queue; never TBB
(docs/experiments/threading-layer.md). With OpenMP any number of threads may call kernels at a time. The work queue takes one caller at a time:
numba ends the process where two threads call kernels at once. The stages call kernels from one thread; a program that does not needs OpenMP
or a lock of its own. NUMBA_THREADING_LAYER and NUMBA_THREADING_LAYER_PRIORITY, where set, hold.

Cache: `kernel_cache.folder()`, for functions of this package alone. It only saves time: files in it that are damaged are removed and compiled again, and a
disk that takes or gives no file is not an error. Both are said in a RuntimeWarning.
"""

from __future__ import annotations

import functools
import hashlib
import io
import os
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numba
from numba.core import caching, event

from efficientnerf.backends import LAYERS, Notice, kernel_cache

if os.environ.get("NUMBA_THREADING_LAYER_PRIORITY", LAYERS) == LAYERS:
    numba.config.THREADING_LAYER_PRIORITY = LAYERS.split()  # numba may have been imported before the environment said so


class KernelLocator(caching._CacheLocator):
    """Tells numba where the compiled form of a function of this package is kept. The folder stands for the sources, wherever these lie."""

    def __init__(self, function: Callable[..., Any], path: Path) -> None:
        self._line = function.__code__.co_firstlineno
        self._folder = kernel_cache.folder() / path.parent

    def get_cache_path(self) -> str:
        return str(self._folder)

    def get_source_stamp(self) -> str:
        return kernel_cache.key()

    def get_disambiguator(self) -> str:
        return str(self._line)

    @classmethod
    def from_function(cls, function: Callable[..., Any], path: str) -> KernelLocator | None:
        source = Path(path).resolve()
        if not any(source.is_relative_to(kernel_cache.ROOT / folder) for folder in kernel_cache.KERNELS):
            return None
        found = cls(function, source.relative_to(kernel_cache.ROOT))
        found.ensure_cache_path()
        return found

    def ensure_cache_path(self) -> None:
        try:
            super().ensure_cache_path()
        except OSError as error:
            _warn_once(f"{self._folder}: {error.strerror or error}; compiled kernels are not kept.")


@functools.cache
def _warn_once(text: str) -> None:
    warnings.warn(text, Notice, stacklevel=2)


class KernelFiles(caching.IndexDataCacheFile):
    """The files of a function's compiled forms, those of this package with their SHA-256 at the end.

    A file that a power cut left empty, cut short or full of zeros would else end the program: numba unpickles what it finds, and runs the machine code.

    numba numbers the files of compiled forms by what its index holds: two processes that compile different forms of a function at the same moment take the
    same number, and the index may then lead to the code of the other form. Here a file is named by its form, and written before the index leads to it. Of two
    indices written at the same moment one stays: a form that it lacks is compiled again.
    """

    def __init__(self, cache_path: str, filename_base: str, source_stamp: Any) -> None:
        super().__init__(cache_path, filename_base, source_stamp)
        self._own = source_stamp == kernel_cache.key()

    def save(self, key: Any, data: Any) -> None:
        if not self._own:
            super().save(key, data)
            return
        name = self._index_name.removesuffix("nbi") + hashlib.sha256(self._dump(key)).hexdigest()[:32] + ".nbc"
        try:
            self._save_data(name, data)
            self._save_index({**self._load_index(), key: name})
        except OSError as error:
            _warn_once(f"{self._cache_path}: {error.strerror or error}; compiled kernels are not kept.")

    def load(self, key: Any) -> Any:
        try:
            return super().load(key)
        except OSError:
            if not self._own:
                raise
            return None

    def _load_index(self) -> dict[Any, str]:
        return super()._load_index() if self._is_whole(self._index_path) else {}

    def _load_data(self, name: str) -> Any:
        return super()._load_data(name) if self._is_whole(self._data_path(name)) else None

    @contextmanager
    def _open_for_write(self, filepath: str) -> Iterator[Any]:
        content = io.BytesIO()
        yield content
        with super()._open_for_write(filepath) as file:
            file.write(content.getvalue())
            if self._own:
                file.write(hashlib.sha256(content.getvalue()).digest())  # numba stops reading before it

    def _is_whole(self, path: str) -> bool:
        """Whether a file is there and what was written; removes it else."""
        if not self._own:
            return True
        try:
            content = Path(path).read_bytes()
        except FileNotFoundError:
            return False
        if hashlib.sha256(content[:-32]).digest() == content[-32:]:
            return True
        Path(path).unlink(missing_ok=True)
        warnings.warn(f"{path}: damaged, as by a power cut; removed, and compiled again.", Notice, stacklevel=2)
        return False


class _Compilations(event.Listener):
    """Passes on what numba compiles; a function compiled for the sake of another counts with that one."""

    def __init__(self) -> None:
        self._depth = 0
        self._began = 0.0

    def on_start(self, event: Any) -> None:
        if self._depth == 0:
            self._began = time.perf_counter()
            kernel_cache.note_start()
        self._depth += 1

    def on_end(self, event: Any) -> None:
        self._depth -= 1
        if self._depth == 0:
            kernel_cache.note_end(time.perf_counter() - self._began)


caching.CacheImpl._locator_classes.insert(0, KernelLocator)
caching.IndexDataCacheFile = KernelFiles
event.register("numba:compile", _Compilations())

__all__ = ["numba"]
