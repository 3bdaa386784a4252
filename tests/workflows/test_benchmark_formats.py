"""benchmarks/formats.py: that no format is left out, and that its differences are seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks import format_readers as readers
from benchmarks.formats import ROWS, apart, farthest, splats_apart
from efficientnerf.splats.gaussians import covariances
from tests.stages.formats.gaussians import scattered
from workflows.exporting import formats


def test_every_format_that_is_listed_is_compared() -> None:
    assert {(each["of"], each["extension"]) for each in formats()} == {*ROWS}


def test_differences_of_places() -> None:
    places = np.random.default_rng(0).random((30, 3))
    moved = places.copy()
    moved[7, 1] += 0.01 * np.ptp(places, axis=0).max()
    assert apart(places, places) == farthest(places[::-1], places) == 0
    assert apart(moved, places) == pytest.approx(0.01)
    assert 0 < farthest(moved, places) <= 0.01 + 1e-9
    assert farthest(places[1:], places) > 0  # a place is missing
    with pytest.raises(SystemExit, match="29 places, expected 30"):
        apart(places[1:], places)


def test_differences_of_gaussians() -> None:
    """In any order; sizes, opacities and colours each in their own figure."""
    some = scattered(40)
    found = readers.Splats("a", some.means[::-1], covariances(some)[::-1], some.opacities[::-1], some.harmonics[::-1, 0], some.harmonics[::-1])
    assert max(splats_apart(found, some).values()) == 0
    figures = {"covariances": "covariances_median", "opacities": "opacities", "base": "base_colours"}
    for name, figure in figures.items():
        other = splats_apart(replace(found, **{name: getattr(found, name) * 1.1}), some)
        assert [key for key, value in other.items() if value > 0] == [figure]
