"""What every source of kernels keeps to, so that what is compiled is what the cache takes it for."""

import ast
from pathlib import Path

import pytest

from efficientnerf.backends import kernel_cache

PACKAGE = kernel_cache.ROOT / "efficientnerf"


def kernels() -> list[Path]:
    return sorted((kernel_cache.ROOT / kernel_cache.KERNELS.replace(".", "/")).rglob("*.py"))


def imports_numba(node: ast.AST) -> bool:
    if isinstance(node, ast.Import):
        return any(alias.name == "numba" for alias in node.names)
    return isinstance(node, ast.ImportFrom) and node.module == "numba" and any(alias.name in ("njit", "jit", "vectorize") for alias in node.names)


def test_numba_is_imported_with_its_threads_and_cache_set_up() -> None:
    for package in ("efficientnerf", "stages", "workflows"):
        for path in (PACKAGE.parent / package).rglob("*.py"):
            if path.name != "runtime.py" and any(imports_numba(node) for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))):
                pytest.fail(f"{path}: from efficientnerf.backends.numba.runtime import numba")


def test_no_kernel_lets_the_compiler_reorder_sums() -> None:
    """Copies of a function that are optimised in different surroundings would differ in the last bit, and so would runs that compile and runs that load."""
    found = []
    for path in kernels():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.keyword) and node.arg in ("fastmath", "flags"):
                found.append(f"{path.relative_to(kernel_cache.ROOT)}:{node.value.lineno}")
    assert not found


def test_kernels_take_nothing_from_modules_that_they_do_not_import() -> None:
    """No import by a computed name, no name that is bound anew later; implementations of a function, and models of a type, lie in its module."""
    for path in kernels():
        tree = ast.parse(path.read_text(encoding="utf-8"))
        own = {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.ClassDef)}
        for node in ast.walk(tree):
            assert not isinstance(node, ast.Global), path
            assert not (isinstance(node, ast.Name | ast.Attribute) and getattr(node, "id", getattr(node, "attr", "")) in ("importlib", "__import__")), path
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in ("overload", "register_model"):
                assert ast.unparse(node.args[0]) in {*own, "operation", "operator.invert"}, path  # operators of vectors
