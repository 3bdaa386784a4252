"""The size of the hash grid follows the photographs unless the settings state it."""

import math

import numpy as np
import pytest

from efficientnerf.geometry.cameras import rays
from efficientnerf.training.settings import FINEST, TrainSettings
from stages.bake.resolution import ndc_pixel
from stages.train.hash_resolution import MAX_RESOLUTION, with_auto_sizes
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
