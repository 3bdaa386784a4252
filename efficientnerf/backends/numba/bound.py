"""What a compiled form depends on that the sources of its function's module leave open: what the function was bound to elsewhere, and types of arguments."""

import hashlib
import inspect
import sys
from collections.abc import Iterator
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any

from numba.core.serialize import dumps

from efficientnerf.backends.kernel_cache import SOURCES


class _UnknownSourceError(Exception):
    pass


def bound(function: FunctionType, signature: Any) -> tuple[str | None, set[str]]:
    """(what a function is bound to, the modules that this and the types of its arguments are of); None where part of it is of no module of this package.

    A factory binds functions and numbers by closure cells, or by globals that it gives a copy of a function, as `efficientnerf.backends.numba.tree.march` does.
    """
    modules = SOURCES.modules_named(dumps(signature))  # NamedTuples, vectors
    try:
        return _described(function, modules, ()), modules
    except _UnknownSourceError:
        return None, modules


def _described(value: Any, modules: set[str], above: tuple[Any, ...]) -> str:
    """Text that tells a value from others while the sources of these modules stay as they are; adds the value's own."""
    function = getattr(value, "py_func", value)
    if not isinstance(function, FunctionType):
        data = dumps(value)
        modules |= SOURCES.modules_named(data)
        return hashlib.sha256(data).hexdigest()
    module = SOURCES.module_of(Path(inspect.getfile(function)).resolve())
    if module is None:
        raise _UnknownSourceError
    modules.add(module)
    name = f"{module}:{function.__qualname__}:{function.__code__.co_firstlineno}"
    if function in above:  # it calls itself
        return name
    return f"{name}({', '.join(f'{key}={_described(each, modules, (*above, function))}' for key, each in sorted(_bindings(function)))})"


def _bindings(function: FunctionType) -> Iterator[tuple[str, Any]]:
    """Names that are not those of its module, and their values."""
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
        yield name, cell.cell_contents
    own = vars(sys.modules[function.__module__])
    if function.__globals__ is not own:
        for name in set(_names(function.__code__)):
            if name in function.__globals__ and function.__globals__[name] is not own.get(name):
                yield name, function.__globals__[name]


def _names(code: CodeType) -> Iterator[str]:
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names(constant)
