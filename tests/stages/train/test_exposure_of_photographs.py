"""Which photographs of a capture are exposed otherwise: told by the points that they show, not by how bright what they show is."""

import numpy as np
import pytest

from stages.verdict.looks import LEAST_POINTS, over_points


def photograph(light: np.ndarray, stops: float) -> np.ndarray:
    """(16, 40) uint8 of points one below another in columns, exposed `stops` longer."""
    level = 255 * np.clip(light * 2.0**stops, 0, 1) ** (1 / 2.2)
    return np.round(np.tile(level, (16, 1))).astype(np.uint8)


def places(count: int) -> np.ndarray:
    return np.stack([np.arange(count) + 0.5, np.full(count, 8.5)], axis=-1)


@pytest.mark.parametrize("stops", [-1.5, 0.0, 1.0])
def test_stops_are_those_of_the_exposure_whatever_is_shown(stops: float) -> None:
    light = np.random.default_rng(0).uniform(0.05, 0.3, 40)
    for shown in (np.sort(light)[:LEAST_POINTS], np.sort(light)[-LEAST_POINTS:]):
        found = over_points(photograph(shown, stops), places(LEAST_POINTS), shown)
        assert found == pytest.approx(stops, abs=0.05)
