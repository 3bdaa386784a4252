import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from pipeline.errors import BadInput, RunLocked
from pipeline.locks.lock import holder_of
from pipeline.run import Run
from tests.pipeline.toy import contents

HOLD = """
import sys, time
from pathlib import Path
from pipeline.run import Run
with Run.open(Path(sys.argv[1])).locked():
    print("held", flush=True)
    time.sleep(60)
"""


def holding(run: Run) -> subprocess.Popen[str]:
    process = subprocess.Popen([sys.executable, "-c", HOLD, str(run.path)], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    return process


def test_a_second_writer_is_told_the_holder_and_a_dead_one_blocks_nobody(tmp_path: Path) -> None:
    run = Run.create(tmp_path / "run")
    with holding(run) as process:
        with pytest.raises(RunLocked, match=rf"process {process.pid} on ") as caught, run.locked():
            pass
        assert caught.value.exit_code == 5
        with pytest.raises(RunLocked):
            run.update(preset="high")
        holder = holder_of(run.path)
        assert holder is not None
        assert holder.pid == process.pid
        assert Run.open(run.path).preset is None  # reading needs no lock
        os.kill(process.pid, signal.SIGKILL)
    assert (run.path / ".lock.json").exists()
    assert holder_of(run.path) is None
    with run.locked():
        pass
    assert not (run.path / ".lock.json").exists()


@pytest.mark.parametrize("text", ["", "[]", '{"pid": -5, "host": "x"}', '{"pid": "x", "host": "", "since": 1, "command": ""}'])
def test_a_damaged_note_of_the_holder_is_ignored(tmp_path: Path, text: str) -> None:
    run = Run.create(tmp_path / "run")
    (run.path / ".lock.json").write_text(text)
    assert holder_of(run.path) is None
    with run.locked():
        pass
    (run.path / ".lock").unlink()
    (run.path / ".lock").mkdir()
    with pytest.raises(BadInput), run.locked():
        pass
    assert contents(run.path).keys() == {"run.json"}
