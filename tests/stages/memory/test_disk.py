"""What stages write, foretold: fleets admit them by it."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest

from stages.memory.disk import LEAST, space_needed
from workflows.asset import STAGES

DEFAULTS: dict[str, Any] = {stage.name: stage.settings() for stage in STAGES}


def folder_of(where: Path, count: int) -> Path:
    where.mkdir()
    for number in range(count):
        (where / f"{number:03}.jpg").write_bytes(bytes(3_000_000))
    return where


@pytest.mark.parametrize("stage", [stage.name for stage in STAGES])
def test_every_stage_is_foretold_by_its_defaults(stage: str, tmp_path: Path) -> None:
    source = folder_of(tmp_path / "photographs", 4)
    needed = space_needed(stage, tmp_path / "run", (source,), DEFAULTS)
    assert isinstance(needed, int)
    assert LEAST <= needed < 20 * 2**30


def test_more_photographs_need_more_room(tmp_path: Path) -> None:
    few, many = (space_needed("poses", tmp_path / "run", (folder_of(tmp_path / str(count), count),), DEFAULTS) for count in (20, 80))
    assert 2 * few < many < 4 * few, "beyond 60 photographs half as many features of each"


def test_a_video_needs_the_room_of_its_frames(tmp_path: Path) -> None:
    clip = tmp_path / "clip.mp4"
    clip.write_bytes(bytes(1000))
    one = space_needed("poses", tmp_path / "run", (clip,), DEFAULTS)
    assert one > 50 * 2**20
    assert space_needed("poses", tmp_path / "run", (clip, clip), DEFAULTS) == one, "poses.frames are of all videos together"
    for name in ("notes.txt", "imu.csv", "times.json"):
        (tmp_path / name).write_bytes(bytes(10))
    assert space_needed("poses", tmp_path / "run", (tmp_path,), DEFAULTS) == one, "a folder with a video and its notes"
    assert space_needed("poses", tmp_path / "run", (clip,), {**DEFAULTS, "poses": dataclasses.replace(DEFAULTS["poses"], lens="equirectangular")}) > 6 * one


def test_pixels_that_do_not_fit_into_memory_are_written(tmp_path: Path) -> None:
    folder_of(tmp_path / "run", 2)
    (tmp_path / "run" / "poses").mkdir()
    folder_of(tmp_path / "run" / "poses" / "images", 40)
    roomy, tight = (space_needed("train", tmp_path / "run", (), DEFAULTS, memory) for memory in (None, 2**30))
    assert tight - roomy == 4 * 8 * 40 * 3_000_000
