"""Who may import whom and where, how large folders, functions and signatures may be, over the syntax trees; and that what must start quickly imports
nothing heavy."""

import ast
import functools
import graphlib
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from stages.formats.importers import IMPORTERS

ROOT = Path(__file__).resolve().parent.parent
OURS = ("pipeline", "efficientnerf", "stages", "workflows")
ALLOWED = {
    "pipeline": {"pipeline"},
    "efficientnerf": {"efficientnerf"},
    "stages": {"stages", "pipeline", "efficientnerf"},
    "workflows": set(OURS),
}
MODULES_A_FOLDER, LINES, ARGUMENTS = 15, 60, 12
_KERNELS = "efficientnerf.backends.numba."
_OUTPUTS = "outputs are arguments of their own: numba takes for dead what is written to arrays that come out of a tuple"
LONG = {_KERNELS + "tree.packets.march:march": "one loop over a packet's vectors: cut in two, a dozen of them would go through memory at each step",
        _KERNELS + "mesh.photographs:observe": "one loop over texels, whose rejections share its variables"}  # fmt: skip
MANY_ARGUMENTS = {
    _KERNELS + "bricks:weigh_voxels": _OUTPUTS,
    _KERNELS + "compositing:composite_backward": _OUTPUTS,
    _KERNELS + "mesh.photographs:observe": _OUTPUTS,
    _KERNELS + "splats.fitting:_step_part": "vectors, which have no place in memory",
    _KERNELS + "tree.image:render_batch": _OUTPUTS,
    _KERNELS + "tree.image:_render_blocks": "those of `render_batch` that a thread needs",
    _KERNELS + "tree.packets.tiles:render_tile": "those of `_render_blocks` that a tile needs",
}
HEAVY = ("torch", "pycolmap", "cv2", "numba", "matplotlib")
DOOR = (
    "stages.artifacts", "efficientnerf.settings", "efficientnerf.training.settings", "workflows.asset", "workflows.budget", "workflows.cli.main",
    "workflows.cli.run", "workflows.inspection.status", "workflows.cli.verify", "workflows.cli.presets", "workflows.fleet.program", "stages.sfm.pair_workers",
)  # fmt: skip
# Imports within functions, each with its reason beside it: of extras, of Triton, of pycolmap, which other libraries must precede, of what most runs need not.
LATE = {
    "efficientnerf/asset/rendering.py": 1,
    "efficientnerf/backends/dispatch.py": 1,
    "efficientnerf/geometry/ndc.py": 3,
    "pipeline/executors/dask.py": 2,
    "pipeline/locks/lock.py": 1,
    "stages/cores.py": 1,
    "stages/figures/drawing.py": 3,
    "stages/formats/exporters/las.py": 1,
    "stages/formats/exporters/usd.py": 3,
    "stages/formats/importers/depth.py": 1,
    "stages/io/decoders/raw.py": 2,
    "stages/io/network_file.py": 1,
    "stages/io/photo.py": 1,
    "stages/io/pictures.py": 1,
    "stages/poses/memory.py": 1,
    "stages/poses/run.py": 1,
    "stages/sfm/colmap.py": 5,
    "workflows/cli/device.py": 1,
    "workflows/cli/progress.py": 2,
    "workflows/cli/verify.py": 1,
    "workflows/report/pages.py": 2,
}


def modules(package: str) -> list[Path]:
    return sorted((ROOT / package).rglob("*.py"))


@functools.cache
def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"), str(path))


def imported(path: Path) -> Iterator[str]:
    """Full names of the modules that a file imports, anywhere in it."""
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield source_of(node, path)


def source_of(node: ast.ImportFrom, path: Path) -> str:
    """The full name of the module that a file imports from."""
    above = path.relative_to(ROOT).parts[: -node.level] if node.level else ()
    return ".".join([*above, node.module or ""]).rstrip(".")


@pytest.mark.parametrize("package", OURS)
def test_a_package_imports_only_those_below_it(package: str) -> None:
    wrong = []
    for path in modules(package):
        tops = {name.partition(".")[0] for name in imported(path)}
        wrong += [f"{path.relative_to(ROOT)} imports {top}" for top in sorted(tops & {*OURS, "tests"} - ALLOWED[package])]
    assert wrong == []


def test_the_engine_needs_the_standard_library_filelock_and_msgspec_only() -> None:
    """And Dask, in the one file that is for it."""
    wrong = []
    for path in modules("pipeline"):
        tops = {name.partition(".")[0] for name in imported(path)}
        optional = {"distributed"} if path == ROOT / "pipeline/executors/dask.py" else set()
        wrong += [f"{path.relative_to(ROOT)} imports {top}" for top in sorted(tops - sys.stdlib_module_names - {"pipeline", "filelock", "msgspec"} - optional)]
    assert wrong == []


def dotted(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def import_graph() -> dict[str, set[str]]:
    """Module -> the modules of ours that it imports, anywhere in it: those within functions and of types alone count."""
    paths = {dotted(path): path for package in OURS for path in modules(package)}
    graph: dict[str, set[str]] = {}
    for name, path in paths.items():
        found = graph.setdefault(name, set())
        for node in ast.walk(tree_of(path)):
            if isinstance(node, ast.Import):
                found |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                base = source_of(node, path)
                found |= {f"{base}.{alias.name}" for alias in node.names} & paths.keys() or {base}
        graph[name] = found & paths.keys() - {name}
    return graph


def cycle(graph: dict[str, set[str]]) -> list[str]:
    """Modules that import each other in a ring, the first of them again at the end; none: an empty list."""
    try:
        graphlib.TopologicalSorter(graph).prepare()
    except graphlib.CycleError as error:
        return error.args[1][::-1]
    return []


def functions() -> Iterator[tuple[str, ast.FunctionDef]]:
    """(module:function, its node)"""
    for package in OURS:
        for path in modules(package):
            for node in ast.walk(tree_of(path)):
                if isinstance(node, ast.FunctionDef):
                    yield f"{dotted(path)}:{node.name}", node


def arguments(node: ast.FunctionDef) -> int:
    """Arguments of a function, but for a Triton kernel's compile-time constants."""
    every = node.args.posonlyargs + node.args.args + node.args.kwonlyargs
    return sum(1 for each in every if each.annotation is None or ast.unparse(each.annotation) != "tl.constexpr")


def test_no_modules_import_each_other_in_a_ring() -> None:
    assert cycle({"a": {"b"}, "b": {"c"}, "c": {"b"}}) in (["b", "c", "b"], ["c", "b", "c"])
    assert cycle({"a": {"b"}, "b": {"c"}, "c": set()}) == []
    assert cycle(import_graph()) == []


def test_kernels_of_triton_import_none_of_numba() -> None:
    """What both take lies in `efficientnerf.backends.layout`."""
    names = [(path.name, name) for path in modules("efficientnerf/backends/triton") for name in imported(path)]
    assert [each for each in names if each[1].startswith("efficientnerf.backends.numba")] == []


def test_no_folder_holds_more_modules_than_can_be_surveyed() -> None:
    folders = [path.parent for package in OURS for path in modules(package) if path.name != "__init__.py"]
    assert {str(folder.relative_to(ROOT)) for folder in folders if folders.count(folder) > MODULES_A_FOLDER} == set()


def test_functions_are_short() -> None:
    """But for those of LONG, all of which are needed."""
    lengths = {name: (node.end_lineno or 0) - node.lineno + 1 for name, node in functions()}
    assert {name for name, lines in lengths.items() if lines > LINES} == LONG.keys()


def test_functions_take_few_arguments() -> None:
    """But for those of MANY_ARGUMENTS, all of which are needed."""
    assert {name for name, node in functions() if arguments(node) > ARGUMENTS} == MANY_ARGUMENTS.keys()


def test_tests_import_no_other_test_module() -> None:
    """What several of them need lies in modules of its own; this covers programs that tests start as well."""
    pattern = re.compile(r"^\s*(?:from|import)\s+tests[\w.]*\.(?:test_\w+|conftest)", re.MULTILINE)
    found = {str(path.relative_to(ROOT)): pattern.findall(path.read_text(encoding="utf-8")) for path in modules("tests")}
    assert {path: names for path, names in found.items() if names} == {}


def test_nothing_unpickles_or_evaluates() -> None:
    wrong = []
    for package in OURS:
        for path in modules(package):
            names = {name.partition(".")[0] for name in imported(path)} & {"pickle", "marshal", "shelve", "dill", "cloudpickle"}
            calls = {
                node.func.id
                for node in ast.walk(tree_of(path))
                if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in ("eval", "exec")
            }
            wrong += [f"{path.relative_to(ROOT)}: {name}" for name in sorted(names | calls)]
    assert wrong == []


def within_functions(path: Path) -> Iterator[tuple[int, str]]:
    """(line, what is imported there, as it is written) of the imports of a file that stand in functions."""
    lines = path.read_text(encoding="utf-8").splitlines()
    inside = {
        node.lineno
        for function in ast.walk(tree_of(path))
        if isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef)
        for node in ast.walk(function)
        if isinstance(node, ast.Import | ast.ImportFrom)
    }
    yield from ((line, lines[line - 1].strip()) for line in sorted(inside))


def test_imports_are_at_the_top_but_a_few_with_a_reason() -> None:
    found = {str(path.relative_to(ROOT)): [*within_functions(path)] for package in OURS for path in modules(package)}
    assert {path: lines for path, lines in found.items() if lines and path not in LATE} == {}
    assert {path: (len(lines), LATE[path]) for path, lines in found.items() if path in LATE and len(lines) != LATE[path]} == {}
    assert [f"{path}:{line}: {text}" for path, lines in found.items() for line, text in lines if "  # " not in text] == []


def test_types_are_imported_as_all_else() -> None:
    found = [str(path.relative_to(ROOT)) for package in OURS for path in modules(package) if "TYPE_CHECKING" in path.read_text(encoding="utf-8")]
    assert found == ["stages/poses/settings.py"]  # mypy takes no Literal of a tuple that is computed


def test_modules_at_the_door_import_nothing_heavy() -> None:
    """What is imported before there is anything to do; `tests/workflows/cli/test_cli.py` has the commands."""
    names = [dotted(path) for package in OURS for path in modules(package) if path.name == "__init__.py" or path.is_relative_to(ROOT / "pipeline")]
    names += [dotted(path) for path in modules("stages") if path.name == "settings.py"]
    names += [f"stages.formats.importers.{importer.module}" for importer in IMPORTERS.values()]  # the engine asks them for a source's files
    names += DOOR
    script = f"""
import importlib, sys
guilty = []
for name in {sorted(set(names))!r}:
    importlib.import_module(name)
    found = [heavy for heavy in {HEAVY!r} if heavy in sys.modules]
    if found:
        guilty.append(f"{{name}} pulls in {{', '.join(found)}}")
        break
print("\\n".join(guilty))
"""
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == ""
