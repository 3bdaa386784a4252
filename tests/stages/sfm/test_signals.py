"""COLMAP's library answers no signal in our place."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[3]

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
