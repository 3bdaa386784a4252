"""Commands on a run that a stranger packed: nothing outside changes or is read, nothing hangs, and every exit code is a documented one."""

import os
import shutil
from pathlib import Path

import pytest

from tests.workflows.command import Enerf

COMMANDS = (("status",), ("verify",), ("report",), ("run", "--out"))
READERS = (("inspect",), ("stage", "train"), ("run", "--dry-run", "--out"))


def snapshot(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() if path.is_file() else b"" for path in sorted(folder.rglob("*"))}


@pytest.fixture
def canary(tmp_path: Path) -> Path:
    folder = tmp_path / "canary"
    (folder / "deep").mkdir(parents=True)
    for name in ("thesis.txt", "deep/thesis.txt", "manifest.json", "run.json", "asset.nerftree"):
        (folder / name).write_text("years of work")
    return folder


def paths_of(run: Path) -> list[str]:
    """What a run holds, and the names that a kill may have left."""
    found = [path.relative_to(run).as_posix() for path in sorted(run.rglob("*"))]
    request = "a" * 64
    killed = [f".work/train/{request}/out", f".work/train/{request}/scratch", f".work/train/{request}", ".work/train", ".work/old-train", ".work/trash-1-1"]
    return list(dict.fromkeys([*found, ".cache", ".cache/hashes.json", ".work", *killed, "report.html", ".lock.json"]))


@pytest.mark.parametrize("kind", ["link to a folder", "link to a file", "broken link", "pipe"])
def test_links_and_pipes_in_the_place_of_everything(enerf: Enerf, toys: Path, tmp_path: Path, canary: Path, kind: str) -> None:
    made = tmp_path / "made"
    assert enerf("run", toys, "--out", made).code == 0
    before = snapshot(canary)
    for number, name in enumerate(paths_of(made)):
        run = tmp_path / f"run{number}"
        shutil.copytree(made, run)
        path = run / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_dir():
            shutil.rmtree(path)
        path.unlink(missing_ok=True)
        if kind == "pipe":
            os.mkfifo(path)
        else:
            path.symlink_to({"link to a folder": canary, "link to a file": canary / "thesis.txt", "broken link": canary / "new"}[kind])
        commands = (COMMANDS[number % 3], COMMANDS[3], READERS[number % len(READERS)])  # all of them on each path would take long
        codes = {enerf(*command, run).code for command in commands}
        assert codes <= {0, 2, 4}, name
        assert 4 in codes or name in ("report.html", "run.json"), name
        assert snapshot(canary) == before, name


def test_names_that_no_stage_has_are_not_looked_at(enerf: Enerf, toys: Path, tmp_path: Path, canary: Path) -> None:
    """A user's own link, pipe or folder in a run, under a name that a stage could have."""
    run = tmp_path / "run"
    assert enerf("run", toys, "--out", run).code == 0
    (run / "foo").symlink_to("/etc")
    os.mkfifo(run / "pipe")
    (run / "notes").mkdir()
    (run / "notes" / "link").symlink_to(canary)
    before = snapshot(canary)
    for command in (*COMMANDS, *READERS[1:]):
        assert enerf(*command, run).code == 0, command
    assert snapshot(canary) == before
    assert (run / "foo").is_symlink()


@pytest.mark.parametrize("command", [*COMMANDS[:3], ("inspect",), ("stage", "train"), ("view", "--no-browser")])
def test_a_folder_that_is_no_run_is_not_looked_at(enerf: Enerf, tmp_path: Path, canary: Path, command: tuple[str, ...]) -> None:
    """As /usr is: it holds links under names that a stage could have."""
    (tmp_path / "usr").mkdir()
    (tmp_path / "usr" / "train").symlink_to(canary)
    assert enerf(*command, tmp_path / "usr").code == 2
