"""The choice of a resolution: by what pixels tell apart, by what there is room for, and where it is finest."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from efficientnerf.asset.tree import Region
from stages.bake.resolution import MIN_FILL, MIN_RESOLUTION, Choice, affordable_resolution, finest_resolution
from stages.bake.whole_scene import innermost_box
from stages.io.scene import load
from tests.stages.balls import poses


def test_the_finest_follows_the_pixels(tmp_path: Path) -> None:
    s = load(poses(tmp_path))
    # A pixel covers 3 / (1.3 * 16) at the centre, a voxel half of that; the box is 2 wide; 32 at least.
    assert finest_resolution(s, 384).resolution == MIN_RESOLUTION
    focal = 100.0
    sharper = dataclasses.replace(s, views=tuple(dataclasses.replace(v, camera=dataclasses.replace(v.camera, params=(focal, 8.0, 8.0))) for v in s.views))
    told = round(2 / (0.5 * 3 / focal))
    assert finest_resolution(sharper, 384) == Choice(told, "a voxel covers 0.5 of a pixel")
    held = finest_resolution(sharper, 64)
    assert held.resolution == 64
    assert "bake.max_resolution" in held.why
    assert str(told) in held.why


@pytest.mark.parametrize(("power", "room"), [(1.6, 3000), (2.0, 10_000_000), (2.4, 800_000), (3.0, 50_000)])
def test_the_room_is_used_where_voxels_grow_by_a_power(power: float, room: int) -> None:
    finest = Choice(800, "pixels")
    asked = []

    def count(resolution: int) -> int:
        asked.append(resolution)
        return int(0.4 * resolution**power + 1000)

    choice = affordable_resolution(finest, count, lambda resolution: room - resolution)
    assert len(asked) <= 6
    if count(800) <= room - 800:
        assert choice == finest
    elif count(MIN_RESOLUTION) <= room - MIN_RESOLUTION:
        assert MIN_FILL * (room - choice.resolution) - 0.1 * room <= count(choice.resolution) <= room - choice.resolution
        assert "as its size allows" in choice.why
    assert MIN_RESOLUTION <= choice.resolution <= 800


def test_counts_that_jump_end_in_a_resolution_for_which_there_is_room() -> None:
    def count(resolution: int) -> int:
        return 100 * (resolution // 50) ** 3

    choice = affordable_resolution(Choice(400, "pixels"), count, lambda resolution: 9_000)
    assert count(choice.resolution) <= 9_000
    assert choice.resolution >= 200


def test_voxels_are_finest_in_scene_bounds_that_are_far_smaller_than_the_foreground_region() -> None:
    bounds = np.array([[-1.0, -1.0, -0.5], [1.0, 1.0, 0.5]])
    wide = Region(np.array([[-4.0, -3.0, -0.4], [4.0, 3.0, 2.0]]))
    np.testing.assert_array_equal(innermost_box(wide, bounds), [[-1.0, -1.0, -0.4], [1.0, 1.0, 0.5]])
    for region in (Region(bounds * 1.5), Region(bounds * 0.5), Region(bounds * 4 + 50.0)):  # not far larger; smaller; elsewhere
        np.testing.assert_array_equal(innermost_box(region, bounds), region.bounds)
