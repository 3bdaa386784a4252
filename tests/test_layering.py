"""Who may import whom, over the syntax trees; and that what must start quickly imports nothing heavy."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
OURS = ("pipeline", "efficientnerf", "stages", "workflows")
ALLOWED = {
    "pipeline": {"pipeline"},
    "efficientnerf": {"efficientnerf"},
    "stages": {"stages", "pipeline", "efficientnerf"},
    "workflows": set(OURS),
}
HEAVY = ("torch", "pycolmap", "cv2", "numba", "matplotlib")


def modules(package: str) -> list[Path]:
    return sorted((ROOT / package).rglob("*.py"))


def imported(path: Path) -> Iterator[str]:
    """Full names of the modules that a file imports, anywhere in it."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"), str(path))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            if node.level:
                yield ".".join([*path.relative_to(ROOT).parts[: -node.level], node.module or ""]).rstrip(".")
            else:
                yield node.module or ""


@pytest.mark.parametrize("package", OURS)
def test_a_package_imports_only_those_below_it(package: str) -> None:
    wrong = []
    for path in modules(package):
        tops = {name.partition(".")[0] for name in imported(path)}
        wrong += [f"{path.relative_to(ROOT)} imports {top}" for top in sorted(tops & {*OURS, "tests"} - ALLOWED[package])]
    assert wrong == []


def test_the_engine_needs_the_standard_library_filelock_and_msgspec_only() -> None:
    wrong = []
    for path in modules("pipeline"):
        tops = {name.partition(".")[0] for name in imported(path)}
        wrong += [f"{path.relative_to(ROOT)} imports {top}" for top in sorted(tops - sys.stdlib_module_names - {"pipeline", "filelock", "msgspec"})]
    assert wrong == []


def test_nothing_unpickles_or_evaluates() -> None:
    wrong = []
    for package in OURS:
        for path in modules(package):
            names = {name.partition(".")[0] for name in imported(path)} & {"pickle", "marshal", "shelve", "dill", "cloudpickle"}
            calls = {
                node.func.id
                for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
                if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in ("eval", "exec")
            }
            wrong += [f"{path.relative_to(ROOT)}: {name}" for name in sorted(names | calls)]
    assert wrong == []


def test_light_modules_import_nothing_heavy() -> None:
    """Every __init__, and every module of pipeline, stages and workflows: the heavy things are imported inside of functions."""
    names = []
    for package in OURS:
        for path in modules(package):
            dotted = ".".join(path.relative_to(ROOT).with_suffix("").parts)
            if path.name == "__init__.py":
                names.append(dotted.removesuffix(".__init__"))
            elif package != "efficientnerf" and path.name != "__main__.py":
                names.append(dotted)
    script = f"""
import importlib, sys
guilty = []
for name in {sorted(names)!r}:
    try:
        importlib.import_module(name)
    except ImportError as error:
        guilty.append(f"{{name}} cannot be imported: {{error}}")
    found = [heavy for heavy in {HEAVY!r} if heavy in sys.modules]
    if found:
        guilty.append(f"{{name}} pulls in {{', '.join(found)}}")
        break
print("\\n".join(guilty))
"""
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == ""
