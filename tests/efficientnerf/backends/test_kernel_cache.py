"""Compiled kernels are kept where the user alone can write, are found again, and never outlive their sources; and which threads they run on."""

from __future__ import annotations

import ast
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from efficientnerf.backends import kernel_cache

PACKAGE = kernel_cache.ROOT / "efficientnerf"
KEY = "0123456789abcdef"
INNER = """
from efficientnerf.backends.numba.runtime import numba

@numba.njit(cache=True)
def inner(x):
    return x + {}
"""
OUTER = """
from efficientnerf.backends.numba.runtime import numba
from efficientnerf.backends.numba.inner import inner

@numba.njit(cache=True, parallel=True)
def outer(x):
    total = 0
    for i in numba.prange(x):
        total += inner(i)
    return total
"""
PROGRAM = """
import json, numba, sys
from efficientnerf.backends import kernel_cache
from efficientnerf.backends.numba.outer import outer

started = []
with kernel_cache.compilation(lambda: started.append(1)) as found:
    result = outer(3)
maps = open("/proc/self/maps").read() if sys.platform == "linux" else ""
facts = {"result": result, "functions": found.functions, "seconds": found.seconds, "started": len(started), "layer": numba.threading_layer()}
print(json.dumps({**facts, "folder": str(kernel_cache.folder()), "tbb": "libtbb.so" in maps}))
"""


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A package with two kernels, one of which calls the other from another file."""
    copy = tmp_path / "one" / "efficientnerf"
    (copy / "backends" / "numba").mkdir(parents=True)
    for name in ("__init__.py", "backends/__init__.py", "backends/kernel_cache.py", "backends/numba/__init__.py", "backends/numba/runtime.py"):
        shutil.copyfile(PACKAGE / name, copy / name)
    for name in kernel_cache.CONSTANTS:
        (copy.parent / name).parent.mkdir(exist_ok=True)
        (copy.parent / name).write_text("")
    (copy / "backends" / "numba" / "inner.py").write_text(INNER.format(1))
    (copy / "backends" / "numba" / "outer.py").write_text(OUTER)
    return copy


def run(package: Path, program: str = PROGRAM, **environment: str) -> dict[str, Any]:
    kept = {name: value for name, value in os.environ.items() if not name.startswith("NUMBA_")}
    environment = {**kept, "NUMBA_NUM_THREADS": "2", "PYTHONPATH": str(package.parent), "PYTHONSAFEPATH": "1", **environment}
    done = subprocess.run([sys.executable, "-c", program], env=environment, cwd=package.parent, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return {**json.loads(done.stdout), "stderr": done.stderr}


def test_a_kernel_is_compiled_once_for_the_same_sources_wherever_they_lie(package: Path, tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    first = run(package, ENERF_CACHE_DIR=str(cache))
    assert (first["result"], first["functions"], first["started"]) == (6, 1, 1)  # the one called counts with the one that calls it
    assert first["seconds"] > 0
    assert Path(first["folder"]).parent == cache / "kernels"
    assert {path.stat().st_mode & 0o777 for path in (cache, cache / "kernels", Path(first["folder"]))} == {0o700}
    elsewhere = tmp_path / "two" / "efficientnerf"
    shutil.copytree(package, elsewhere)
    again = run(elsewhere, ENERF_CACHE_DIR=str(cache))
    assert (again["result"], again["functions"], again["started"], again["folder"]) == (6, 0, 0, first["folder"])
    (elsewhere / "backends" / "numba" / "inner.py").write_text(INNER.format(2))
    changed = run(elsewhere, ENERF_CACHE_DIR=str(cache))
    assert (changed["result"], changed["functions"]) == (9, 1)
    assert changed["folder"] != first["folder"]


def damaged(content: bytes) -> dict[str, bytes]:
    middle = len(content) // 2
    flipped = content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :]
    return {"empty": b"", "cut": content[:middle], "zeros": bytes(len(content)), "garbage": b"\x80\x05K\x01.", "flipped": flipped}


def test_an_empty_kernel_index_is_removed_and_compiled_again(package: Path, tmp_path: Path) -> None:
    """As a power cut leaves it; numba alone would end with EOFError."""
    cache = tmp_path / "cache"
    folder = Path(run(package, ENERF_CACHE_DIR=str(cache))["folder"])
    for path in folder.rglob("*.nbi"):
        path.write_bytes(b"")
    again = run(package, ENERF_CACHE_DIR=str(cache))
    assert (again["result"], again["functions"]) == (6, 1)
    assert "removed, and compiled again" in again["stderr"]


@pytest.mark.parametrize("suffix", [".nbi", ".nbc"])
def test_damaged_kernel_files_are_never_unpickled(tmp_path: Path, suffix: str) -> None:
    from efficientnerf.backends.numba.runtime import KernelFiles

    files = KernelFiles(str(tmp_path), "kernel", kernel_cache.key())
    files.save("signature", ["code"])
    assert files.load("signature") == ["code"]
    path = next(tmp_path.glob(f"*{suffix}"))
    content = path.read_bytes()
    for damage in damaged(content).values():
        path.write_bytes(damage)
        with pytest.warns(RuntimeWarning, match="removed, and compiled again"):
            assert files.load("signature") is None
        assert not path.exists()
        assert files.load("signature") is None
        files.save("signature", ["code"])
        assert files.load("signature") == ["code"]


def test_forms_that_are_compiled_at_the_same_moment_are_never_mixed_up(tmp_path: Path) -> None:
    """Whatever of its work one process has done when another does all of its own; numba's numbers mix them."""
    from efficientnerf.backends.numba.runtime import KernelFiles

    for number, step in enumerate(("_load_index", "_save_index", "_save_data")):
        for after in (False, True):
            folder = tmp_path / f"{number} {after}"
            folder.mkdir()
            files = {form: KernelFiles(str(folder), "kernel", kernel_cache.key()) for form in ("float32", "float64")}
            known = getattr(files["float32"], step)

            def interrupted(*values: Any, known: Any = known, files: Any = files, after: bool = after) -> Any:
                before = known(*values) if after else None
                files["float64"].save("float64", ["code of float64"])
                return before if after else known(*values)

            setattr(files["float32"], step, interrupted)
            files["float32"].save("float32", ["code of float32"])
            delattr(files["float32"], step)
            found = {form: each.load(form) for form, each in files.items()}
            assert all(code in (None, [f"code of {form}"]) for form, code in found.items()), (step, after, found)
            assert any(found.values())
            for form, each in files.items():
                each.save(form, [f"code of {form}"])
            assert {form: each.load(form) for form, each in files.items()} == {form: [f"code of {form}"] for form in files}


def test_a_process_that_is_killed_while_it_saves_leaves_no_other_forms_code(tmp_path: Path) -> None:
    from efficientnerf.backends.numba.runtime import KernelFiles

    files = KernelFiles(str(tmp_path), "kernel", kernel_cache.key())
    files.save("float32", ["code of float32"])
    next(tmp_path.glob("*.nbi")).unlink()
    for step in ("_save_data", "_save_index"):
        killed = KernelFiles(str(tmp_path), "kernel", kernel_cache.key())

        def kill(*_: Any) -> None:
            raise KeyboardInterrupt

        setattr(killed, step, kill)
        with pytest.raises(KeyboardInterrupt):
            killed.save("float64", ["code of float64"])
        assert files.load("float64") is None


WAITS = """
import json, sys, time
from efficientnerf.backends import kernel_cache
from efficientnerf.backends.numba.runtime import KernelFiles

files = KernelFiles(sys.argv[1], "kernel", kernel_cache.key())
found = files.load("float32")
print(json.dumps(found), flush=True)
if found is None:
    sys.stdin.readline()  # it compiles
    if sys.argv[2] == "saves":
        files.save("float32", ["code"])
        sys.stdin.readline()
"""


@pytest.mark.skipif(os.name != "posix", reason="locks of bytes are POSIX's")
@pytest.mark.parametrize("end", ["saves", "killed", "fails"])
def test_who_needs_a_form_that_another_process_compiles_waits_for_it(tmp_path: Path, end: str) -> None:
    """And compiles it where the other was killed meanwhile, or could not."""
    environment = {**os.environ, "ENERF_CACHE_DIR": str(tmp_path / "cache"), "PYTHONPATH": str(kernel_cache.ROOT)}
    command = [sys.executable, "-c", WAITS, str(tmp_path), end]

    def begun() -> subprocess.Popen[str]:
        return subprocess.Popen(command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    with begun() as first:
        assert first.stdout is not None
        assert first.stdin is not None
        assert json.loads(first.stdout.readline()) is None
        with begun() as second:
            assert second.stdout is not None
            with pytest.raises(subprocess.TimeoutExpired):
                second.wait(timeout=4.0)  # long enough to import numba, and it would have printed a line and read another
            if end == "killed":
                first.kill()
            else:
                first.stdin.write("\n")
                first.stdin.flush()
            found = json.loads(second.stdout.readline())
            assert found == (["code"] if end == "saves" else None)
            second.kill()
        first.kill()


def test_the_lock_of_a_form_that_cannot_be_compiled_is_given_back(package: Path, tmp_path: Path) -> None:
    program = """
import json
from efficientnerf.backends import kernel_cache
from efficientnerf.backends.numba import runtime
from efficientnerf.backends.numba.inner import inner
try:
    inner("text")
except Exception as error:
    refused = type(error).__name__
held = (len(runtime._locks._held), len(runtime._compilations._forms))
print(json.dumps({"refused": refused, "held": held, "result": inner(3), "after": (len(runtime._locks._held), len(runtime._compilations._forms))}))
"""
    found = run(package, program, ENERF_CACHE_DIR=str(tmp_path / "cache"))
    assert (found["refused"], found["held"], found["result"], found["after"]) == ("TypingError", [0, 0], 4, [0, 0])


def test_a_disk_that_takes_no_kernels_is_no_error(package: Path, tmp_path: Path) -> None:
    full = PROGRAM.replace(
        "started = []",
        """
import errno
from numba.core import caching
def refuse(*_):
    raise OSError(errno.ENOSPC, "No space left on device")
caching.IndexDataCacheFile._open_for_write = refuse
started = []
""",
    )
    found = run(package, full, ENERF_CACHE_DIR=str(tmp_path / "cache"))
    assert found["result"] == 6
    assert "No space left on device; compiled kernels are not kept" in found["stderr"]


def test_the_key_stands_for_each_kernel_source_and_its_place(package: Path) -> None:
    inner = package / "backends" / "numba" / "inner.py"
    keys = [kernel_cache.key_of(package.parent)]
    inner.write_text(INNER.format(2))
    keys.append(kernel_cache.key_of(package.parent))
    inner.rename(inner.with_name("outermost.py"))
    keys.append(kernel_cache.key_of(package.parent))
    (package.parent / kernel_cache.KERNELS / "new.py").touch()
    keys.append(kernel_cache.key_of(package.parent))
    (package.parent / kernel_cache.CONSTANTS[0]).write_text("FARTHEST = 1")
    keys.append(kernel_cache.key_of(package.parent))
    assert len(set(keys)) == 5
    (package / "model.py").write_text("no kernel")
    assert kernel_cache.key_of(package.parent) == keys[-1]


def test_the_key_stands_for_all_constants_that_kernels_import() -> None:
    """They are part of the compiled code; classes and functions of other folders are called by Python alone."""
    known = {name.removesuffix(".py").replace("/", ".") for name in kernel_cache.CONSTANTS}
    found = set()
    for path in (kernel_cache.ROOT / kernel_cache.KERNELS).rglob("*.py"):
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ImportFrom) and path.name != "runtime.py":
                assert node.level == 0, path
                constants = node.module if any(alias.name.isupper() for alias in node.names) else None
                found |= {constants or f"{node.module}.{alias.name}" for alias in node.names if constants or f"{node.module}.{alias.name}" in known}
    ours = {name for name in found if name.startswith("efficientnerf") and not name.startswith(kernel_cache.KERNELS.replace("/", "."))}
    assert len(ours) > 2
    assert ours <= known


def imports_numba(node: ast.AST) -> bool:
    if isinstance(node, ast.Import):
        return any(alias.name == "numba" for alias in node.names)
    return isinstance(node, ast.ImportFrom) and node.module == "numba" and any(alias.name in ("njit", "jit", "vectorize") for alias in node.names)


def test_numba_is_imported_with_its_threads_and_cache_set_up() -> None:
    for package in ("efficientnerf", "stages", "workflows"):
        for path in (PACKAGE.parent / package).rglob("*.py"):
            if path.name != "runtime.py" and any(imports_numba(node) for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))):
                pytest.fail(f"{path}: from efficientnerf.backends.numba.runtime import numba")


def test_a_folder_that_others_could_write_to_is_refused(tmp_path: Path) -> None:
    shared, linked, file, good = (tmp_path / name for name in ("shared", "linked", "file", "good"))
    shared.mkdir()
    shared.chmod(0o777)
    (tmp_path / "elsewhere").mkdir()
    linked.symlink_to(tmp_path / "elsewhere")
    file.touch()
    (tmp_path / "group" / KEY).mkdir(parents=True)
    (tmp_path / "group" / KEY).chmod(0o770)
    roots = [shared, shared / "below", linked, file, tmp_path / "group", good]
    place, refusals = kernel_cache.first_private(roots, KEY)
    assert place == good / KEY
    assert good.stat().st_mode & 0o777 == place.stat().st_mode & 0o777 == 0o700
    assert [refusal.partition(" (")[0] for refusal in refusals] == [str(root) for root in roots[:-1]]
    assert "others can write to" in refusals[0]
    assert f"others can write to {shared})" in refusals[1]
    assert "is a link" in refusals[2]
    assert kernel_cache.first_private([shared], KEY)[0] is None


def test_folders_out_of_use_are_removed_and_nothing_else(tmp_path: Path) -> None:
    root = tmp_path / "kernels"
    root.mkdir(mode=0o700)
    now = kernel_cache.time.time()

    def made(name: str, days: float) -> Path:
        (root / name / "numba").mkdir(parents=True)
        (root / name / "numba" / "code.nbc").touch()
        os.utime(root / name, (now - days * kernel_cache.DAY,) * 2)
        return root / name

    recent = [made(f"{number:016x}", number / 100) for number in range(12)]
    week = [made(f"a{number:015x}", 7) for number in range(3)]
    old, own, foreign = made("b" * 16, 31), made(KEY, 100), made("notes", 100)
    assert kernel_cache.first_private([root], KEY) == (own, [])
    assert all(place.exists() for place in (*recent, own, foreign))
    assert not any(place.exists() for place in (*week, old))
    assert now - own.stat().st_mtime < 60


def test_no_kernel_lets_the_compiler_reorder_sums() -> None:
    """Copies of a function that are optimised in different surroundings would differ in the last bit, and so would runs that compile and runs that load."""
    found = []
    for path in sorted((kernel_cache.ROOT / kernel_cache.KERNELS).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.keyword) and node.arg in ("fastmath", "flags"):
                found.append(f"{path.relative_to(kernel_cache.ROOT)}:{node.value.lineno}")
    assert not found
