"""Plots: values where they belong, and any values at all."""

from __future__ import annotations

import numpy as np
import pytest

from stages.figures.axes import Series, heat, plot


def test_a_line_goes_where_its_values_are() -> None:
    """Straight up in values is straight up in the picture, also over a logarithm; what is not finite is left out."""
    for logarithmic in (False, True):
        x = np.geomspace(1, 1000, 30) if logarithmic else np.linspace(0, 5, 30)
        y = np.linspace(0, 1, 30)
        line = Series("a", [*x, np.nan], [*y, 3.0], (255, 0, 0))
        pixels = np.asarray(plot((400, 300), [line], x_label="x", y_label="y", logarithmic=logarithmic)).astype(int)
        rows, columns = np.nonzero((pixels[..., 0] > 200) & (pixels[..., 1] < 90))
        rows, columns = rows[rows > 40], columns[rows > 40]  # below the legend
        assert np.ptp(columns) > 250
        assert np.abs(np.polyval(np.polyfit(columns, rows, 1), columns) - rows).max() < 3
        assert np.corrcoef(columns, rows)[0, 1] < -0.99


@pytest.mark.parametrize("values", [[], [0.0], [5.0, 5.0], [1e-9, 2e-9], [-1e8, 1e8]])
def test_any_values_make_a_plot_with_ticks_within(values: list[float]) -> None:
    assert plot((300, 200), [Series("a", values, values, (0, 0, 0))], x_label="x", y_label="y").size == (300, 200)


def test_heat_mixes_neighbouring_colours() -> None:
    assert heat(np.array([0.0, 0.5, 1.0]), [(0, 0, 0), (200, 100, 0)]).tolist() == [[0, 0, 0], [100, 50, 0], [200, 100, 0]]
