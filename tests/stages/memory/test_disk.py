"""What stages write, foretold: fleets admit them by it."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from efficientnerf.geometry.cameras import Camera
from stages.io.exporters.exr import write_exr
from stages.io.png import write_png
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


@pytest.mark.parametrize(("background", "channels"), [("auto", 3), ("transparent", 4)])
@pytest.mark.parametrize(("exr", "deep"), [("off", 0), ("first", 1), ("all", 3)])
def test_a_turntables_frames_of_noise_fit_into_what_was_foretold(background: str, channels: int, exr: str, deep: int, tmp_path: Path) -> None:
    """Nothing is harder to compress; and what is foretold, in scratch and artifact, is no more than a sixth above."""
    own = dataclasses.replace(DEFAULTS["turntable"], frames=3, width=512, height=384, background=background, exr=exr)
    random = np.random.default_rng(0)
    pose = np.eye(4)
    camera = Camera("noise", own.width, own.height, "SIMPLE_PINHOLE", (400.0, own.width / 2, own.height / 2), pose)
    for number in range(own.frames):
        write_png(random.integers(0, 256, (own.height, own.width, channels), np.uint8), tmp_path / f"{number}.png")
        if number < deep:
            colour, normal = random.random((2, own.height, own.width, 3), np.float32)
            opacity, depth = random.random((2, own.height, own.width), np.float32)
            write_exr(tmp_path / f"{number}.exr", colour=colour, opacity=opacity, depth=depth, normal=normal, camera=camera)
    written = 2 * sum(path.stat().st_size for path in tmp_path.iterdir())
    needed = space_needed("turntable", tmp_path / "run", (), {"turntable": own}) - LEAST
    assert written < needed < 7 / 6 * written * 1.001


def test_pixels_that_do_not_fit_into_memory_are_written(tmp_path: Path) -> None:
    folder_of(tmp_path / "run", 2)
    (tmp_path / "run" / "poses").mkdir()
    folder_of(tmp_path / "run" / "poses" / "images", 40)
    roomy, tight = (space_needed("train", tmp_path / "run", (), DEFAULTS, memory) for memory in (None, 2**30))
    assert tight - roomy == 4 * 8 * 40 * 3_000_000
