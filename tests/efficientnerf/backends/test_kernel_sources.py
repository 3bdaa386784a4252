"""What every source of kernels keeps to, so that what is compiled is what the cache takes it for, and no pointer outlives its array."""

import ast

import numpy as np
import pytest

from efficientnerf.backends import kernel_cache
from efficientnerf.backends.numba.runtime import numba
from efficientnerf.backends.numba.vector.memory import hold, pointer

FILES = sorted((kernel_cache.ROOT / kernel_cache.KERNELS.replace(".", "/")).rglob("*.py"))
MADE = {"empty", "zeros", "ones", "full"}


def imports_numba(node: ast.AST) -> bool:
    if isinstance(node, ast.Import):
        return any(alias.name == "numba" for alias in node.names)
    return isinstance(node, ast.ImportFrom) and node.module == "numba" and any(alias.name in ("njit", "jit", "vectorize") for alias in node.names)


def test_numba_is_imported_with_its_threads_and_cache_set_up() -> None:
    for package in ("efficientnerf", "stages", "workflows"):
        for path in (kernel_cache.ROOT / package).rglob("*.py"):
            if path.name != "runtime.py" and any(imports_numba(node) for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))):
                pytest.fail(f"{path}: from efficientnerf.backends.numba.runtime import numba")


def test_no_kernel_lets_the_compiler_reorder_sums() -> None:
    """Copies of a function that are optimised in different surroundings would differ in the last bit, and so would runs that compile and runs that load."""
    found = []
    for path in FILES:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.keyword) and node.arg in ("fastmath", "flags"):
                found.append(f"{path.relative_to(kernel_cache.ROOT)}:{node.value.lineno}")
    assert not found


def test_kernels_take_nothing_from_modules_that_they_do_not_import() -> None:
    """No import by a computed name, no name that is bound anew later; implementations of a function, and models of a type, lie in its module."""
    for path in FILES:
        tree = ast.parse(path.read_text(encoding="utf-8"))
        own = {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.ClassDef)}
        for node in ast.walk(tree):
            assert not isinstance(node, ast.Global), path
            assert not (isinstance(node, ast.Name | ast.Attribute) and getattr(node, "id", getattr(node, "attr", "")) in ("importlib", "__import__")), path
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in ("overload", "register_model"):
                assert ast.unparse(node.args[0]) in {*own, "operation", "operator.invert"}, path  # operators of vectors


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


def test_no_kernel_uses_a_pointer_to_an_array_that_it_names_no_more() -> None:
    """numba frees an array after the last line that names it, and the heap is then written over."""
    for path in FILES:
        for function in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(function, ast.FunctionDef):
                assert freed(function) == [], (path, function.name)


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
