"""What export, convert and render may write: nothing in a run, nothing over what is there unless asked, no half files."""

import json
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from efficientnerf.asset.format import save
from pipeline import files
from pipeline.run import Run
from tests.efficientnerf.trees import random_tree
from tests.workflows.command import Enerf


@pytest.fixture
def asset(tmp_path: Path) -> Path:
    path = tmp_path / "asset.nerftree"
    save(random_tree(3, shape=(3, 3, 3), brick=4, degree=0, sigma=60.0), path)
    return path


@pytest.fixture
def run(tmp_path: Path, asset: Path) -> Path:
    folder = tmp_path / "run"
    Run.create(folder)
    (folder / "bake").mkdir()
    (folder / "bake/asset.nerftree").write_bytes(asset.read_bytes())
    (folder / ".lock").unlink()
    return folder


def contents(folder: Path) -> dict[str, bytes | str]:
    """Everything below a folder, links by what they name."""
    found: dict[str, bytes | str] = {}
    for path in sorted(folder.rglob("*")):
        if path.is_symlink():
            found[str(path)] = os.readlink(path)
        elif path.is_file():
            found[str(path)] = path.read_bytes()
    return found


def commands(target: Callable[[str], Path]) -> Iterator[list[object]]:
    """Each command that writes a file, to a target of its own kind; after the name comes the run or asset."""
    yield ["export", "--to", target(".ply")]
    yield ["export", "--points", "--to", target(".xyz")]
    yield ["convert", target(".nerftree")]
    yield ["render", "--frames", "1", "--width", "16", "--height", "16", "--out", target("")]


def called(enerf: Enerf, what: Path, command: list[object], *more: str) -> tuple[int, str]:
    result = enerf(command[0], what, *command[1:], *more, "--quiet")
    assert result.code == 0 or len(result.err.splitlines()) <= 2, result.err
    return result.code, result.err


def test_no_command_writes_into_a_run(enerf: Enerf, run: Path, asset: Path, tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(run / "bake")
    (tmp_path / "other").mkdir()
    before = contents(tmp_path)
    places = [run, run / "bake", run / "bake/..", tmp_path / "link", tmp_path / "other/../run"]
    for what in (run, asset):
        if what == asset:  # a run that holds a link is refused as a whole
            (run / "out").symlink_to(tmp_path / "other")
            places.append(run / "out")
            before = contents(tmp_path)
        for place in places:
            for force in ([], ["--force"]):
                for command in commands(lambda suffix: place / f"new{suffix}"):  # noqa: B023
                    code, said = called(enerf, what, command, *force)
                    assert (code, "lies in the run" in said) == (2, True), (command, said)
    for command in (["export", run, "--to", run / "run.json"], ["convert", run, run / "bake/asset.nerftree"], ["render", run, "--out", run]):
        assert enerf(*command, "--force").code in (2, 4)  # 4: the link in it
    assert contents(tmp_path) == before


def test_what_is_there_stays_unless_asked(enerf: Enerf, asset: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "new").mkdir()
    for name in ("new.ply", "new.xyz", "new.nerftree", "new/frame_0000.png"):
        (out / name).write_bytes(b"mine")
    for command in commands(lambda suffix: out / f"new{suffix}"):
        code, said = called(enerf, asset, command)
        assert (code, "--force" in said) == (2, True), said
    assert set(contents(out).values()) == {b"mine"}
    for command in commands(lambda suffix: out / f"new{suffix}"):
        assert called(enerf, asset, command, "--force")[0] == 0
    assert b"mine" not in contents(out).values()


def test_links_pipes_and_devices_are_neither_followed_nor_replaced(enerf: Enerf, asset: Path, tmp_path: Path) -> None:
    out, victim = tmp_path / "out", tmp_path / "victim"
    victim.write_bytes(b"mine")
    out.mkdir()
    kinds: dict[str, Callable[[Path], None]] = {
        "link": lambda path: path.symlink_to(victim), "dangling": lambda path: path.symlink_to(tmp_path / "nothing"),
        "device": lambda path: path.symlink_to("/dev/null"), "pipe": os.mkfifo, "folder": os.mkdir,
    }  # fmt: skip
    for name, make in kinds.items():
        folder = out / f"{name} frames"
        folder.mkdir()
        for path in (out / f"{name}.ply", out / f"{name}.xyz", out / f"{name}.nerftree", folder / "frame_0000.png"):
            make(path)
    before = contents(tmp_path)
    for name in kinds:
        for command in commands(lambda suffix: out / (f"{name}{suffix}" if suffix else f"{name} frames")):  # noqa: B023
            for force in ([], ["--force"]):
                assert called(enerf, asset, command, *force)[0] == 2, command
    for place in ("/dev/null", victim, out / "link.ply"):
        assert enerf("render", asset, "--out", place, "--force").code == 2
    assert contents(tmp_path) == before


def test_what_is_read_is_no_target(enerf: Enerf, asset: Path, tmp_path: Path) -> None:
    before = asset.read_bytes()
    hard = tmp_path / "hard.nerftree"
    os.link(asset, hard)
    for target in (asset, hard, tmp_path / "." / "asset.nerftree"):
        refused = enerf("convert", asset, target, "--force")
        assert (refused.code, "is the file that is read" in refused.err) == (2, True)
    path = tmp_path / "frame_0000.png"  # a camera path by the name of a frame
    matrix = [1, 0, 0, 0, 0, 0, -1, -4, 0, 1, 0, 0, 0, 0, 0, 1]
    path.write_text(json.dumps({"render_width": 16, "render_height": 16, "camera_path": [{"camera_to_world": matrix, "fov": 60}]}), encoding="utf-8")
    assert enerf("render", asset, "--out", tmp_path, "--path", path, "--force").code == 2
    assert enerf("export", asset, "--to", tmp_path / "a.ply", tmp_path / "./a.ply").code == 2
    assert asset.read_bytes() == before
    assert not (tmp_path / "a.ply").exists()


def test_a_full_disk_leaves_no_half_file(enerf: Enerf, asset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "out"
    out.mkdir()

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    monkeypatch.setattr(files, "sync_file", full)
    for command in commands(lambda suffix: out / f"new{suffix}"):
        code, said = called(enerf, asset, command)
        assert (code, str(out) in said) == (3, True), said
    assert contents(out) == {}
