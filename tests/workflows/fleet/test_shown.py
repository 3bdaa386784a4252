"""What `enerf fleet` writes beside the runs, on toy scenes."""

import csv
import io
import json
import os
import shutil
from pathlib import Path

import pytest

from pipeline.run import Run
from pipeline.runner import verify
from tests.workflows.command import Enerf
from tests.workflows.fleet.fleets import facts
from tests.workflows.toys import TOYS


@pytest.fixture
def manifest(toys: Path, tmp_path: Path) -> Path:
    """Two scenes, of which the second has no text."""
    shutil.copytree(toys, tmp_path / "shoots" / "good")
    (tmp_path / "shoots" / "bad").mkdir()
    (tmp_path / "shoots" / "fleet.toml").write_text("[scenes.good]\nsource = 'good'\n[scenes.bad]\nsource = 'bad'\n", encoding="utf-8")
    return tmp_path / "shoots" / "fleet.toml"


def test_a_sweep_is_run_shared_and_shown(enerf: Enerf, manifest: Path, tmp_path: Path) -> None:
    fleet = tmp_path / "fleet"
    command = ("fleet", manifest, "--out", fleet, "--preset", "tiny", "--sweep", "train.iterations=1,2", "--sweep", "points.seed=3,4")
    assert enerf(*command).code == 3
    names = [f"good--iterations-{steps}--seed-{seed}" for steps in (1, 2) for seed in (3, 4)]
    found = {scene["name"]: scene for scene in json.loads((fleet / "fleet.json").read_text())["scenes"]}
    assert {name for name, scene in found.items() if scene["state"] == "done"} == set(names)

    def same(stage: str, one: int, other: int) -> bool:
        return all(map(os.path.samefile, *(sorted((fleet / names[number] / stage).glob("*.txt")) for number in (one, other))))

    assert all(len(verify(Run.open(fleet / name), TOYS)) == 3 and same("poses", place, 0) for place, name in enumerate(names))
    assert (same("train", 3, 2), same("train", 2, 0)) == (True, False)
    shown = facts((fleet / "index.html").read_text("utf-8"))
    assert {scene["name"]: scene["state"] for scene in shown["scenes"]} == {name: scene["state"] for name, scene in found.items()}
    assert (shown["state"], shown["sweep"]) == ("failed", ["points.seed", "train.iterations"])
    rows = list(csv.DictReader(io.StringIO((fleet / "fleet.csv").read_text("utf-8"))))
    assert [(row["name"], row["train.iterations"]) for row in rows][:4] == [(name, name.split("-")[3]) for name in names]
    before = {name: (fleet / name / "points" / "points.ply").stat().st_ino for name in names}
    assert enerf(*command).code == 3
    assert {name: (fleet / name / "points" / "points.ply").stat().st_ino for name in names} == before
