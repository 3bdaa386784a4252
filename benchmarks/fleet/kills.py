"""A fleet on Dask whose client, worker and scheduler are killed (SIGKILL) at random moments and started again, until it is done."""

import json
import os
import random
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.fleet.child import JOURNAL, STAGES, WORKFLOW
from pipeline.fleet.state import Scene, read_fleet
from workflows.fleet.running import Placement, run_fleet

VICTIMS = ("client", "worker", "scheduler")
PORT = 18786


def scenes(count: int) -> list[Scene]:
    return [Scene(f"s{number:02d}", ()) for number in range(count)]


def client(fleet: Path, count: int, address: str | None) -> int:
    """The process that runs the fleet."""
    return run_fleet(fleet, scenes(count), WORKFLOW, Placement(jobs=1, scheduler=address)).exit_code


def digests(fleet: Path, count: int) -> dict[str, str]:
    """Of each artifact."""
    paths = [fleet / scene.name / stage.name / "manifest.json" for scene in scenes(count) for stage in STAGES]
    return {str(path.relative_to(fleet)): json.loads(path.read_bytes())["digest"] for path in paths}


def repeated(fleet: Path, count: int) -> dict[str, int]:
    """What was done more than once: stages that ended twice or were begun when they were published, and steps (a kill costs the one since the checkpoint)."""
    lines = [f"{scene.name} {line}" for scene in scenes(count) for line in (fleet / scene.name / JOURNAL).read_text().splitlines()]
    done = Counter((scene, stage, what) for scene, stage, _, what in (line.split(" ", 3) for line in lines))
    ends = {key: number for key, number in done.items() if key[2] == "ended"}
    steps = [number for key, number in done.items() if key[2].startswith("step")]
    assert len(ends) == count * len(STAGES), "a stage has never ended"
    return {
        "stages": len(ends), "stages_ended_more_than_once": sum(number > 1 for number in ends.values()),
        "stages_begun_when_published": sum(" published begun" in line for line in lines),
        "stages_gone_on_with": sum(number - 1 for key, number in done.items() if key[2] == "begun"),
        "steps": len(steps), "steps_done_again": sum(steps) - len(steps),
    }  # fmt: skip


class _Cast:
    """The processes, by role."""

    def __init__(self, folder: Path, fleet: Path, count: int) -> None:
        self.folder, self.fleet, self.count = folder, fleet, count
        self.all: dict[str, subprocess.Popen[bytes]] = {}

    def start(self, role: str) -> None:
        address = f"tcp://127.0.0.1:{PORT}"
        commands = {
            "scheduler": ["distributed.cli.dask_scheduler", "--port", str(PORT), "--host", "127.0.0.1", "--no-dashboard"],
            "worker0": ["distributed.cli.dask_worker", address, "--nthreads", "1", "--no-dashboard", "--no-nanny", "--death-timeout", "120"],
            "client": ["benchmarks.fleet", "client", "--folder", str(self.fleet), "--scenes", str(self.count), "--scheduler", address],
        }
        module, *arguments = commands.get(role) or commands["worker0"]
        with (self.folder / f"{role}.log").open("ab") as log:
            self.all[role] = subprocess.Popen([sys.executable, "-m", module, *arguments], stdout=log, stderr=log, cwd=self.folder)

    def kill(self, role: str) -> bool:
        """Whether it still ran."""
        process = self.all[role]
        if process.poll() is not None:
            return False
        process.send_signal(signal.SIGKILL)
        process.wait()
        return True

    def revive(self) -> None:
        """Start again what has ended, by itself too: a worker ends with its scheduler."""
        for role, process in list(self.all.items()):
            if process.poll() is not None and not (role == "client" and process.returncode in (0, 3)):
                self.start(role)


def kill(folder: Path, kills: int, count: int, seed: int, longest: float) -> dict[str, Any]:
    """Kill until the fleet is done; compare with an undisturbed one. longest: seconds."""
    plain, fleet, chance = folder / "undisturbed", folder / "fleet", random.Random(seed)
    folder.mkdir(parents=True, exist_ok=True)
    assert client(plain, count, None) == 0
    cast, done, began = _Cast(folder, fleet, count), dict.fromkeys(VICTIMS, 0), time.monotonic()
    for role in ("scheduler", "worker0", "worker1", "client"):
        cast.start(role)
    try:
        while cast.all["client"].poll() not in (0, 3) and time.monotonic() - began < longest:
            pause = time.monotonic() + chance.uniform(4.0, 15.0)
            while time.monotonic() < pause and cast.all["client"].poll() not in (0, 3):
                cast.revive()
                time.sleep(0.5)
            if sum(done.values()) < kills and cast.all["client"].poll() is None:
                victim = chance.choice(VICTIMS)
                done[victim] += cast.kill(f"worker{chance.randrange(2)}" if victim == "worker" else victim)
        code = cast.all["client"].poll()
    finally:
        for process in cast.all.values():
            process.kill()
    again = client(fleet, count, None)  # what was given up by two deaths in one stage
    state = read_fleet(fleet)
    assert not _left_behind(fleet), "processes of the fleet are left"
    return {
        "kills": done, "scenes": count, "seconds": time.monotonic() - began, "client_exit_code": code, "exit_code_after_the_same_command": again,
        "quarantined": [scene.reason for scene in state.scenes if scene.state == "quarantined"],
        "digests_equal": again == 0 and digests(fleet, count) == digests(plain, count),
        "repeated": repeated(fleet, count) if again == 0 else None,
    }  # fmt: skip


def _left_behind(fleet: Path) -> Sequence[int]:
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit() and int(entry.name) != os.getpid():
            try:
                command = (entry / "cmdline").read_bytes()
            except OSError:
                continue
            if b"benchmarks.fleet" in command and str(fleet).encode() in command:
                found.append(int(entry.name))
    return found
