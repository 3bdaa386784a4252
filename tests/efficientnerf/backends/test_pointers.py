"""Kernels name each array until its pointers were used: numba frees it after the last line that names it, and the heap is then written over."""

import ast
from pathlib import Path

import numpy as np
import pytest

from efficientnerf.backends import numba as kernels
from efficientnerf.backends.numba.runtime import numba
from efficientnerf.backends.numba.vector.memory import hold, pointer

FILES = sorted(Path(kernels.__file__).parent.rglob("*.py"))
MADE = {"empty", "zeros", "ones", "full"}


def freed(function: ast.FunctionDef) -> list[str]:
    """Arrays that a function makes, and of which the last thing that it asks for is a pointer, but in a loop, which keeps them."""
    made, loops, pointers, last = {}, {}, set(), {}
    for node in ast.walk(function):
        for child in ast.iter_child_nodes(node):
            loops[child] = [*loops.get(node, []), node] if isinstance(node, (ast.For, ast.While)) else loops.get(node, [])
        if isinstance(node, ast.Assign):
            left, right = node.targets[0], node.value
            several = isinstance(left, ast.Tuple) and isinstance(right, ast.Tuple)
            for target, value in zip(left.elts, right.elts, strict=True) if several else [(left, right)]:
                if isinstance(target, ast.Name) and isinstance(value, ast.Call) and isinstance(value.func, ast.Attribute) and value.func.attr in MADE:
                    made[target.id] = loops[node]
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "pointer":
            pointers |= set(node.args)
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load):
            last[node.id] = max(last.get(node.id, node), node, key=lambda each: (each.lineno, each.col_offset))
    return [name for name, where in made.items() if last.get(name) in pointers and loops[last[name]] == where]


@pytest.mark.parametrize("path", FILES, ids=lambda path: "/".join(path.parts[-2:]))
def test_no_kernel_uses_a_pointer_to_an_array_that_it_names_no_more(path: Path) -> None:
    for function in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(function, ast.FunctionDef):
            assert freed(function) == [], function.name


def test_such_a_function_is_found() -> None:
    lines = "def f(n):\n    for k in range(n):\n        a, b = np.empty(n), np.zeros(n)\n        p, q = pointer(a), pointer(b)\n        g(p, q)\n"
    for end, names in (("", ["a", "b"]), ("        hold((a,))\n", ["b"]), ("        hold((a, b))\n", [])):
        (function,) = ast.parse(lines + end).body
        assert isinstance(function, ast.FunctionDef)
        assert freed(function) == names


def test_held_arrays_are_not_overwritten() -> None:
    @numba.njit
    def first_of(count):  # type: ignore[no-untyped-def]
        array = np.full(count, 1.0)
        p = pointer(array)
        other = np.full(count, 2.0)
        first = p[0] + 0 * other[0]
        hold((array,))
        return first

    assert first_of(4096) == 1.0
