"""COLMAP's library answers no signal in our place."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[3]

TERMINATED = """
import os, signal, sys
from dataclasses import replace
from pathlib import Path
from pipeline.errors import PipelineError
from pipeline.runner import run_stages
from stages.sfm.colmap import quiet_pycolmap
from tests.pipeline.toy import STAGES, make_run

def work(job):
    with quiet_pycolmap():
        pass
    os.kill(os.getpid(), signal.SIGTERM)
    job.safe_point()

if sys.argv[1] == "none":
    with quiet_pycolmap():
        pass
    os.kill(os.getpid(), signal.SIGTERM)
try:
    run_stages(make_run(Path(sys.argv[1])), [replace(STAGES[0], run=work), *STAGES[1:]])
except PipelineError as error:
    sys.exit(error.exit_code)
"""


@pytest.mark.parametrize(("engine", "code"), [(True, 143), (False, -signal.SIGTERM)])
def test_colmap_leaves_sigterm_as_it_was(tmp_path: Path, engine: bool, code: int) -> None:
    command = [sys.executable, "-c", TERMINATED, str(tmp_path) if engine else "none"]
    done = subprocess.run(command, cwd=ROOT, check=False, capture_output=True, text=True, timeout=100)
    assert (done.returncode, done.stderr) == (code, "")


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


def test_sigterm_while_colmap_is_imported_is_answered_by_us() -> None:
    done = subprocess.run([sys.executable, "-c", WHILE_IMPORTING], cwd=ROOT, check=False, capture_output=True, text=True, timeout=100)
    assert (done.returncode, done.stderr) == (143, "")
