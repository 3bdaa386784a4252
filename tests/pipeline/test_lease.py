"""A lease is held by one process at a time, whatever dies, sleeps or is slow; other machines are played by another name for this one."""

import contextlib
import errno
import fcntl
import json
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from pipeline.errors import CorruptArtifact, RunLocked
from pipeline.locks import lease
from pipeline.locks.lease import EXPIRY, Held, Lease, acquire
from pipeline.locks.lock import holder_of, lock
from pipeline.run import Run
from pipeline.runner import run_stages
from tests.pipeline.toy import STAGES, make_run

ROOT = Path(__file__).resolve().parents[2]


@contextmanager
def on(machine: str) -> Iterator[None]:
    """As another machine."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lease, "machine", lambda: machine)
        yield


def age(folder: Path, seconds: float) -> None:
    """Let the lease be as old as if its machine had been cut off for so long."""
    newest = max((folder / ".lease").iterdir(), key=lambda path: int(path.name) if path.name.isdigit() else -1)
    before = os.stat(newest).st_mtime - seconds
    os.utime(newest, (before, before))


def test_another_machine_waits_until_the_lease_has_expired(tmp_path: Path) -> None:
    with on("a"):
        acquire(tmp_path, decisive=True).release()
        held = acquire(tmp_path, decisive=True)  # what was given back is free at once
    age(tmp_path, EXPIRY + 1)
    held.beat()  # and is young again
    with on("b"):
        with pytest.raises(Held):
            acquire(tmp_path, decisive=True)
        age(tmp_path, EXPIRY - 5)
        with pytest.raises(Held) as found:
            acquire(tmp_path, decisive=True)
        assert EXPIRY - 6 < found.value.age < EXPIRY
        age(tmp_path, 6)
        other = acquire(tmp_path, decisive=True)
    assert [path.name for path in (tmp_path / ".lease").iterdir()] == ["3"]
    held.beat()
    assert held.lost()
    held.release()  # touches nothing of the other's
    other.beat()
    assert other.lost() is None
    other.path.unlink()
    other.beat()
    assert other.lost()
    other.release()


def test_who_has_this_machines_lock_takes_over_from_a_dead_process_at_once(tmp_path: Path) -> None:
    dead = acquire(tmp_path, decisive=True)
    with pytest.raises(Held):  # without such locks nobody knows that it is dead
        acquire(tmp_path, decisive=False)
    acquire(tmp_path, decisive=True).release()
    dead.beat()
    assert dead.lost() is not None
    dead.release()


def test_a_slow_taker_of_an_old_lease_gets_no_number_that_was_passed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Between its look and its link others take over twice, and remove the lower numbers: its own link succeeds, and counts for nothing."""
    with on("a"):
        acquire(tmp_path, decisive=True).release()
    created, later = lease._create, []

    def slow(aside: Path, path: Path) -> bool:
        monkeypatch.setattr(lease, "_create", created)
        with on("c"):
            acquire(tmp_path, decisive=True).release()
            later.append(acquire(tmp_path, decisive=True))
        return created(aside, path)

    monkeypatch.setattr(lease, "_create", slow)
    with on("b"), pytest.raises(Held):
        acquire(tmp_path, decisive=True)
    later[0].beat()
    assert later[0].lost() is None
    assert [path.name for path in (tmp_path / ".lease").iterdir()] == ["3"]
    later[0].release()


@pytest.mark.parametrize("links", [True, False])
def test_of_many_at_once_one_gets_it(tmp_path: Path, links: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*arguments: object, **more: object) -> None:
        raise OSError(errno.EPERM, "no links here")

    if not links:
        monkeypatch.setattr(os, "link", refused)
    barrier, got = threading.Barrier(12), []

    def take() -> None:
        barrier.wait()
        with contextlib.suppress(Held):
            got.append(acquire(tmp_path, decisive=False))

    for _ in range(3):
        threads = [threading.Thread(target=take) for _ in range(12)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert len(got) == 1
        got.pop().release()


def test_a_lease_that_cannot_be_renewed_is_given_up_in_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    held = acquire(tmp_path, decisive=True)
    now = lease.time.monotonic()

    def failing(*arguments: object) -> None:
        raise OSError(5, "Input/output error")

    with monkeypatch.context() as patch:
        patch.setattr(lease.os, "utime", failing)
        for late in (-1, 1):
            patch.setattr(lease.time, "monotonic", lambda late=late: now + EXPIRY + late)
            held.beat()
            assert bool(held.lost()) == (late > 0)
    held.release()


def test_what_a_stranger_left_in_it_is_no_lease(tmp_path: Path) -> None:
    (tmp_path / ".lease").mkdir()
    for name in ("x", "-1", "1.5", "٣", "1" * 30, "a.part"):
        (tmp_path / ".lease" / name).write_text("[" * 1000)
    held = acquire(tmp_path, decisive=True)
    assert held.number == 1
    held.release()
    (tmp_path / ".lease" / ("1" + "0" * 15)).write_text("{}")  # a number that no count reaches
    with pytest.raises(CorruptArtifact):
        acquire(tmp_path, decisive=True)


def test_a_run_says_who_holds_it(tmp_path: Path) -> None:
    run = Run.create(tmp_path / "run")
    other = Run.open(run.path)
    with on("a"), run.locked():
        (run.path / ".lock").unlink()  # another machine does not see this one's lock
        with on("b"), pytest.raises(RunLocked, match=rf"process {os.getpid()} on .* \d s ago"), other.locked():
            pass


def test_a_process_of_another_machine_that_renews_nothing_has_ended(tmp_path: Path) -> None:
    note = {"pid": 1, "host": "elsewhere", "since": 1.0, "command": "enerf"}
    (tmp_path / ".lock.json").write_text(json.dumps(note))
    assert holder_of(tmp_path) is not None, "of a version without leases"
    with on("a"):
        held = acquire(tmp_path, decisive=True)
    assert holder_of(tmp_path) is not None
    held._done.set()
    age(tmp_path, 11 * EXPIRY)
    assert holder_of(tmp_path) is None


@pytest.mark.parametrize("number", [errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP])
def test_without_locks_of_the_system_the_lease_alone_decides(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    def refused(*arguments: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(fcntl, "flock", refused)
    for _ in range(2):
        with lock(tmp_path), pytest.raises(RunLocked), lock(tmp_path):
            pass
    killed = acquire(tmp_path, decisive=False)
    killed._done.set()
    with pytest.raises(RunLocked), lock(tmp_path):
        pass
    age(tmp_path, EXPIRY + 1)
    with lock(tmp_path) as held:
        assert held.lost() is None


def test_who_lost_the_lease_publishes_nothing(tmp_path: Path) -> None:
    run = make_run(tmp_path)
    taken: list[Lease] = []

    def take_over(event: dict[str, object]) -> None:
        if event["event"] == "stage_started" and event["stage"] == "count":
            age(run.path, EXPIRY + 1)
            with on("b"):
                taken.append(acquire(run.path, decisive=True))
            assert run._lease is not None
            run._lease.beat()

    with on("a"), pytest.raises(RunLocked):
        run_stages(run, STAGES, report=take_over)
    assert (run.path / "list").is_dir()
    assert not (run.path / "count").exists()
    taken[0].beat()
    assert taken[0].lost() is None
    taken[0].release()


def test_a_killed_process_blocks_nobody_on_its_machine(tmp_path: Path) -> None:
    for _ in range(2):
        pid = os.fork()
        if pid == 0:
            with lock(tmp_path):
                os.kill(os.getpid(), 9)
        assert os.waitpid(pid, 0)[1] == 9
    with lock(tmp_path) as held:
        assert held.lost() is None
