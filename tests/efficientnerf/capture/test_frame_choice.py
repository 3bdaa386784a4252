"""Which frames of a video are chosen."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from efficientnerf.capture.frame_choice import ALIKE, BLUR, CHOSEN, LESS_SHARP, SAME, choose, shares


def steps_and_sharpness(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    return np.cumsum(random.exponential(0.01, count)), random.uniform(0.5, 1.0, count)


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 90), st.integers(1, 40), st.integers(0, 99))
def test_there_are_no_more_than_asked_for_and_no_two_alike(frames: int, count: int, seed: int) -> None:
    motion, sharpness = steps_and_sharpness(frames, seed)
    verdicts = choose(motion, sharpness, count)
    chosen = [place for place, verdict in enumerate(verdicts) if verdict == CHOSEN]
    assert len(verdicts) == frames
    assert 1 <= len(chosen) <= count
    assert (np.diff(motion[chosen]) >= ALIKE * (1 - 1e-9)).all()
    assert set(verdicts) <= {CHOSEN, LESS_SHARP, SAME, BLUR}


@settings(max_examples=30, deadline=None)
@given(st.integers(2, 100), st.integers(1, 30), st.floats(0.1, 10))
def test_only_the_order_of_sharpness_and_the_course_of_motion_count(frames: int, count: int, factor: float) -> None:
    motion, sharpness = steps_and_sharpness(frames)
    assert choose(motion + 3.0, sharpness * factor, count) == choose(motion, sharpness, count)


def test_of_each_window_the_sharpest_is_chosen() -> None:
    motion, sharpness = np.linspace(0, 1, 100), np.full(100, 0.6)
    sharpest = np.arange(5, 100, 10)
    sharpness[sharpest] = 1.0
    assert np.flatnonzero(np.array(choose(motion, sharpness, 10)) == CHOSEN).tolist() == sharpest.tolist()


def test_a_sharp_frame_is_not_left_for_being_near() -> None:
    motion, sharpness = np.linspace(0, 1, 30), np.ones(30)
    sharpness[[4, 5]] = 0.85
    sharpness[2] = 1.1
    chosen = np.array(choose(motion, sharpness, 10)) == CHOSEN
    assert chosen[2]
    assert chosen[[3, 6]].any()
    assert not chosen[[4, 5]].any()


@pytest.mark.parametrize("motions", [[1.0, 1.0], [3.0, 1.0, 0.0], [0.0, 0.0], [5.0]])
def test_videos_share_frames_by_motion(motions: list[float]) -> None:
    found = shares(motions, 100)
    assert min(found) >= 2
    assert abs(sum(found) - 100) <= 2 * len(motions)
    assert all(a >= b for a, b, m, n in zip(found, found[1:], motions, motions[1:], strict=False) if m >= n)
