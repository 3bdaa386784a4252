"""What libraries say does not reach the terminal; what we say does."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.workflows.fleet_child import PRESETS

ROOT = Path(__file__).resolve().parents[3]
COMMAND = "import sys; from tests.workflows.fleet_child import run; sys.exit(run(sys.argv[1:]))"
SAID = ("NOISE overflow", "NOISE TIFF", "NOISE of a logger", "ZeroDivisionError", "NOISE of a child")


def enerf(toys: Path, *arguments: object) -> subprocess.CompletedProcess[str]:
    """In a process of its own: pytest makes errors of warnings."""
    environment = {**os.environ, PRESETS: str(toys.parent / "presets")}
    command = [sys.executable, "-c", COMMAND, *map(str, arguments)]
    return subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)


@pytest.mark.parametrize("how", ["--quiet", "--json"])
def test_a_run_shows_our_warnings_and_no_librarys(how: str, toys: Path, tmp_path: Path) -> None:
    done = enerf(toys, "run", toys, "--out", tmp_path / "run", "--set", "train.fail=noisy", how)
    assert done.returncode == 0, done.stderr
    shown = done.stdout + done.stderr
    assert not any(words in shown for words in ("NOISE", "ZeroDivisionError"))
    assert shown.count("for users: the cache is damaged") == 1
    if how == "--json":
        assert not done.stderr
        return
    log = tmp_path / "run" / ".cache" / "libraries.log"
    assert all(words in log.read_text(encoding="utf-8") for words in SAID)
    assert enerf(toys, "run", "--out", tmp_path / "run", "--set", "train.fail=").returncode == 0
    assert not log.exists(), "of a command in which nothing was said there is none"


def test_debug_shows_what_libraries_said_and_no_link_is_written_through(toys: Path, tmp_path: Path) -> None:
    (tmp_path / "precious").write_text("kept", encoding="utf-8")
    assert enerf(toys, "run", toys, "--out", tmp_path / "run", "--until", "poses").returncode == 0
    log = tmp_path / "run" / ".cache" / "libraries.log"
    log.symlink_to(tmp_path / "precious")
    refused = enerf(toys, "run", "--out", tmp_path / "run", "--set", "train.fail=noisy")
    assert refused.returncode == 4
    log.unlink()
    done = enerf(toys, "run", "--out", tmp_path / "run", "--set", "train.fail=noisy", "--debug")
    assert done.returncode == 0
    assert all(words in done.stderr for words in SAID)
    assert (tmp_path / "precious").read_text(encoding="utf-8") == "kept"


def test_children_of_a_fleet_show_our_warnings_and_no_librarys(toys: Path, tmp_path: Path) -> None:
    (tmp_path / "shoots" / "one").mkdir(parents=True)
    (tmp_path / "shoots" / "one" / "a.txt").write_text("words", encoding="utf-8")
    done = enerf(toys, "fleet", tmp_path / "shoots", "--out", tmp_path / "fleet", "--set", "train.fail=noisy")
    assert done.returncode == 0, done.stderr
    assert "NOISE" not in done.stdout + done.stderr
    (scene,) = json.loads((tmp_path / "fleet" / "fleet.json").read_text(encoding="utf-8"))["scenes"]
    assert any("for users" in text for text in scene["warnings"])
