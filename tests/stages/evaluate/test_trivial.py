"""Trivial pictures of a photograph: what they score, and what a PSNR amounts to."""

import numpy as np
import pytest

from stages.evaluate.trivial import blurred, blurred_psnrs, detail, equivalent_blur


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


def test_detail_is_what_differs_from_shading() -> None:
    """A light that changes slowly over the picture leaves it as it is, and a blur takes it away."""
    picture = a_photograph()
    light = 0.2 * np.linspace(-1, 1, 320, dtype=np.float32)[None, :, None]
    assert np.abs(detail(picture + light, None) - detail(picture, None))[20:-20, 20:-20].max() < 0.02
    scores = blurred_psnrs(detail(picture, None), None)
    assert scores == sorted(scores, reverse=True)
    for blur, score in ((0.005, scores[1]), (0.02, scores[3])):
        assert equivalent_blur(score, scores) == pytest.approx(blur)
        error = np.square(detail(blurred(picture, blur * 320), None) - detail(picture, None)).mean()
        assert -10 * np.log10(error) == pytest.approx(score, abs=0.5)
    mask = np.zeros((240, 320), bool)
    mask[:, :160] = True
    other = np.where(mask[..., None], picture, 1 - picture)
    np.testing.assert_array_equal(detail(other, mask)[mask], detail(picture, mask)[mask])
