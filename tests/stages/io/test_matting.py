"""Colours at the edges of silhouettes."""

import numpy as np
import pytest

from stages.io.matting import without_background


def disc(side: int = 48, radius: float = 14.0) -> np.ndarray:
    """(side, side) uint8: how much of each pixel a disc covers."""
    fine = np.arange(8 * side) / 8 + 1 / 16
    inside = np.hypot(fine[:, None] - side / 2, fine[None] - side / 2) < radius
    return np.rint(255 * inside.reshape(side, 8, side, 8).mean((1, 3))).astype(np.uint8)


def seen(cover: np.ndarray, front: np.ndarray, behind: np.ndarray) -> np.ndarray:
    share = cover[..., None] / 255
    return np.rint(share * front + (1 - share) * behind).astype(np.uint8)


@pytest.mark.parametrize("behind", [(0, 0, 0), (255, 255, 255), (20, 200, 90)])
def test_an_edge_keeps_nothing_of_the_background(behind: tuple[int, int, int]) -> None:
    cover, front = disc(), np.array([180.0, 60.0, 40.0])
    photograph = seen(cover, front, np.array(behind, float))
    found = without_background(photograph, cover).astype(float)
    shown = cover > 0
    assert abs(found[shown] - front).max() <= 4
    assert abs(photograph[shown].astype(float) - front).max() > 30
    np.testing.assert_array_equal(found[~shown], photograph[~shown])
    np.testing.assert_array_equal(found[cover == 255], photograph[cover == 255])
