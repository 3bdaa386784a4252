"""Structure from motion in a process of its own: what passes between the two, and how either of them may end."""

import json
import os
import signal
import subprocess
import sys
import time
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from pipeline.errors import BadInput, Interrupted, StageFailed
from pipeline.executors import pipes
from stages.sfm import process
from tests.stages.sfm.still_life import ROOT, SILENT

ORDER = """
import sys
at_import = []
def hook(event, arguments):
    if event == "import" and arguments[0] == "pycolmap":
        at_import.extend(name in sys.modules for name in ("zlib", "numpy", "PIL.Image"))
sys.addaudithook(hook)
from stages.sfm.colmap import import_pycolmap
import_pycolmap()
import zlib
zlib.compress(b"x" * 100_000)
assert at_import and all(at_import), at_import
"""


WHILE_IMPORTING = """
import os, signal, sys
from stages.sfm.colmap import quiet_pycolmap

sent = 0
def answer(number, frame):
    sys.exit(143 if sent > 1 else 1)

def hook(event, arguments):
    global sent
    if event == "import" and str(arguments[0]).startswith("pycolmap"):
        sent += 1
        os.kill(os.getpid(), signal.SIGTERM)  # before COLMAP's library is loaded and again and again until it is

signal.signal(signal.SIGTERM, answer)
sys.addaudithook(hook)
with quiet_pycolmap():
    pass
sys.exit(2)
"""


def ended_with(code: str) -> tuple[int, str]:
    """The return code and the standard error of a process that runs this."""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False, capture_output=True, text=True, timeout=100)
    return done.returncode, done.stderr


@pytest.mark.skipif(find_spec("pycolmap") is None, reason="pycolmap is not installed")
def test_pycolmap_is_imported_after_the_libraries_that_it_would_hide() -> None:
    assert ended_with(ORDER) == (0, "")


@pytest.mark.skipif(find_spec("pycolmap") is None, reason="pycolmap is not installed")
def test_sigterm_while_colmap_is_imported_is_answered_by_us() -> None:
    assert ended_with(WHILE_IMPORTING) == (143, "")


def child_does(monkeypatch: pytest.MonkeyPatch, body: str) -> None:
    """Let the child run this body of `capture_for(arguments, progress, safe_point, warn)`."""
    lines = "\n".join(f"    {line}" for line in body.splitlines())
    code = (
        f"import sys; sys.path[:] = {[entry or os.getcwd() for entry in sys.path]!r}\nimport ctypes, os, signal, time\nfrom stages.sfm import cameras, child\n"
        f"def capture_for(arguments, progress, safe_point, warn):\n{lines}\ncameras.capture_for = capture_for\nchild.main()\n"
    )
    monkeypatch.setattr(pipes, "command_for", lambda module: [sys.executable, "-c", code])


def test_progress_warnings_and_the_result_come_through_in_order(monkeypatch: pytest.MonkeyPatch) -> None:
    child_does(
        monkeypatch,
        "progress(1, 2, 'half', left=0.5)\nsafe_point()\nwarn('odd', name=arguments['name'])\nprint('no message')\nprogress(2, 2)\n"
        "return [arguments, 0.1 + 0.2]",
    )
    seen: list[Any] = []
    name = os.fsdecode(b"caf\xe9\n.jpg")
    found = process.run(
        {"name": name},
        progress=lambda *values, **facts: seen.append((values, facts)),
        safe_point=lambda: seen.append("safe"),
        warn=lambda text, **facts: seen.append((text, facts)),
    )
    assert found == [{"name": name}, 0.1 + 0.2]
    said = [each for each in seen if each != "safe"]
    assert said == [((1, 2, "half"), {"left": 0.5}), ("odd", {"name": name}), ((2, 2), {})]
    assert "safe" in seen[seen.index(said[0]) : seen.index(said[1])]


@pytest.mark.parametrize(
    ("number", "words"),
    [(signal.SIGABRT, r"ended by SIGABRT\. Its last words: free\(\): invalid pointer\\x1b\."), (signal.SIGSEGV, "SIGSEGV"), (signal.SIGKILL, "out of memory")],
)
def test_an_abort_is_an_error_of_the_stage_with_its_last_words(monkeypatch: pytest.MonkeyPatch, number: int, words: str) -> None:
    child_does(
        monkeypatch, f"os.write(2, b'free(): invalid pointer\\x1b\\n    @ 0x1 frame\\n*** SIGABRT\\n')\nos.kill(os.getpid(), {int(number)})\ntime.sleep(9)"
    )
    with pytest.raises(StageFailed, match=words) as caught:
        process.run({}, **SILENT)
    assert caught.value.exit_code == 3
    assert "frame" not in str(caught.value)


@pytest.mark.parametrize(
    ("raised", "expected"),
    [
        ("from pipeline.errors import BadInput\nraise BadInput('no photographs')", BadInput),
        ("raise OSError(28, 'No space left on device', '/somewhere')", OSError),
        ("raise MemoryError", MemoryError),
        ("import sqlite3\nraise sqlite3.OperationalError('disk I/O error')", RuntimeError),
        ("import sys\nsys.exit(5)", RuntimeError),
    ],
)
def test_errors_keep_their_class(monkeypatch: pytest.MonkeyPatch, raised: str, expected: type[Exception]) -> None:
    child_does(monkeypatch, raised)
    with pytest.raises(expected) as caught:
        process.run({}, **SILENT)
    assert "capture_for" in str(caught.value.__cause__)  # the child's own traceback
    if expected is OSError:
        assert (caught.value.errno, caught.value.filename) == (28, "/somewhere")  # type: ignore[attr-defined]


def test_what_a_safe_point_raises_stops_the_child_at_a_safe_point(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    child_does(
        monkeypatch,
        "progress(1, 1)\ntry:\n    while True:\n        safe_point()\n        time.sleep(0.01)\nfinally:\n    open(arguments['note'], 'w').write('tidy')",
    )
    begun: list[Any] = []

    def safe_point() -> None:
        if begun:
            raise Interrupted(signal.SIGTERM)

    with pytest.raises(Interrupted) as caught:
        process.run({"note": str(tmp_path / "note")}, **{**SILENT, "safe_point": safe_point, "progress": lambda *values: begun.append(values)})
    assert caught.value.exit_code == 143
    assert (tmp_path / "note").read_text() == "tidy"


def test_the_signals_of_a_terminal_are_the_parents_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    child_does(monkeypatch, "for number in (2, 15):\n    os.kill(os.getpid(), number)\nsafe_point()\nreturn 'alive'")
    assert process.run({}, **SILENT) == "alive"


# -------------------------------------------------------------------------------------------------------- whole runs


def start_run(folder: Path, pycolmap: str, *options: str, **changes: str) -> subprocess.Popen[str]:
    """`enerf run` on three photographs, with a module of this text in place of pycolmap."""
    (folder / "modules").mkdir(parents=True, exist_ok=True)
    (folder / "modules" / "pycolmap.py").write_text(pycolmap)
    rng = np.random.default_rng(0)
    for k in range(3):
        (folder / "photos").mkdir(exist_ok=True)
        Image.fromarray(rng.integers(0, 255, (48, 64, 3), np.uint8)).save(folder / "photos" / f"{k}.png")
    environment = {**os.environ, "PYTHONPATH": f"{folder / 'modules'}{os.pathsep}{ROOT}", **changes}
    code = "import sys; from workflows.cli.main import main; sys.exit(main())"
    command = [sys.executable, *options, "-c", code, "run", str(folder / "photos"), "--out", str(folder / "run"), "--until", "poses"]
    return subprocess.Popen(command, cwd=ROOT, env=environment, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)


ABORT = "import os\nos.write(2, b'free(): invalid pointer\\n')\nos.abort()\n"
# Python does not run meanwhile: neither a thread nor a handler.
HANG = "import ctypes, os\nopen({path!r}, 'w').write(str(os.getpid()))\nctypes.PyDLL(None).sleep(60)\n"


def test_an_abort_in_colmap_ends_the_stage_with_code_3(tmp_path: Path) -> None:
    run = start_run(tmp_path, ABORT, HOME="/nowhere", LC_ALL="C")
    _, said = run.communicate(timeout=60)
    assert run.returncode == 3, said
    assert "SIGABRT" in said
    assert json.loads((tmp_path / "run" / "run.json").read_text())  # the run is whole, and unlocked


def hanging_run(folder: Path) -> tuple[subprocess.Popen[str], int]:
    """A run whose child hangs inside of a library, and the child's process id."""
    note = folder / "pid"
    run = start_run(folder, HANG.format(path=str(note)))
    until = time.monotonic() + 60
    while not (note.exists() and note.read_text()):
        assert run.poll() is None
        assert time.monotonic() < until
        time.sleep(0.02)
    return run, int(note.read_text())


def ended(pid: int, seconds: float = 5.0) -> bool:
    """Whether a process that is no child of ours ends in time."""
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        try:
            if Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z":
                return True
        except OSError:
            return True
        time.sleep(0.02)
    return False


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize("how", ["killed", "Ctrl-C", "Ctrl-C twice"])
def test_the_child_ends_with_the_run(tmp_path: Path, how: str) -> None:
    run, child = hanging_run(tmp_path)
    assert child != run.pid
    if how == "killed":
        run.kill()
    else:
        run.send_signal(signal.SIGINT)
        time.sleep(0.3)
        assert run.poll() is None, "the first asks for a safe point"
        if how == "Ctrl-C twice":
            run.send_signal(signal.SIGINT)
    run.communicate(timeout=20)
    assert run.returncode in ((-signal.SIGKILL,) if how == "killed" else (130, -signal.SIGINT))
    assert ended(child)
