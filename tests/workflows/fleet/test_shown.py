"""What `enerf fleet` writes beside the runs, on toy scenes."""

from __future__ import annotations

import csv
import io
import json
import os
import shutil
from pathlib import Path

import pytest

from pipeline.fleet.state import is_scene_name
from pipeline.run import Run
from pipeline.runner import verify
from tests.workflows.command import Enerf
from tests.workflows.fleet.fleets import facts, mixed
from tests.workflows.toys import TOYS
from workflows.fleet.display import Show
from workflows.fleet.pages import updates
from workflows.fleet.table import LiveTable


@pytest.fixture
def manifest(toys: Path, tmp_path: Path) -> Path:
    """Two scenes, of which the second has no text."""
    shutil.copytree(toys, tmp_path / "shoots" / "good")
    (tmp_path / "shoots" / "bad").mkdir()
    (tmp_path / "shoots" / "fleet.toml").write_text("[scenes.good]\nsource = 'good'\n[scenes.bad]\nsource = 'bad'\n", encoding="utf-8")
    return tmp_path / "shoots" / "fleet.toml"


def test_a_sweep_is_run_shared_and_shown(enerf: Enerf, manifest: Path, tmp_path: Path) -> None:
    fleet = tmp_path / "fleet"
    sweeps = ("--sweep", "train.iterations=1,2", "--sweep", "points.seed=3,4")
    assert enerf("fleet", manifest, "--out", fleet, "--preset", "tiny", *sweeps).code == 3
    names = [f"good--iterations-{steps}--seed-{seed}" for steps in (1, 2) for seed in (3, 4)]
    found = {scene["name"]: scene for scene in json.loads((fleet / "fleet.json").read_text())["scenes"]}
    assert {name for name, scene in found.items() if scene["state"] == "done"} == set(names)
    for name in names:
        assert len(verify(Run.open(fleet / name), TOYS)) == 3
        assert os.path.samefile(fleet / name / "poses" / "text.txt", fleet / names[0] / "poses" / "text.txt")
    assert os.path.samefile(fleet / names[3] / "train" / "field.txt", fleet / names[2] / "train" / "field.txt")
    assert not os.path.samefile(fleet / names[2] / "train" / "field.txt", fleet / names[0] / "train" / "field.txt")
    shown = facts((fleet / "index.html").read_text("utf-8"))
    assert {scene["name"]: scene["state"] for scene in shown["scenes"]} == {name: scene["state"] for name, scene in found.items()}
    assert (shown["state"], shown["sweep"]) == ("failed", ["points.seed", "train.iterations"])
    rows = list(csv.DictReader(io.StringIO((fleet / "fleet.csv").read_text("utf-8"))))
    assert [(row["name"], row["train.iterations"]) for row in rows][:4] == [(name, name.split("-")[3]) for name in names]
    assert "train.iterations, points.seed. 4 of 8 runs are done." in (fleet / "comparison.html").read_text("utf-8")
    before = {name: (fleet / name / "points" / "points.ply").stat().st_ino for name in names}
    assert enerf("fleet", manifest, "--out", fleet, "--preset", "tiny", *sweeps).code == 3
    assert {name: (fleet / name / "points" / "points.ply").stat().st_ino for name in names} == before


def test_a_fleet_goes_on_without_its_damaged_json(enerf: Enerf, manifest: Path, tmp_path: Path) -> None:
    fleet = tmp_path / "fleet"
    assert enerf("fleet", manifest, "--out", fleet).code == 3
    (fleet / "fleet.json").write_text("{")
    told = enerf("fleet", manifest, "--out", fleet)
    assert told.code == 4
    assert "Remove it and give the fleet's command again" in told.err
    (fleet / "fleet.json").unlink()
    assert enerf("fleet", manifest, "--out", fleet).code == 3
    (fleet / "fleet.json").unlink()
    (fleet / "thesis.txt").write_text("years of work")
    assert enerf("fleet", manifest, "--out", fleet).code == 2


def test_a_source_elsewhere_needs_the_operators_word(enerf: Enerf, toys: Path, manifest: Path, tmp_path: Path) -> None:
    manifest.write_text(f"[scenes.a]\nsource = '{toys}'\n", encoding="utf-8")
    told = enerf("fleet", manifest, "--out", tmp_path / "fleet")
    assert told.code == 2
    assert "--root" in told.err
    assert not (tmp_path / "fleet").exists()
    assert enerf("fleet", manifest, "--out", tmp_path / "fleet", "--root", toys).code == 0


def test_pages_are_no_names_of_scenes() -> None:
    assert not any(map(is_scene_name, [*updates.FILES, *map(str.upper, updates.FILES), "fleet.json", "run.json"]))


def test_names_are_those_that_a_file_system_has() -> None:
    assert is_scene_name("é" * 100)
    assert not is_scene_name("椅" * 100)


def test_a_terminal_has_the_table_and_what_goes_wrong_above_it(tmp_path: Path) -> None:
    from rich.console import Console

    out = io.StringIO()
    with LiveTable(Console(file=out, width=100, height=12, force_terminal=True, color_system=None)) as table:
        show = Show(tmp_path, as_json=False, quiet=False, table=table)
        show.written(mixed(10))
        show({"event": "stage_done", "scene": "scene-007", "stage": "train", "seconds": 3.0})
        show({"event": "retry", "scene": "scene-007", "stage": "train", "text": "memory ran out"})
    assert "scene-007: memory ran out" in out.getvalue()
    assert "train done in" not in out.getvalue()
    assert (tmp_path / "index.html").is_file()


def test_pages_that_cannot_be_written_are_told_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    show = Show(tmp_path / "nowhere", as_json=False, quiet=True)
    for _ in range(3):
        show.written(mixed(10, state="done"))
    assert capsys.readouterr().err.count("cannot be written") == 1
