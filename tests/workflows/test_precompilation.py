"""Kernels are compiled in the background: those of the run, by a process that ends with it and never disturbs it."""

import os
import subprocess
import time
from pathlib import Path
from typing import Any

import pytest

from pipeline.executors.local import Usage
from pipeline.executors.memory import Limit
from workflows.asset import WORKFLOW
from workflows.cli.resolve import Settings, read_preset, table_of
from workflows.precompilation import run, start


def settings(*sets: str) -> dict[str, dict[str, Any]]:
    built = Settings(WORKFLOW.settings)
    built.put_table(read_preset("preview", WORKFLOW.presets).table, "preset preview")
    for text in sets:
        built.put_option(text)
    return table_of(built.resolved())


def test_the_choices_of_the_run_are_compiled_at_the_sizes_of_a_small_one() -> None:
    chosen = settings("train.field=mlp", "bake.layout=packed", "mesh.texture=asset", "splats.make=on", "bake.resolution=512", "poses.up=z")
    small, tiny = start.small_settings(chosen), start.small_settings(settings())
    assert (small["train"]["field"], small["bake"]["layout"], small["mesh"]["texture"], small["splats"]["make"]) == ("mlp", "packed", "asset", "on")
    assert small["poses"] == tiny["poses"]
    assert small["bake"]["resolution"] == tiny["bake"]["resolution"] < 64
    assert small["train"]["iterations"] == tiny["train"]["iterations"] < 100
    for stage in WORKFLOW.stages:
        numbers = {name for name, value in tiny[stage.name].items() if not isinstance(value, str | bool)}
        assert {name: small[stage.name][name] for name in numbers} == {name: tiny[stage.name][name] for name in numbers}


def test_nothing_is_started_where_it_is_not_worth_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[Any] = []
    monkeypatch.setattr(start, "start", lambda table: started.append(table))

    def ran(memory: Limit | None, cores: int, stages: int) -> bool:
        started.clear()
        monkeypatch.setattr(start, "cores", lambda: cores)
        with start.precompiling(lambda stage, job: Usage(0.0, 0), settings(), memory) as execute:
            for _ in range(stages):
                execute(None, None)  # type: ignore[arg-type]
        assert len(started) <= 1
        return bool(started)

    assert ran(None, 2, 3)
    assert ran(Limit(start.MEMORY, "this machine"), 2, 1)
    assert not ran(None, 2, 0)  # all stages are up to date
    assert not ran(None, 1, 1)
    assert not ran(Limit(start.MEMORY - 1, "this machine"), 2, 1)


@pytest.mark.skipif(not hasattr(os, "nice"), reason="priorities are POSIX's")
def test_where_a_process_may_not_be_idle_it_is_nice(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError

    steps: list[int] = []
    monkeypatch.setattr(os, "nice", steps.append)
    monkeypatch.setattr(os, "sched_setscheduler", refuse, raising=False)
    run.give_way()
    monkeypatch.delattr(os, "sched_setscheduler")
    run.give_way()
    assert steps == [run.NICE, run.NICE]


@pytest.mark.skipif(not hasattr(os, "nice"), reason="priorities are POSIX's")
def test_the_process_ends_with_the_run_and_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ENERF_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setenv("TMPDIR", str(tmp_path / "temporary"))
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.delenv(start.SWITCH)
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr(start.kernel_cache, "folder_of", lambda *_: tmp_path)  # without a stamp
    process = start.start(settings())
    assert process is not None
    assert process.stdin is not None
    folder, deadline = tmp_path / "temporary", time.monotonic() + 60
    while not any(folder.glob("*/run/run.json")):
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.05)
    if hasattr(os, "SCHED_IDLE"):
        assert os.sched_getscheduler(process.pid) == os.SCHED_IDLE
    else:
        assert os.getpriority(os.PRIO_PROCESS, process.pid) == min(os.getpriority(os.PRIO_PROCESS, 0) + 10, 19)
    process.stdin.close()
    try:
        assert process.wait(timeout=10) == 0
    except subprocess.TimeoutExpired:
        process.kill()
        raise
    assert not any(folder.iterdir())
