"""Ways to call the command line in tests."""

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.workflows.command import Result
from tests.workflows.fleet_child import CHILD, PRESETS
from tests.workflows.toys import TOYS
from workflows.cli.main import main
from workflows.workflow import Workflow


@pytest.fixture
def enerf(capfd: pytest.CaptureFixture[str], request: pytest.FixtureRequest) -> Callable[..., Result]:
    """enerf("run", ...) in this process, on the toy workflow where the test has `toys`."""
    workflow = Workflow(TOYS, request.getfixturevalue("toys").parent / "presets", CHILD) if "toys" in request.fixturenames else None

    def call(*arguments: object) -> Result:
        capfd.readouterr()
        code = main([str(argument) for argument in arguments], workflow)
        out, err = capfd.readouterr()
        return Result(code, out, err)

    return call


@pytest.fixture
def toys(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A source for the toy workflow, with presets beside it."""
    presets = tmp_path / "presets"
    presets.mkdir()
    (presets / "preview.toml").write_text('description = "Toy."\n[train]\niterations = 3\n', encoding="utf-8")
    (presets / "tiny.toml").write_text('description = "Smaller toy."\n[train]\niterations = 1\nrate = 2\n', encoding="utf-8")
    monkeypatch.setattr("workflows.cli.device.cuda_device_count", lambda: 0)
    monkeypatch.setenv(PRESETS, str(presets))
    source = tmp_path / "source"
    source.mkdir()
    (source / "a.txt").write_text("words", encoding="utf-8")
    return source
