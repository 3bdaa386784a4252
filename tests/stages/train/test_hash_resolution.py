"""The size of the hash grid follows the photographs unless the settings state it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from efficientnerf.geometry.cameras import rays
from efficientnerf.training.settings import FINEST, LOG2_TABLE, TrainSettings
from pipeline.errors import UsageError
from pipeline.stage import settings_from
from stages.bake.resolution import ndc_pixel
from stages.train.hash_resolution import MAX_LOG2_TABLE, MAX_RESOLUTION, with_auto_sizes
from tests.stages.forward_facing import forward_facing


def test_grid_points_lie_a_pixel_apart_in_forward_facing_scenes() -> None:
    for side in (400, 1000):
        s = forward_facing(side)
        pixels = sum(v.camera.width * v.camera.height for v in s.views)
        found = with_auto_sizes(TrainSettings(), s, pixels)
        wide = float((s.forward.bounds[1] - s.forward.bounds[0]).max())
        assert found.finest_resolution == max(FINEST, min(MAX_RESOLUTION, math.ceil(wide / ndc_pixel(s, s.forward))))
        # What is called a pixel is one: two points a grid step apart, at any depth, project a pixel apart.
        camera = s.views[0].camera
        middle = np.array([[camera.width / 2, camera.height / 2], [camera.width / 2 + 1, camera.height / 2]])
        origins, directions = rays(camera, middle)
        for depth in (4.0, 30.0):
            at = s.forward.ndc.points(origins + directions * (depth / (directions @ camera.forward))[:, None])
            assert np.linalg.norm(at[1, :2] - at[0, :2]) == pytest.approx(ndc_pixel(s, s.forward), rel=0.15)


def test_tables_grow_with_the_photographs_between_limits() -> None:
    s = forward_facing(400)
    assert with_auto_sizes(TrainSettings(), s, 1000).log2_hashmap_size == LOG2_TABLE
    assert with_auto_sizes(TrainSettings(), s, 6 << 18).log2_hashmap_size == 18
    assert with_auto_sizes(TrainSettings(), s, 10**9).log2_hashmap_size == MAX_LOG2_TABLE
    given = with_auto_sizes(TrainSettings(log2_hashmap_size=14, finest_resolution=512, num_coarse_samples=77), s, 10**9)
    assert (given.log2_hashmap_size, given.finest_resolution, given.num_coarse_samples) == (14, 512, 77)


@pytest.mark.parametrize(("name", "least", "most"), [("log2_hashmap_size", 8, 24), ("finest_resolution", 16, 16384), ("num_coarse_samples", 8, 1024)])
def test_a_table_too_small_is_refused_when_settings_are_read(name: str, least: int, most: int) -> None:
    for wrong in (-1, 0, least - 1, most + 1):
        with pytest.raises(UsageError, match=rf"train\.{name}: found {wrong} \(int\), expected a whole number, at least {least}, at most {most}, or auto\.$"):
            settings_from(TrainSettings, {name: wrong}, where="train")
    for right in ("auto", least, most):
        assert getattr(settings_from(TrainSettings, {name: right}), name) == right
