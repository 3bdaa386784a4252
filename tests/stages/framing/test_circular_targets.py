"""Circular coded targets are counted in made photographs of several kinds of them, and nothing else is taken for one."""

import cv2
import numpy as np
import pytest

from stages.framing.circular_targets import count_targets
from tests.stages.framing.made_targets import KINDS, SIDE, photograph, target

OTHERS = {
    "a plate": target("1"), "a sun": target("10" * 8), "a wheel": target("10" * 5, 1.0, 4.0), "a half": target("1100" * 2, 1.0, 1.6),
    "discs": target("0"), "letters": 0.85 - cv2.putText(np.zeros((SIDE, SIDE), np.uint8), "@8o", (30, 300), cv2.FONT_HERSHEY_DUPLEX, 6.0, (1,), 16) * 0.8,
}  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("radius", "tilt"), [(7, 20), (12, 50), (25, 40)])
def test_targets_are_counted(kind: str, radius: float, tilt: float) -> None:
    assert count_targets(photograph(KINDS[kind], radius, tilt)) >= 2


@pytest.mark.parametrize("kind", OTHERS)
def test_other_round_things_are_none(kind: str) -> None:
    assert [count_targets(photograph(OTHERS[kind], radius, 30)) for radius in (7, 25)] == [0, 0]
