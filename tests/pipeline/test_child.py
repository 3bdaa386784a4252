"""Children of a worker: what a child that dies has started ends with it, on systems without waitid too."""

import os
import time
from pathlib import Path

import pytest

from pipeline.executors.child import Children

DIES = """
import os, subprocess, sys
sys.stdin.readline()
sys.stdin.readline()
left = subprocess.Popen(["sleep", "60"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
print('{"event": "started", "pid": %d}' % left.pid, flush=True)
os._exit(7)
"""


def is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return Path(f"/proc/{pid}/stat").exists() and Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"


@pytest.mark.parametrize("waitid", [True, False])
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="reads /proc")
def test_what_a_dead_child_started_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, waitid: bool) -> None:
    if not waitid:
        monkeypatch.delattr(os, "waitid")
    (tmp_path / "dying_child.py").write_text(DIES)
    monkeypatch.syspath_prepend(tmp_path)
    children, events = Children("dying_child", 2), []
    answer = children.work({"kind": "stage", "run": str(tmp_path / "run"), "stage": "a"}, events.append, cores=1)
    assert (answer["kind"], answer["text"]) == ("died", "its process ended with exit code 7 and no answer.")
    (left,) = (event["pid"] for event in events)
    deadline = time.monotonic() + 10
    while is_alive(left) and time.monotonic() < deadline:
        time.sleep(0.02)
    assert not is_alive(left)
    children.close()
