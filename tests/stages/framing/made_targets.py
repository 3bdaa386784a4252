"""Made photographs of circular coded targets."""

import cv2
import numpy as np

SIDE = 480  # px, of a drawing
DISC = 40  # px, the radius of its disc


def target(bits: str, inner: float = 2.0, outer: float = 3.0, notched: bool = False) -> np.ndarray:
    """A drawing (SIDE, SIDE) of a disc with a ring of bits between two radii, in those of the disc; round them a ring with one notch."""
    y, x = np.mgrid[:SIDE, :SIDE] - (SIDE - 1) / 2
    radius, angle = np.hypot(x, y) / DISC, np.arctan2(y, x) % (2 * np.pi)
    ink = np.array([bit == "1" for bit in bits])[(angle / (2 * np.pi) * len(bits)).astype(int)]
    dark = (radius < 1) | (ink & (radius > inner) & (radius < outer))
    if notched:
        dark |= (angle > 0.4) & (radius > outer) & (radius < outer + 0.8)
    return np.where(dark, 0.05, 0.85)


def photograph(drawing: np.ndarray, radius: float, tilt: float, seed: int = 0) -> np.ndarray:
    """Four of a drawing on a textured table, their discs with this radius, pixels; seen from `tilt` degrees off their normal."""
    rng = np.random.default_rng(seed)
    light = cv2.GaussianBlur(rng.normal(0.4, 0.6, (900, 1200)), (0, 0), 2.0)
    for number in range(4):
        small, turn = radius / DISC, rng.uniform(0, 6)
        matrix = small * np.array([[1, 0], [0, np.cos(np.radians(tilt))]]) @ np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        middle = np.array([300 + 600 * (number % 2), 230 + 440 * (number // 2)]) + rng.uniform(-5, 5, 2)
        affine = np.column_stack([matrix, middle - matrix.sum(1) * (SIDE - 1) / 2])
        cv2.warpAffine(cv2.GaussianBlur(drawing, (0, 0), 0.4 / small), affine, light.shape[::-1], light, cv2.INTER_LINEAR, cv2.BORDER_TRANSPARENT)
    light = cv2.GaussianBlur(np.maximum(light, 0), (0, 0), 0.8)
    return np.clip(255 * light ** (1 / 2.2) + rng.normal(0, 3, light.shape), 0, 255).astype(np.uint8)


KINDS = {
    "8 bits": target("11010010", 1.6, 2.4), "12 bits": target("110010111000"), "14 bits": target("10110001011100"),
    "20 bits": target("11001010001110110100"), "two rings": target("1011000110", 1.8, 2.7, notched=True), "white on black": 0.9 - target("110010111000"),
}  # fmt: skip
