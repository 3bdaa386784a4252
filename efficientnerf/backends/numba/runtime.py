"""numba as all kernels import it, `from efficientnerf.backends.numba.runtime import numba`: its threads and its cache are set up before a function is compiled.

Threads: OpenMP; where numba's OpenMP pool cannot be loaded (no libgomp on Linux, no libomp on macOS), numba's own work queue; never TBB
(docs/experiments/threading-layer.md). With OpenMP any number of threads may call kernels at a time. The work queue takes one caller at a time:
numba ends the process where two threads call kernels at once. The stages call kernels from one thread; a program that does not needs OpenMP
or a lock of its own. NUMBA_THREADING_LAYER and NUMBA_THREADING_LAYER_PRIORITY, where set, hold.

Cache: `kernel_cache.folder()`, for functions of this package alone.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
from numba.core import caching, event

from efficientnerf.backends import LAYERS, kernel_cache

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
        if not any(source.is_relative_to(kernel_cache.PACKAGE / folder) for folder in kernel_cache.KERNELS):
            return None
        found = cls(function, source.relative_to(kernel_cache.PACKAGE))
        found.ensure_cache_path()
        return found


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
event.register("numba:compile", _Compilations())

__all__ = ["numba"]
