"""Trivial pictures of a photograph: what they score, and what a PSNR amounts to."""

from __future__ import annotations

import numpy as np
import pytest

from efficientnerf.evaluation.metrics import psnr
from stages.evaluate.trivial import blurred, blurred_psnrs, equivalent_blur, mean_colour_psnr


def a_photograph(seed: int = 0, shape: tuple[int, int] = (240, 320)) -> np.ndarray:
    """(H, W, 3) float32 with detail of all sizes, as photographs have it: an amplitude that falls with the frequency."""
    rng = np.random.default_rng(seed)
    down, across = np.fft.fftfreq(shape[0])[:, None], np.fft.fftfreq(shape[1])[None]
    amplitude = 1.0 / np.maximum(np.hypot(down, across), 1.0 / max(shape))
    layers = [np.fft.ifft2(np.fft.fft2(rng.normal(size=shape)) * amplitude).real for _ in range(3)]
    return np.clip(np.stack([0.5 + 0.18 * layer / layer.std() for layer in layers], -1), 0, 1).astype(np.float32)


@pytest.mark.parametrize("deviation", [0.7, 3.0, 9.0, 26.0])
def test_a_blur_is_that_of_a_gaussian(deviation: float) -> None:
    """However much it is reduced before: against a sum over the whole picture."""
    picture = a_photograph(shape=(90, 120))
    reflected = np.pad(picture, ((90, 90), (120, 120), (0, 0)), "symmetric")

    def matrix(size: int) -> np.ndarray:
        away = np.arange(3 * size)[None] - (size + np.arange(size))[:, None]
        kernel = np.exp(-0.5 * (away / deviation) ** 2)
        return kernel / kernel.sum(1, keepdims=True)

    expected = np.einsum("ik,klc,jl->ijc", matrix(90), reflected, matrix(120), optimize=True)
    assert np.abs(blurred(picture, deviation) - expected).max() < 0.02
    assert np.sqrt(np.square(blurred(picture, deviation) - expected).mean()) < 0.004


@pytest.mark.parametrize("seed", range(3))
def test_the_blur_that_costs_as_much_as_a_blur_is_that_blur(seed: int) -> None:
    picture = a_photograph(seed)
    scores = blurred_psnrs(picture)
    assert scores == sorted(scores, reverse=True)
    assert scores[-1] > mean_colour_psnr(picture)
    for share in (0.004, 0.008, 0.015, 0.03, 0.06):
        own = psnr(blurred(picture, share * 320), picture)
        assert equivalent_blur(own, scores) == pytest.approx(share, rel=0.15)


def test_what_does_not_count_changes_nothing() -> None:
    picture, mask = a_photograph(), np.zeros((240, 320), bool)
    mask[40:200, 60:300] = True
    other = np.where(mask[..., None], picture, 1 - picture)
    assert blurred_psnrs(other, mask) == blurred_psnrs(picture, mask)
    assert mean_colour_psnr(other, mask) == mean_colour_psnr(picture, mask)
    flat = np.broadcast_to(picture[mask].mean(0, dtype=np.float64), picture.shape)
    assert mean_colour_psnr(picture, mask) == pytest.approx(psnr(flat, picture, mask))
    everything = np.ones_like(mask)
    assert blurred_psnrs(picture, everything) == pytest.approx(blurred_psnrs(picture), abs=1e-3)
