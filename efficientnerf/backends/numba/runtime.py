"""numba as all kernels import it, `from efficientnerf.backends.numba.runtime import numba`: its threads and its cache are set up before a function is compiled.

Threads: OpenMP; where numba's OpenMP pool cannot be loaded (no libgomp on Linux, no libomp on macOS), numba's own work queue; never TBB
(docs/experiments/threading-layer.md). With OpenMP any number of threads may call kernels at a time. The work queue takes one caller at a time:
numba ends the process where two threads call kernels at once. The stages call kernels from one thread; a program that does not needs OpenMP
or a lock of its own. NUMBA_THREADING_LAYER and NUMBA_THREADING_LAYER_PRIORITY, where set, hold.

Cache: `kernel_cache.folder()`, for functions of this package alone. It only saves time: files in it that are damaged are removed and compiled again, and a disk
that takes or gives no file is not an error. Both are said in a RuntimeWarning. Of several processes that need a form of a function at the same moment one
compiles it, and the others wait for it, up to PATIENCE, and load it. Where sources of a form were changed since this process began, as by an upgrade, what it
has read of them is not known, and the form is neither loaded nor kept.
"""

from __future__ import annotations

import errno
import functools
import hashlib
import io
import os
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FunctionType
from typing import Any

import numba
from numba.core import caching, codegen, dispatcher, event
from numba.core.cpu_options import ParallelOptions

try:
    import fcntl
except ImportError:  # Windows: two processes may compile the same
    fcntl = None  # type: ignore[assignment]

from efficientnerf import BEGAN
from efficientnerf.backends import LAYERS, Notice, kernel_cache
from efficientnerf.backends.numba.bound import bound

if os.environ.get("NUMBA_THREADING_LAYER_PRIORITY", LAYERS) == LAYERS:
    numba.config.THREADING_LAYER_PRIORITY = LAYERS.split()  # numba may have been imported before the environment said so


# For `parallel`: loops over prange alone. With True each np.zeros, sum or comparison of arrays is a parallel loop too: a second to compile, and threads to wake
# at every call. An object, for numba empties a dictionary as it reads it, and then means True.
PRANGE: Any = ParallelOptions(dict.fromkeys(("comprehension", "reduction", "inplace_binop", "setitem", "numpy", "stencil", "fusion"), False))


class KernelLocator(caching._CacheLocator):
    """Tells numba where compiled forms of a function of this package are kept. The folder stands for the sources, wherever these lie."""

    def __init__(self, function: Callable[..., Any], module: str) -> None:
        self.module = module
        self._line = function.__code__.co_firstlineno
        self._key = kernel_cache.SOURCES.key([module])
        self._folder = kernel_cache.folder_of(module, self._key)

    def get_cache_path(self) -> str:
        return str(self._folder)

    def get_source_stamp(self) -> str:
        return self._key

    def get_disambiguator(self) -> str:
        return str(self._line)

    @classmethod
    def from_function(cls, function: Callable[..., Any], path: str) -> KernelLocator | None:
        module = kernel_cache.SOURCES.module_of(Path(path).resolve())
        if module is None or not module.startswith(f"{kernel_cache.KERNELS}."):
            return None
        found = cls(function, module)
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


PATIENCE = 20.0  # seconds to wait for a form that another process compiles: one that runs only on idle cores may wait for ever on a busy machine
POLL = 0.02


class ByteLocks:
    """Locks of processes, one for each text: bytes of one file, which the system frees when a process ends, however it does."""

    def __init__(self) -> None:
        self._file: int | None = None
        self._held: set[int] = set()

    def take(self, text: str, *, wait: bool) -> bool:
        """Whether the lock is held now, or cannot be had on this system; False where another process holds it, with `wait` for PATIENCE."""
        deadline = time.monotonic() + (PATIENCE if wait else 0)
        while not (taken := self._try(text)) and time.monotonic() < deadline:
            time.sleep(POLL)
        return taken

    def _try(self, text: str) -> bool:
        if fcntl is None:
            return True
        try:
            if self._file is None:  # stays open: closing any descriptor of the file would free all of its locks
                self._file = os.open(kernel_cache.folder() / "compiling.lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
            fcntl.lockf(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, self._place(text))
        except OSError as error:  # a file system without locks: all compile
            return error.errno not in (errno.EACCES, errno.EAGAIN)
        self._held.add(self._place(text))
        return True

    def give_back(self, text: str) -> None:
        if self._file is not None and self._place(text) in self._held:
            self._held.remove(self._place(text))
            fcntl.lockf(self._file, fcntl.LOCK_UN, 1, self._place(text))

    def _place(self, text: str) -> int:
        return int.from_bytes(hashlib.sha256(text.encode()).digest()[:7], "little")


class KernelFiles(caching.IndexDataCacheFile):
    """The files of the compiled forms of a function of this package, with their SHA-256 at the end.

    A file that a power cut left empty, cut short or full of zeros would else end the program: numba unpickles what it finds, and runs the machine code.

    numba numbers the files of compiled forms by what its index holds: two processes that compile different forms of a function at the same moment take the
    same number, and the index may then lead to the code of the other form. Here a file is named by its form, and written before the index leads to it. Of two
    indices written at the same moment one stays: a form that it lacks is compiled again.

    numba loads a form before it compiles it, and saves it after that: the lock of the form is taken and given back here.
    """

    def save(self, key: Any, data: Any) -> None:
        name = self._index_name.removesuffix("nbi") + hashlib.sha256(self._dump(key)).hexdigest()[:32] + ".nbc"
        try:
            self._save_data(name, data)
            _locks.take(self._index_path, wait=True)
            self._save_index({**self._load_index(), key: name})
        except OSError as error:
            _warn_once(f"{self._cache_path}: {error.strerror or error}; compiled kernels are not kept.")
        finally:
            _locks.give_back(self._index_path)
            self.leave(key)

    def leave(self, key: Any) -> None:
        """The form is not saved, or was."""
        _compilations.end_form(self._form(key))

    def load(self, key: Any) -> Any:
        found = self._loaded(key)
        if found is None:
            form = self._form(key)
            if not _locks.take(form, wait=False):
                with _compilations.waiting():
                    _locks.take(form, wait=True)
            found = self._loaded(key)  # another process may have saved it meanwhile
            if found is None:
                _compilations.begin_form(form)
            else:
                _locks.give_back(form)
        return found

    def _form(self, key: Any) -> str:
        return f"{self._index_path} {key}"

    def _loaded(self, key: Any) -> Any:
        try:
            return super().load(key)
        except OSError:
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
            file.write(hashlib.sha256(content.getvalue()).digest())  # numba stops reading before it

    def _is_whole(self, path: str) -> bool:
        """Whether a file is there and what was written; removes it else."""
        try:
            content = Path(path).read_bytes()
        except FileNotFoundError:
            return False
        if hashlib.sha256(content[:-32]).digest() == content[-32:]:
            return True
        Path(path).unlink(missing_ok=True)
        warnings.warn(f"{path}: damaged, as by a power cut; removed, and compiled again.", Notice, stacklevel=2)
        return False


class KernelCache(caching.FunctionCache):
    """numba's cache of one function, of this package or not.

    numba knows a form by the types of its arguments, the processor, the function's own bytecode, and values in closure cells. Here what else it is made of, and
    the sources of its module leave open, joins these: what it was bound to by other modules, and the sources of that and of its arguments' types.
    """

    def __init__(self, function: FunctionType) -> None:
        super().__init__(function)
        found = self._impl.locator
        self._module = found.module if isinstance(found, KernelLocator) else None
        self._bound: dict[Any, tuple[str | None, set[str]]] = {}
        if self._module is not None:
            self._cache_file = KernelFiles(self._cache_path, self._impl.filename_base, found.get_source_stamp())

    def _index_key(self, signature: Any, codegen: Any) -> Any:
        key = super()._index_key(signature, codegen)
        if self._module is None:
            return key
        text, modules = self._bound_to(signature)
        return (*key, text, kernel_cache.SOURCES.key({self._module, *modules}))

    def _load_overload(self, signature: Any, target_context: Any) -> Any:
        return super()._load_overload(signature, target_context) if self._is_certain(signature) else None

    def _save_overload(self, signature: Any, data: Any) -> None:
        if self._is_certain(signature):
            super()._save_overload(signature, data)
        else:
            self._cache_file.leave(self._index_key(signature, data.codegen))

    def _is_certain(self, signature: Any) -> bool:
        """Whether what this process compiles is made of the sources as they are."""
        if self._module is None:
            return True
        text, modules = self._bound_to(signature)
        return text is not None and not kernel_cache.SOURCES.changed_since({self._module, *modules}, BEGAN)

    def _bound_to(self, signature: Any) -> tuple[str | None, set[str]]:
        if signature not in self._bound:
            self._bound[signature] = bound(self._py_func, signature)
        return self._bound[signature]


class _Compilations(event.Listener):
    """Passes on what numba compiles, or waits for; a function compiled for the sake of another counts with that one. Holds the locks of what is compiled."""

    def __init__(self) -> None:
        self._depth = 0
        self._began = 0.0
        self._forms: list[str] = []  # one compiled for the sake of another comes after it

    def on_start(self, event: Any) -> None:
        if self._depth == 0:
            self._began = time.perf_counter()
            kernel_cache.note_start()
        self._depth += 1

    def on_end(self, event: Any) -> None:
        self._depth -= 1
        if self._depth == 0:
            kernel_cache.note_end(time.perf_counter() - self._began)
        if event is not None and sys.exc_info()[0] is not None and self._forms:
            self.end_form(self._forms[-1])  # it could not be compiled: numba saves nothing

    @contextmanager
    def waiting(self) -> Iterator[None]:
        self.on_start(None)
        try:
            yield
        finally:
            self.on_end(None)

    def begin_form(self, form: str) -> None:
        self._forms.append(form)

    def end_form(self, form: str) -> None:
        if form in self._forms:
            self._forms.remove(form)
            _locks.give_back(form)


# numba's names of the two functions between one with a parallel loop and the loop's body
WRAPPERS = ("parallelgufuncwrapper", "<numba.np.ufunc.wrappers._GufuncWrapper")


def compile_wrappers_once(library: Any) -> None:
    """Let numba's class of libraries of machine code make none of the wrappers of parallel loops alone, which nothing calls.

    numba optimises and translates each of them with all that the loop calls, then the function that they are linked into: a fifth of the time of compiling.
    Here they are linked into it as they are. One that is called itself, as of `numba.vectorize`, is still finished then.
    """
    add, module = library.add_linking_library, library._get_module_for_linking

    def is_unfinished(part: Any) -> bool:
        return part.name.startswith(WRAPPERS) and not part._finalized

    def add_linking_library(self: Any, part: Any) -> None:
        if is_unfinished(part):
            self._linking_libraries.append(part)
        else:
            add(self, part)

    def module_for_linking(part: Any) -> Any:
        if not is_unfinished(part):
            return module(part)
        if part._shared_module is None:
            for other in dict.fromkeys(part._linking_libraries):
                part._reload_init.update(other._reload_init)
                part._final_module.link_in(other._get_module_for_linking(), preserve=True)
            part._finalized = True  # for numba would finish it else
            try:
                module(part)
            finally:
                part._finalized = False
        return part._shared_module

    library.add_linking_library, library._get_module_for_linking = add_linking_library, module_for_linking


_locks = ByteLocks()
_compilations = _Compilations()
caching.CacheImpl._locator_classes.insert(0, KernelLocator)
dispatcher.FunctionCache = KernelCache  # type: ignore[attr-defined]
event.register("numba:compile", _compilations)
compile_wrappers_once(codegen.JITCodeLibrary)

__all__ = ["PRANGE", "numba"]
