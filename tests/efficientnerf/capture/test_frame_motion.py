"""How sharp a frame is, and how far the picture has moved."""

import cv2
import numpy as np
import pytest

from efficientnerf.capture.frame_motion import Motion, sharpness
from tests.stages import clips

WIDTH, HEIGHT = 240, 160
DIAGONAL = float(np.hypot(WIDTH, HEIGHT))


def grey(frame: np.ndarray) -> np.ndarray:
    return np.asarray(cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY))


def moved(frames: list[np.ndarray]) -> np.ndarray:
    motion = Motion()
    return np.array([motion.add(grey(frame)) for frame in frames])


@pytest.mark.parametrize("angle", [0, 45, 90, 135])
def test_blur_in_any_direction_lowers_sharpness(angle: int) -> None:
    picture = grey(clips.texture(1, 320))[:160, :240]
    values = []
    for length in (1, 5, 9, 17):
        kernel = np.zeros((length, length), np.float32)
        step = {0: (0, 1), 45: (-1, 1), 90: (1, 0), 135: (1, 1)}[angle]
        for place in range(-(length // 2), length // 2 + 1):
            kernel[length // 2 + place * step[0], length // 2 + place * step[1]] = 1 / length
        values.append(sharpness(cv2.filter2D(picture, -1, kernel)))
    assert values[0] > 1.1 * values[1] > 1.1**2 * values[2] > 1.1**3 * values[3] > 0


@pytest.mark.parametrize("step", [0.5, 2.0, 7.0, -7.0])
def test_motion_is_that_of_the_picture(step: float) -> None:
    count = 12
    found = moved(clips.pan(count, step, width=WIDTH, height=HEIGHT))
    assert (np.diff(found) >= 0).all()
    assert found[-1] == pytest.approx((count - 1) * abs(step) / DIAGONAL, rel=0.05)


def test_noise_a_trembling_hand_and_a_wall_are_no_motion() -> None:
    random = np.random.default_rng(0)
    still = clips.pan(1, 0, width=WIDTH, height=HEIGHT)[0]
    noisy = [np.clip(still + random.normal(0, 4, still.shape), 0, 255).astype(np.uint8) for _ in range(10)]
    assert moved(noisy)[-1] < 0.002
    trembling = [np.roll(still, tuple(random.integers(-2, 3, 2)), (0, 1)) for _ in range(25)]
    assert moved(trembling)[-1] < 4 / DIAGONAL
    assert moved([np.full((HEIGHT, WIDTH, 3), 128, np.uint8)] * 5)[-1] == 0
