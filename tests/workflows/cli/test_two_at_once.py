"""Two commands on one run: what is recorded is what was run with."""

import json
from pathlib import Path

import pytest

from pipeline.errors import RunLocked
from pipeline.manifest import read_manifest
from pipeline.run import Run
from tests.workflows.command import Enerf
from workflows.cli.request import Options, plan_run
from workflows.workflow import Workflow


def recorded(run: Path) -> dict[str, dict[str, object]]:
    settings: dict[str, dict[str, object]] = json.loads((run / "run.json").read_text())["settings"]
    return settings


def test_settings_that_another_run_changed_meanwhile_are_kept(enerf: Enerf, toys: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = tmp_path / "run"
    assert enerf("run", toys, "--out", run).code == 0
    others = [lambda: enerf("run", "--out", run, "--set", "poses.repeat=2")]

    def meanwhile(wanted: str) -> str:
        """Called after the options were read, before the run is locked."""
        if others:
            assert others.pop()().code == 0
        return "cpu"

    monkeypatch.setattr("workflows.cli.run.resolve_device", meanwhile)
    assert enerf("run", "--out", run, "--set", "train.rate=9").code == 0
    assert (recorded(run)["poses"]["repeat"], recorded(run)["train"]["rate"]) == (2, 9)
    for stage in ("poses", "train"):
        assert read_manifest(run / stage).request.settings == recorded(run)[stage]


def test_nobody_changes_the_settings_while_stages_run(toys: Path, tmp_path: Path, enerf: Enerf) -> None:
    from tests.workflows.toys import TOYS

    plan = plan_run(tmp_path / "run", Workflow(TOYS, toys.parent / "presets"), Options(source=toys))
    with plan.written() as run, pytest.raises(RunLocked):
        Run.open(run.path).update(preset="other")
    assert Run.open(tmp_path / "run").preset == "preview"
