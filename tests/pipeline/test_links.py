"""Runs that a stranger packed: links, pipes and devices in the places of the engine's files. Nothing outside changes, and nothing hangs."""

import contextlib
import os
import shutil
import socket
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from pipeline import artifact, files
from pipeline.artifact import WORK
from pipeline.decide import survey
from pipeline.errors import BadInput, CorruptArtifact, PipelineError
from pipeline.links import MAX_DEPTH, refuse_links
from pipeline.manifest import read_manifest
from pipeline.run import Run
from pipeline.runner import run_stages, verify
from tests.pipeline.kills import run_and_kill
from tests.pipeline.toy import STAGES, contents, make_run, set_one


@pytest.fixture
def outside(tmp_path: Path) -> Path:
    """A folder that is no part of the run, with what a user would not want to lose."""
    folder = tmp_path / "outside"
    (folder / "old").mkdir(parents=True)
    (folder / "thesis.txt").write_text("years of work")
    (folder / "old" / "draft.txt").write_text("months of work")
    (folder / "manifest.json").write_text("{}")
    return folder


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A run of which everything is made, then a stage killed while it was being made anew: .work holds its folders."""
    run = make_run(tmp_path_factory.mktemp("made"))
    run_stages(run, STAGES)
    set_one(run, "count", steps=9)
    assert run_and_kill(lambda: run_stages(run, STAGES), 12)
    assert (run.path / WORK / "count").is_dir()
    return run


@pytest.fixture
def done(made: Run, tmp_path: Path) -> Run:
    """A copy of it."""
    shutil.copytree(made.path, tmp_path / "run")
    return Run.open(tmp_path / "run")


def snapshot(folder: Path) -> dict[str, tuple[bytes, int]]:
    return {str(path): (path.read_bytes(), path.stat().st_mtime_ns) if path.is_file() else (b"", 0) for path in sorted(folder.rglob("*"))}


def tries(run: Path) -> list[PipelineError]:
    """What opening, surveying, verifying, changing and running a run raise."""

    def each(action: Callable[[Run], object]) -> Iterator[PipelineError]:
        try:
            action(Run.open(run))
        except PipelineError as error:
            yield error

    actions: list[Callable[[Run], object]] = [
        lambda run: survey(STAGES, run),
        lambda run: verify(run, STAGES),
        lambda run: run.update(preset="other"),
        lambda run: run_stages(run, STAGES),
        lambda run: run_stages(Run(run.path, run.source, run.settings), STAGES),
    ]
    return [error for action in actions for error in each(action)]


WORKPLACES = [WORK, f"{WORK}/count", f"{WORK}/count/REQUEST", f"{WORK}/count/REQUEST/out", f"{WORK}/count/REQUEST/scratch"]


def there(run: Run, name: str) -> Path:
    """The path of a name, of which nothing is left but the folder that it is in."""
    request = next(iter(path.name for path in (run.path / WORK / "count").iterdir()))
    path = run.path / name.replace("REQUEST", request)
    path.parent.mkdir(parents=True, exist_ok=True)
    files.remove(path)
    return path


@pytest.mark.parametrize("name", [*WORKPLACES, f"{WORK}/trash-1-2", f"{WORK}/old-count", "count", "list/images", ".cache", ".lease"])
def test_a_folder_behind_a_link_is_not_emptied(done: Run, outside: Path, name: str) -> None:
    link = there(done, name)
    link.symlink_to(outside)
    before = snapshot(outside)
    errors = tries(done.path)
    assert snapshot(outside) == before
    assert [type(error) for error in errors] == [CorruptArtifact] * 5
    assert errors[0].files == (str(link.relative_to(done.path)),)  # type: ignore[attr-defined]
    link.unlink()
    run_stages(Run.open(done.path), STAGES)
    verify(Run.open(done.path), STAGES)


@pytest.mark.parametrize("name", ["run.json", ".lock", ".lock.json", ".cache/hashes.json", f"{WORK}/count/REQUEST/scratch/state.txt", "list/list.txt"])
def test_only_plain_files_are_opened(done: Run, outside: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    before = snapshot(outside)
    for kind in ("link", "broken link", "pipe", "socket"):
        path = there(done, name)
        if kind == "pipe":
            os.mkfifo(path)
        elif kind == "socket":
            monkeypatch.chdir(path.parent)  # names of sockets are short
            with socket.socket(socket.AF_UNIX) as listener:
                listener.bind(path.name)
        else:
            path.symlink_to(outside / ("thesis.txt" if kind == "link" else "new.txt"))
        assert [type(error) for error in tries(done.path)] == [CorruptArtifact] * 5, kind
        assert snapshot(outside) == before


@pytest.mark.parametrize("name", [".lock", f"{WORK}/count/x/scratch/log.jsonl"])
def test_a_file_with_a_second_name_outside_is_not_written(tmp_path: Path, outside: Path, name: str) -> None:
    run = Run.create(tmp_path / "run")
    path = run.path / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    os.link(outside / "thesis.txt", path)
    with pytest.raises(CorruptArtifact), run.locked():
        pass
    (tmp_path / "new").mkdir()
    (tmp_path / "new" / ".lock").symlink_to(outside / "thesis.txt")
    with pytest.raises(CorruptArtifact):
        Run.create(tmp_path / "new")
    assert (outside / "thesis.txt").read_text() == "years of work"


def test_a_copy_of_hard_links_is_a_run(tmp_path: Path) -> None:
    """As backups are made: published files are replaced, never written in place."""
    run = make_run(tmp_path)
    run_stages(run, STAGES)
    shutil.copytree(run.path, tmp_path / "copy", copy_function=os.link)
    before = contents(run.path)
    copy = Run.open(tmp_path / "copy")
    set_one(copy, "count", steps=9)
    run_stages(copy, STAGES)
    verify(copy, STAGES)
    verify(run, STAGES)
    assert contents(run.path) == before


def test_links_of_the_user_are_left_alone(tmp_path: Path, outside: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Beside the artifacts, and to the run itself; folders nested too deeply and a run that cannot be listed are refused."""
    run = make_run(tmp_path)
    (tmp_path / "link").symlink_to(run.path)
    for name in ("report.html", "Notes", ".#run.json", ".report.html.0123456789abcdef.part"):
        (run.path / name).symlink_to(outside / "thesis.txt")
    run_stages(Run.open(tmp_path / "link"), STAGES)
    verify(Run.open(run.path), STAGES)
    assert (run.path / "Notes").is_symlink()
    (run.path / WORK).joinpath(*["a"] * MAX_DEPTH).mkdir(parents=True)
    with pytest.raises(CorruptArtifact):
        run_stages(run, STAGES)

    def refused(*arguments: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(os, "listdir", refused)
    with pytest.raises(BadInput, match="Permission denied"):
        refuse_links(run.path)


@pytest.mark.parametrize("name", [".run.json", "..lock.json", ".cache/.hashes.json"])
def test_a_temporary_name_cannot_be_taken_by_a_link(tmp_path: Path, outside: Path, name: str) -> None:
    """Every name that a process of this number could have used before names were random."""
    run = make_run(tmp_path)
    (run.path / ".cache").mkdir()
    for ending in (f"{os.getpid()}.part", "tmp", "part"):
        (run.path / f"{name}.{ending}").symlink_to(outside / "thesis.txt")
    before = snapshot(outside)
    for action in (lambda: run.update(preset="other"), lambda: run_stages(run, STAGES)):
        with contextlib.suppress(CorruptArtifact):  # of .cache, which holds nothing but our own
            action()
    assert snapshot(outside) == before


def test_a_temporary_file_is_new_and_has_the_permissions_of_the_umask(tmp_path: Path, outside: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("secrets.token_hex", lambda count: "0" * 16)
    (tmp_path / f".a.{'0' * 16}.part").symlink_to(outside / "thesis.txt")
    with pytest.raises(FileExistsError):
        files.write_atomically(tmp_path / "a", b"stranger's")
    monkeypatch.undo()
    before = os.umask(0o027)
    try:
        files.write_atomically(tmp_path / "a", b"mine")
    finally:
        os.umask(before)
    assert (tmp_path / "a").stat().st_mode & 0o777 == 0o640
    assert (outside / "thesis.txt").read_text() == "years of work"


def test_what_kills_left_of_temporary_files_goes_and_links_stay(tmp_path: Path, outside: Path) -> None:
    run = make_run(tmp_path)
    (run.path / ".cache").mkdir()
    ours = [".run.json.17.part", ".run.json.0123456789abcdef.part", "..lock.json.99.part", ".cache/.hashes.json.0123456789abcdef.part"]
    others = [".run.json.part", ".run.json.x.part", ".run.json.0123456789ABCDEF.part", "run.json.17.part", ".report.html.17.part"]
    for name in (*ours, *others):
        (run.path / name).write_text("")
    (run.path / ".report.html.0123456789abcdef.part").write_text("")
    os.utime(run.path / ".report.html.0123456789abcdef.part", (0, 0))
    (run.path / ".run.json.18.part").symlink_to(outside / "thesis.txt")
    with run.locked():
        pass
    left = {path.relative_to(run.path).as_posix() for path in run.path.rglob("*") if ".lease" not in path.parts}
    assert left == {".cache", ".lock", "run.json", ".run.json.18.part", *others}


def test_only_names_that_the_engine_gives_are_put_right(done: Run) -> None:
    """Other names below .work stay, and a folder that is no artifact of the stage takes the place of none."""
    good = contents(done.folder("count"))
    work = done.path / WORK
    for name in ("old-", "old-..", "old-count-2", "old-Notes", "old-notes", "trash-x", "trash-", "notes"):
        (work / name).mkdir()
        (work / name / "a").write_text("a")
    (done.path / "notes").mkdir()
    (done.path / "notes" / "mine.txt").write_text("mine")
    shutil.copytree(done.folder("list"), work / "old-count")
    (work / f"trash-{'a' * 16}").mkdir()
    (work / "trash-12-3456").mkdir()
    artifact.recover(done.path, [stage.name for stage in STAGES])
    assert {path.name for path in work.iterdir()} == {"old-", "old-..", "old-count-2", "old-Notes", "old-notes", "trash-x", "trash-", "notes", "count"}
    assert contents(done.folder("count")) == good
    assert (done.path / "notes" / "mine.txt").read_text() == "mine"
    run_stages(done, STAGES)
    verify(done, STAGES)


@pytest.mark.parametrize("name", [*WORKPLACES[1:], "count", "double"])
def test_a_file_in_the_place_of_a_folder_is_replaced(done: Run, name: str) -> None:
    there(done, name).write_text("a file")
    run_stages(done, STAGES)
    verify(done, STAGES)
    assert os.listdir(done.path / WORK) == []


@pytest.mark.parametrize("there", [True, False])
def test_what_is_set_aside_counts_only_if_it_is_an_artifact_of_the_stage(done: Run, there: bool) -> None:
    for name in ("count", "double"):
        shutil.copytree(done.folder("list"), done.path / WORK / f"old-{name}")  # a sealed artifact, of another stage
    if not there:
        shutil.rmtree(done.folder("count"))
    assert len(artifact.recover(done.path, [stage.name for stage in STAGES])) == 2
    assert done.folder("count").exists() == there
    assert read_manifest(done.folder("double")).request.stage == "double"
    run_stages(done, STAGES)
    verify(done, STAGES)
