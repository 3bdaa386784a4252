"""What stages write, foretold: fleets admit them by it."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from efficientnerf.geometry.cameras import Camera
from pipeline.fleet import disk
from stages.formats.exporters.exr import write_exr
from stages.io.png import write_png
from stages.memory.disk import LEAST, space_needed
from tests.stages.captures import HEIGHT, WIDTH, cameras, nerfstudio
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


def test_small_pictures_with_cameras_need_little_room(tmp_path: Path) -> None:
    """No features are looked for, and none of the pictures is enlarged: a fleet of such scenes fits on a disk of 60 MB."""
    nerfstudio(tmp_path / "source", cameras(8))
    needed = space_needed("poses", tmp_path / "run", (tmp_path / "source",), DEFAULTS)
    pixels = 8 * WIDTH * HEIGHT
    assert pixels < needed - LEAST < 4 * pixels
    taken = {**DEFAULTS, "poses": dataclasses.replace(DEFAULTS["poses"], format="photographs", max_features=512)}
    assert space_needed("poses", tmp_path / "run", (tmp_path / "source",), taken) >= needed + 8 * 512 * 300, "asked to find the cameras it looks for features"
    assert disk.has_room(60 * 10**6, (tmp_path, needed), [(tmp_path, needed)], written=lambda _: 0)


def test_points_and_gaussians_are_foretold_by_how_many_are_asked_for(tmp_path: Path) -> None:
    for stage, setting, few, many in (("points", "num_points", 500, 10**6), ("splats", "count", 300, 10**6)):
        needs = [space_needed(stage, tmp_path, (), {stage: dataclasses.replace(DEFAULTS[stage], **{setting: count})}) for count in (few, many)]
        assert needs[0] < 2 * 2**20
        assert 20 * (many - few) < needs[1] - needs[0] < 400 * (many - few)


def test_a_checkpoint_that_no_step_reaches_is_not_foretold_but_for_an_interruption(tmp_path: Path) -> None:
    short, long = (
        space_needed("train", tmp_path, (), {"train": dataclasses.replace(DEFAULTS["train"], iterations=count, checkpoint_every=1000, log2_hashmap_size=12)})
        for count in (500, 10_000)
    )
    assert 1.5 * short < long < 3 * short


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
