"""Pixels that masks allow: as probable as each other, however few they are."""

import numpy as np
import pytest

from tests.efficientnerf.small_views import SIZES, views


def masks_of(share: float) -> list[np.ndarray | None]:
    rng = np.random.default_rng(1)
    found: list[np.ndarray | None] = [rng.random((h, w)) < share for w, h in SIZES]
    found[1] = np.arange(36).reshape(9, 4) % 20 == 17
    return found


@pytest.mark.parametrize("share", [0.0, 0.6])
def test_usable_pixels_are_chosen_alike(share: float) -> None:
    some = views(masks_of(share))
    usable = np.flatnonzero(some.usable_at(np.arange(len(some))))
    assert some.usable_count == len(usable)
    assert (some.listed is None) == (share > 0)
    for middle in (False, True):
        index = some.choose(4000, np.random.default_rng(2), middle=middle)
        assert index.dtype == np.int64
        assert len(index) == 4000
        assert set(index) <= set(usable)
    counts = np.bincount(some.choose(4000, np.random.default_rng(2)), minlength=len(some))[usable]
    assert np.abs(counts * len(usable) / 4000 - 1).max() < 0.3
