"""Which photographs of a capture are exposed otherwise: told by the points that they show, not by how bright what they show is."""

from __future__ import annotations

import numpy as np
import pytest

from stages.verdict.looks import LEAST_POINTS, STEP, Look, look, of_other_exposure, over_points


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


def looks_of(brightness: list[float], over: list[float | None]) -> dict[str, Look]:
    plain = look(np.full((64, 64), 100, np.uint8))
    return {
        f"{n}.jpg": Look(plain.sharpness, bright, 0.0, 0.0, 64, plain.small, over_points=stops)
        for n, (bright, stops) in enumerate(zip(brightness, over, strict=True))
    }  # fmt: skip


def test_a_dark_subject_is_no_other_exposure_and_another_exposure_is_one() -> None:
    dark = [-4.0, -1.0, -1.0, -1.2, -1.0]
    assert of_other_exposure(looks_of(dark, [0.0, 0.1, 0.0, -0.1, 0.0])) == []
    assert of_other_exposure(looks_of([-1.0] * 5, [0.0, 0.0, 1.01 * STEP, 0.0, 0.0])) == ["2.jpg"]
    assert of_other_exposure(looks_of(dark, [None] * 5)) == ["0.jpg"]  # without points, brightness is all that there is
    assert of_other_exposure({}) == []
