"""Pictures whose names are no text, through a run: cameras, training and the report."""

import dataclasses
import json
from pathlib import Path

import pytest

from tests.stages import captures
from tests.workflows.command import Enerf

NAMES = ("img_\udcff\udcfe.png", "img_\nline.png", "img_\x1b[31mred.png", "img_\u202eodd.png", "img_ \t tab.png", "plain.png")
QUICK = {"iterations": 2, "checkpoint_every": 1, "preview_every": 1, "occupancy_warmup_steps": 1, "sample_batch_size": 256, "max_rays_per_batch": 64}


@pytest.mark.parametrize("how", ["nerfstudio", "blender", "colmap bin"])
def test_a_run_on_names_that_are_no_text(enerf: Enerf, tmp_path: Path, how: str) -> None:
    made = [dataclasses.replace(camera, name=name) for camera, name in zip(captures.cameras(), NAMES, strict=True)]
    source = captures.WRITERS[how][1](tmp_path / "source", made)
    settings = [argument for name, value in QUICK.items() for argument in ("--set", f"train.{name}={value}")]
    done = enerf("run", source, "--out", tmp_path / "run", "--preset", "tiny", "--device", "cpu", "--until", "train", *settings)
    assert done.code == 0, done.err
    assert all(character.isprintable() or character == "\n" for character in done.out + done.err)
    report = json.loads((tmp_path / "run/poses/report.json").read_text(encoding="utf-8"))
    assert len(report["registered"]) == 6
    page = (tmp_path / "run/report.html").read_text(encoding="utf-8")
    assert "\x1b" not in page
    again = enerf("run", source, "--out", tmp_path / "run", "--preset", "tiny", "--device", "cpu", "--until", "train", *settings)
    assert again.code == 0
    assert "never run" not in again.err
    status = enerf("status", tmp_path / "run", "--json")
    assert status.code == 0
    assert [stage["state"] for stage in status.object["stages"]][:2] == ["fresh", "fresh"]
