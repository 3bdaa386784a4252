"""Children of a worker: what a child that dies has started ends with it, on systems without waitid too."""

from __future__ import annotations

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


SERVES = """
import json, os, sys
sys.stdin.readline()
for line in sys.stdin:
    request = json.loads(line)
    if request["kind"] == "end":
        break
    print("words of " + request["run"], file=sys.stderr, flush=True)
    more = {"resident": request["resident"]} if request["kind"] == "finish" else {}
    print(json.dumps({"event": "result", "ok": True, "pid": os.getpid(), **more}), flush=True)
"""


def test_a_small_child_goes_on_with_the_next_run_and_a_large_one_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "serving_child.py").write_text(SERVES)
    monkeypatch.syspath_prepend(tmp_path)
    children = Children("serving_child", 2)

    def scene(run: str, resident: int | None, gpus: tuple[int, ...] = ()) -> set[int]:
        requests = [{"kind": "prepare", "run": run}, {"kind": "stage", "run": run, "stage": "a"}, {"kind": "finish", "run": run, "resident": resident}]
        answers = [children.work(request, lambda event: None, cores=1, gpus=gpus) for request in requests]
        assert not any("resident" in answer for answer in answers)
        return {answer["pid"] for answer in answers}

    (first,) = scene("a", 2**20)
    assert scene("b", 2**31) == {first}, "kept from a to b"
    (third,) = scene("c", None)
    assert third != first, "b held too much memory"
    assert scene("d", 2**20).isdisjoint({first, third}), "where the system does not say how much, a new one is taken"
    (with_device,) = scene("e", 2**20, gpus=(0,))
    assert with_device not in scene("f", 2**20, gpus=(0,)), "what torch keeps of a device is given back"
    children.close()
    assert not children._children
