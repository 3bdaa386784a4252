"""Begins the compilation of kernels in the background where it is worth it. Imports little: `enerf run` calls it at once."""

import contextlib
import hashlib
import json
import os
import subprocess
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from efficientnerf.backends import kernel_cache
from pipeline.executors.cores import VARIABLES, cores
from pipeline.executors.local import Usage
from pipeline.executors.memory import Limit, limit_for
from pipeline.executors.pipes import command_for
from pipeline.runner import Executor
from pipeline.stage import Job, Stage
from workflows.asset import WORKFLOW
from workflows.cli.resolve import Settings, Table, read_preset, table_of

REQUEST = "ENERF_PRECOMPILATION"  # how the process is told what to compile
USUAL = "preview"  # preset
SWITCH = "ENERF_PRECOMPILE"  # off: kernels are compiled when they are needed
END_SECONDS = 5.0  # seconds that the process has to end
MEMORY = 4 << 30  # bytes that a run has to have: the other process takes up to a third of it


# Over the preset tiny: what no kernel depends on, and takes long.
SMALLER: Table = {
    "mesh": {"texture_size": 256},
    "train": {"time_budget": "off"},
    "bake": {"time_budget": "off", "max_mib": "auto"},
    "splats": {"time_budget": "off"},
    "evaluate": {"lpips": "off"},
}


def small_settings(settings: Table) -> dict[str, dict[str, Any]]:
    """The preset tiny with the choices of these settings. Those of poses are left out: they tell how a source is read."""
    built = Settings(WORKFLOW.settings)
    tiny = read_preset("tiny", WORKFLOW.presets).table
    built.put_table(tiny, "preset tiny")
    small = table_of(built.resolved())
    for stage, table in settings.items():
        if stage != "poses":
            own = _choices(small[stage])
            built.put_table({stage: {name: value for name, value in _choices(table).items() if name in own}}, "the run")
    built.put_table({**SMALLER, "poses": {"format": "colmap"}}, "precompilation")
    return table_of(built.resolved())


@contextlib.contextmanager
def precompiling(execute: Executor, settings: Table, memory: Limit | None) -> Iterator[Executor]:
    """The executor within; when it runs its first stage, the kernels of all stages begin to be compiled in the background, until this is left.

    settings  of all stages, by stage; their choices tell which kernels there are
    memory    that the run may take; None: no limit is known
    """
    worth_it = _is_worth_it(memory)
    begun: list[subprocess.Popen[bytes] | None] = []

    def executed(stage: Stage, job: Job) -> Usage:
        if worth_it and not begun:
            begun.append(start(settings))
        return execute(stage, job)

    try:
        yield executed
    finally:
        for process in begun:
            if process is not None and process.stdin is not None:
                process.stdin.close()  # it ends itself
                try:
                    process.wait(END_SECONDS)
                except subprocess.TimeoutExpired:
                    process.kill()
                    process.wait()


def start_alone() -> None:
    """Compile the kernels of runs with the usual settings, in a process that goes on when this one ends."""
    usual = Settings(WORKFLOW.settings)
    usual.put_table(read_preset(USUAL, WORKFLOW.presets).table, f"preset {USUAL}")
    if _is_worth_it(limit_for(None, None)):
        start(table_of(usual.resolved()), detached=True)


def start(settings: Table, *, detached: bool = False) -> subprocess.Popen[bytes] | None:
    """Start the process; None where there is nothing to compile, or where it cannot be started.

    detached  it goes on when this process ends
    """
    small = small_settings(settings)
    if os.environ.get(SWITCH) == "off" or stamp_of(small).exists():
        return None
    environment = {**os.environ, **dict.fromkeys(VARIABLES, "1"), REQUEST: json.dumps({"settings": small, "detached": detached})}
    streams: dict[str, Any] = {"stdin": subprocess.DEVNULL if detached else subprocess.PIPE, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    # A session of its own would have as much of the processors as ours where Linux groups processes by session; a group of its own hears no Ctrl-C.
    where: dict[str, Any] = {"start_new_session": True} if detached else {"process_group": 0}
    try:
        return subprocess.Popen(command_for("workflows.precompilation.run"), env=environment, **streams, **where)
    except OSError:
        return None


def stamp_of(small: Table) -> Path:
    """The file that says that the kernels of a run with these settings are compiled, of sources as they are."""
    place = kernel_cache.folder_of("precompilation", kernel_cache.key_of_kernels())
    return place / hashlib.sha256(json.dumps(small, sort_keys=True).encode()).hexdigest()[:16]


def _is_worth_it(memory: Limit | None) -> bool:
    return cores() > 1 and (memory is None or memory.bytes >= MEMORY)


def _choices(table: Mapping[str, Any]) -> dict[str, Any]:
    """Settings that are words or switches. Numbers change how much is computed, and not by which kernels."""
    return {name: value for name, value in table.items() if isinstance(value, str | bool)}
