"""Compiled kernels are kept where the user alone can write, are found again, and never outlive their sources; and which threads they run on."""

import json
import os
import select
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from efficientnerf.backends import kernel_cache
from efficientnerf.backends.numba.runtime import KernelFiles

PACKAGE = kernel_cache.ROOT / "efficientnerf"
KEY = "0123456789abcdef"
SOURCES = {
    "geometry/__init__.py": "",
    "geometry/limits.py": "STEP = 1",
    "geometry/spaces.py": "from .limits import *",
    "backends/numba/inner.py": """
from efficientnerf.backends.numba.runtime import numba
from efficientnerf.geometry.spaces import STEP

@numba.njit(cache=True)
def inner(x):
    return x + STEP
""",
    "backends/numba/outer.py": """
from efficientnerf.backends.numba.runtime import numba
from efficientnerf.backends.numba.inner import inner

@numba.njit(cache=True, parallel=True)
def outer(x):
    total = 0
    for i in numba.prange(x):
        total += inner(i)
    return total
""",
    "backends/numba/other.py": """
from efficientnerf.backends.numba.runtime import numba

@numba.njit(cache=True)
def other(x):
    return 10 * x
""",
}
PROGRAM = """
import json, numba, sys
from efficientnerf.backends import kernel_cache
from efficientnerf.backends.numba.other import other
from efficientnerf.backends.numba.outer import outer

started = []
with kernel_cache.compilation(lambda: started.append(1)) as found:
    result = outer(3) + other(1)
maps = open("/proc/self/maps").read() if sys.platform == "linux" else ""
facts = {"result": result, "functions": found.functions, "seconds": found.seconds, "started": len(started), "layer": numba.threading_layer()}
print(json.dumps({**facts, "folder": str(kernel_cache.folder()), "tbb": "libtbb.so" in maps}))
"""


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A package with three kernels; one calls another from another file, with a number from a third."""
    copy = tmp_path / "one" / "efficientnerf"
    names = ("kernel_cache", "sources", "__init__", "numba/__init__", "numba/bound", "numba/runtime")
    for name in ("__init__.py", *(f"backends/{name}.py" for name in names)):
        (copy / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(PACKAGE / name, copy / name)
    write(copy, SOURCES)
    return copy


def write(package: Path, sources: dict[str, str]) -> None:
    for name, text in sources.items():
        (package / name).parent.mkdir(exist_ok=True)
        (package / name).write_text(text)


def run(package: Path, program: str = PROGRAM, **environment: str) -> dict[str, Any]:
    kept = {name: value for name, value in os.environ.items() if not name.startswith("NUMBA_")}
    environment = {**kept, "PYTHONDONTWRITEBYTECODE": "1", "NUMBA_NUM_THREADS": "2", "PYTHONPATH": str(package.parent), "PYTHONSAFEPATH": "1", **environment}
    done = subprocess.run([sys.executable, "-c", program], env=environment, cwd=package.parent, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return {**json.loads(done.stdout), "stderr": done.stderr}


def test_a_kernel_is_compiled_once_for_the_same_sources_wherever_they_lie(package: Path, tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    first = run(package, ENERF_CACHE_DIR=str(cache))
    assert (first["result"], first["functions"], first["started"]) == (16, 2, 1)  # the one called counts with the one that calls it
    assert first["seconds"] > 0
    assert Path(first["folder"]).parent == cache / "kernels"
    assert {path.stat().st_mode & 0o777 for path in (cache, cache / "kernels", Path(first["folder"]))} == {0o700}
    elsewhere = tmp_path / "two" / "efficientnerf"
    shutil.copytree(package, elsewhere)
    again = run(elsewhere, ENERF_CACHE_DIR=str(cache))
    assert (again["result"], again["functions"], again["started"], again["folder"]) == (16, 0, 0, first["folder"])


def test_what_depends_on_a_source_that_changed_is_compiled_and_nothing_else(package: Path, tmp_path: Path) -> None:
    """And the forms of two states of the sources lie side by side."""
    edited = tmp_path / "two" / "efficientnerf"
    shutil.copytree(package, edited)

    def found(sources: Path) -> tuple[int, int]:
        done = run(sources, ENERF_CACHE_DIR=str(tmp_path / "cache"))
        return done["result"], done["functions"]

    assert found(package) == (16, 2)
    write(edited, {"geometry/limits.py": "STEP = 2"})
    assert found(edited) == (19, 1)
    write(edited, {"backends/numba/other.py": SOURCES["backends/numba/other.py"].replace("10", "20"), "model.py": ""})
    assert found(edited) == (29, 1)
    assert found(package) == (16, 0)
    assert found(edited) == (29, 0)


BOUND = {
    "backends/numba/factory.py": """
import types
from efficientnerf.backends.numba.runtime import numba

def _apply(x):
    return _visit(x) * FACTOR

def bind(visit, factor):
    copy = types.FunctionType(_apply.__code__, {**globals(), "_visit": visit, "FACTOR": factor}, "apply")
    copy.__module__, copy.__qualname__ = __name__, "apply"
    return numba.njit(cache=True)(copy)
""",
    "backends/numba/visitor.py": """
from efficientnerf.backends.numba.runtime import numba
from efficientnerf.geometry.limits import STEP

@numba.njit(cache=True)
def visit(x):
    return x + STEP
""",
    "backends/numba/caller.py": """
from efficientnerf.backends.numba.factory import bind
from efficientnerf.backends.numba.visitor import visit

kernel = bind(visit, 10)
""",
    "backends/numba/taker.py": """
from efficientnerf.backends.numba.runtime import numba

@numba.njit(cache=True)
def first(pair):
    return pair.a
""",
    "geometry/pair.py": """
from typing import NamedTuple

class Pair(NamedTuple):
    a: int
    b: int
""",
}
CALLS = """
import json
from efficientnerf.backends import kernel_cache
from efficientnerf.backends.numba.caller import kernel
from efficientnerf.backends.numba.taker import first
from efficientnerf.geometry.pair import Pair

with kernel_cache.compilation(lambda: None) as found:
    results = [kernel(1), first(Pair(a=1, b=2))]
print(json.dumps({"results": results, "functions": found.functions}))
"""


def test_what_a_form_is_made_of_besides_its_module_joins_its_key(package: Path, tmp_path: Path) -> None:
    """Functions and numbers that another module binds it to, and types of arguments, which it does not import."""
    write(package, BOUND)

    def found() -> tuple[list[int], int]:
        done = run(package, CALLS, ENERF_CACHE_DIR=str(tmp_path / "cache"))
        return done["results"], done["functions"]

    assert found() == ([20, 1], 2)
    write(package, {"geometry/limits.py": "STEP = 2", "geometry/pair.py": BOUND["geometry/pair.py"].replace("a: int\n    b: int", "b: int\n    a: int")})
    assert found() == ([30, 1], 2)
    write(package, {"backends/numba/caller.py": BOUND["backends/numba/caller.py"].replace("10", "100")})
    assert found() == ([300, 1], 1)
    write(package, {**BOUND, "geometry/limits.py": "STEP = 1"})
    assert found() == ([20, 1], 0)


def test_a_process_whose_sources_change_under_it_neither_keeps_nor_loads_forms(package: Path, tmp_path: Path) -> None:
    """As by an upgrade: it has imported some of the old ones, and reads the new ones."""
    change = "import pathlib, efficientnerf.geometry.spaces; pathlib.Path('efficientnerf/geometry/limits.py').write_text('STEP = 2')" + PROGRAM
    for program, expected in ((change, (16, 2)), (PROGRAM, (19, 1)), (change, (16, 1))):
        if program is change:
            write(package, SOURCES)
        done = run(package, program, ENERF_CACHE_DIR=str(tmp_path / "cache"))
        assert (done["result"], done["functions"]) == expected


def damaged(content: bytes) -> dict[str, bytes]:
    middle = len(content) // 2
    flipped = content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :]
    return {"empty": b"", "cut": content[:middle], "zeros": bytes(len(content)), "garbage": b"\x80\x05K\x01.", "flipped": flipped}


@pytest.mark.parametrize("suffix", [".nbi", ".nbc"])
def test_damaged_kernel_files_are_never_unpickled(tmp_path: Path, suffix: str) -> None:
    files = KernelFiles(str(tmp_path), "kernel", "sources")
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
    for number, step in enumerate(("_load_index", "_save_index", "_save_data")):
        for after in (False, True):
            folder = tmp_path / f"{number} {after}"
            folder.mkdir()
            files = {form: KernelFiles(str(folder), "kernel", "sources") for form in ("float32", "float64")}
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
    files = KernelFiles(str(tmp_path), "kernel", "sources")
    files.save("float32", ["code of float32"])
    next(tmp_path.glob("*.nbi")).unlink()
    for step in ("_save_data", "_save_index"):
        killed = KernelFiles(str(tmp_path), "kernel", "sources")

        def kill(*_: Any) -> None:
            raise KeyboardInterrupt

        setattr(killed, step, kill)
        with pytest.raises(KeyboardInterrupt):
            killed.save("float64", ["code of float64"])
        assert files.load("float64") is None


WAITS = """
import json, os, sys
from efficientnerf.backends import kernel_cache
from efficientnerf.backends.numba import runtime
from efficientnerf.backends.numba.runtime import KernelFiles

files = KernelFiles(sys.argv[1], "kernel", "sources")
os.write(1, b"looks\\n")  # at once
found = files.load("float32")
print(json.dumps(found), flush=True)
if found is None:
    sys.stdin.readline()  # it compiles
    if sys.argv[2] == "saves":
        files.save("float32", ["code"])
        sys.stdin.readline()
"""


@pytest.mark.skipif(os.name != "posix", reason="locks of bytes are POSIX's")
@pytest.mark.parametrize("end", ["saves", "killed", "fails", "sleeps"])
def test_who_needs_a_form_that_another_process_compiles_waits_for_it(tmp_path: Path, end: str) -> None:
    """And compiles it where the other was killed meanwhile, could not, or gets no core."""
    environment = {**os.environ, "ENERF_CACHE_DIR": str(tmp_path / "cache"), "PYTHONPATH": str(kernel_cache.ROOT)}
    program = WAITS.replace("files =", "runtime.PATIENCE = 1.0\nfiles =") if end == "sleeps" else WAITS
    command = [sys.executable, "-c", program, str(tmp_path), end]

    def begun() -> subprocess.Popen[str]:
        return subprocess.Popen(command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    with begun() as first:
        assert first.stdout is not None
        assert first.stdin is not None
        assert first.stdout.readline() == "looks\n"
        assert json.loads(first.stdout.readline()) is None
        with begun() as second:
            assert second.stdout is not None
            assert os.read(second.stdout.fileno(), 6) == b"looks\n"  # no more, as a buffer would
            assert not select.select([second.stdout], [], [], 0.5)[0]
            if end == "killed":
                first.kill()
            elif end != "sleeps":
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
    assert found["result"] == 16
    assert "No space left on device; compiled kernels are not kept" in found["stderr"]


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


def made(place: Path, days: float) -> Path:
    """A folder of kernels that was not used for so many days."""
    (place / "numba").mkdir(parents=True)
    (place / "numba" / "code.nbc").touch()
    os.utime(place, (time.time() - days * kernel_cache.DAY,) * 2)
    return place


def test_folders_out_of_use_are_removed_and_nothing_else(tmp_path: Path) -> None:
    root = tmp_path / "kernels"
    root.mkdir(mode=0o700)
    recent = [made(root / f"{number:016x}", number / 100) for number in range(12)]
    week = [made(root / f"a{number:015x}", 7) for number in range(3)]
    old, own, foreign = made(root / ("b" * 16), 31), made(root / KEY, 100), made(root / "notes", 100)
    assert kernel_cache.first_private([root], KEY) == (own, [])
    assert all(place.exists() for place in (*recent, own, foreign))
    assert not any(place.exists() for place in (*week, old))
    assert time.time() - own.stat().st_mtime < 60


def test_states_of_a_modules_sources_out_of_use_are_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The present one stays, however old, and so do those of other modules; of modules that are gone none is present."""
    root = tmp_path / "cache" / "kernels" / kernel_cache.key()
    adam, mlp, gone = (root / f"{kernel_cache.KERNELS}.{name}" for name in ("adam", "mlp", "gone"))
    own, old, other = made(adam / KEY, 100), made(adam / ("a" * 16), 31), made(mlp / ("b" * 16), 31)
    week = [made(adam / f"c{number:015x}", 7 + number / 100) for number in range(kernel_cache.KEPT + 2)]
    left, removed = made(gone / ("d" * 16), 7), made(gone / ("e" * 16), 31)
    monkeypatch.setenv("ENERF_CACHE_DIR", str(tmp_path / "cache"))
    for each in (tmp_path / "cache", root.parent, root):
        each.chmod(0o700)
    for function in (kernel_cache.folder, kernel_cache.folder_of):
        monkeypatch.setattr(kernel_cache, function.__name__, function.__wrapped__)
    assert kernel_cache.folder_of(adam.name, KEY) == own
    assert all(place.exists() for place in (own, other, left, *week[: kernel_cache.KEPT]))
    assert not any(place.exists() for place in (old, removed, *week[kernel_cache.KEPT :]))
    assert time.time() - own.stat().st_mtime < 60
