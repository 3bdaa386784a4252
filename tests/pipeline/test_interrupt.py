import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from pipeline.interrupt import stopping
from pipeline.run import Run
from pipeline.runner import run_stages
from tests.pipeline.toy import STAGES, make_run

# Runs the toy workflow, slowed down so that signals meet it at work, as a command line would.
SCRIPT = """
import ctypes, sys, time
from dataclasses import replace
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from pipeline.errors import PipelineError
from pipeline.run import Run
from pipeline.runner import run_stages
from tests.pipeline.toy import STAGES

def slow(stage):
    def run(job):
        point = job.safe_point
        def safe_point():
            time.sleep(0.02)
            point()
        job.safe_point = safe_point
        print(stage.name, flush=True)
        time.sleep(0.02)
        stage.run(job)
        time.sleep(0.02)
    return replace(stage, run=run)

def deaf(job):
    print("deaf", flush=True)
    if sys.argv[2] == "foreign":
        ctypes.CDLL(None).sleep(20)
    end = time.monotonic() + 20
    while time.monotonic() < end:
        time.sleep(0.01)

stages = [replace(s, run=deaf) if s.name == "count" and sys.argv[2] != "slow" else slow(s) for s in STAGES]
try:
    run_stages(Run.open(Path(sys.argv[1])), stages)
except PipelineError as error:
    print(error, flush=True)
    sys.exit(error.exit_code)
print("done", flush=True)
"""


def start(run: Run, how: str) -> subprocess.Popen[str]:
    return subprocess.Popen([sys.executable, "-c", SCRIPT, str(run.path), how], stdout=subprocess.PIPE, text=True)


def await_line(process: subprocess.Popen[str], line: str) -> None:
    assert process.stdout is not None
    while (found := process.stdout.readline().strip()) != line:
        assert found, f"ended before it said {line!r}"


def test_the_first_signal_sets_the_flag_and_the_handlers_are_restored() -> None:
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    with stopping() as stop:
        assert stop() is None
        os.kill(os.getpid(), signal.SIGTERM)
        os.kill(os.getpid(), signal.SIGINT)
        assert stop() == signal.SIGTERM
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == before
    assert not [thread for thread in threading.enumerate() if thread.name == "second Ctrl-C"]
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with stopping() as stop:  # what is ignored stays so
            os.kill(os.getpid(), signal.SIGINT)
            os.kill(os.getpid(), signal.SIGINT)
            assert stop() is None
        assert signal.getsignal(signal.SIGINT) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before[0])


def test_a_worker_that_was_forked_ends_as_usual() -> None:
    """At once after the fork, too; and the Ctrl-C that a terminal sends to workers as well is not counted for the parent."""
    with stopping() as stop:
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGINT):
            pid = os.fork()
            if pid == 0:
                try:
                    time.sleep(30)
                finally:
                    os._exit(9)
            os.kill(pid, number)
            assert os.waitpid(pid, 0)[1] == number
        time.sleep(0.1)  # longer than it takes for a second Ctrl-C to end this process
        assert stop() is None


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_stops_at_the_next_safe_point_and_the_next_run_goes_on(tmp_path: Path, number: int, code: int) -> None:
    run = make_run(tmp_path, count={"steps": 100})
    with start(run, "slow") as process:
        await_line(process, "count")
        time.sleep(0.15)
        process.send_signal(number)
        assert process.stdout is not None
        assert run.how_to_resume() in process.stdout.read()
        assert process.wait(10) == code
    assert not (run.path / ".lock.json").exists()
    (checkpoint,) = (run.path / ".work" / "count").glob("*/scratch/state.txt")
    assert 1 <= len(checkpoint.read_text().splitlines()) < 100
    assert run_stages(run, STAGES)[1].reason == "incomplete: cut short; it goes on where it stopped"


@pytest.mark.parametrize("how", ["deaf", "foreign"])
def test_a_second_ctrl_c_ends_at_once_even_within_a_foreign_call(tmp_path: Path, how: str) -> None:
    run = make_run(tmp_path)
    with start(run, how) as process:
        await_line(process, "deaf")
        time.sleep(0.1)
        process.send_signal(signal.SIGINT)
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(0.3)
        process.send_signal(signal.SIGINT)
        assert process.wait(10) == 130
    assert [outcome.action for outcome in run_stages(run, STAGES)] == ["skipped", "ran", "ran", "ran"]
