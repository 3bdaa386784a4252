"""PSNR and SSIM against closed forms, scikit-image and the slow reference."""

import numpy as np
import pytest
from skimage.metrics import peak_signal_noise_ratio

from efficientnerf.evaluation.metrics import colour_fitted, mean_squared_error, psnr, ssim, ssim_map
from tests import reference


def pair(seed: int = 0, height: int = 40, width: int = 53) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    y, x = np.mgrid[0:height, 0:width] / 10.0
    truth = np.stack([0.5 + 0.4 * np.sin(x), 0.5 + 0.4 * np.cos(y), 0.5 + 0.4 * np.sin(x + y)], -1)
    return np.clip(truth + random.normal(0, 0.05, truth.shape), 0, 1).astype(np.float32), truth.astype(np.float32)


@pytest.mark.parametrize("seed", range(4))
def test_psnr_agrees_with_scikit_image(seed: int) -> None:
    image, truth = pair(seed)
    assert psnr(image, truth) == pytest.approx(peak_signal_noise_ratio(truth.astype(float), image.astype(float), data_range=1.0), abs=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_ssim_is_the_papers(seed: int) -> None:
    image, truth = pair(seed, 14, 17)
    expected = reference.ssim(image.astype(float), truth.astype(float))
    np.testing.assert_allclose(ssim_map(image, truth), expected, atol=1e-9)
    assert ssim(image, truth) == pytest.approx(expected.mean(), abs=1e-9)
    np.testing.assert_allclose(ssim_map(image[..., 1], truth[..., 1]), expected[..., 1], atol=1e-9)


def test_a_mask_of_all_changes_nothing_and_what_it_hides_does_not_count() -> None:
    image, truth = pair()
    everything = np.ones(truth.shape[:2], bool)
    assert psnr(image, truth, everything) == psnr(image, truth)
    assert ssim(image, truth, everything) == pytest.approx(ssim(image, truth), abs=1e-12)
    mask = everything.copy()
    mask[:, :20] = False
    spoilt = image.copy()
    spoilt[:, :20] = 1.0 - spoilt[:, :20]
    assert psnr(spoilt, truth, mask) == psnr(image, truth, mask)
    assert ssim(spoilt, truth, mask) == ssim(image, truth, mask)
    spoilt[~mask] = truth[~mask]
    spoilt[mask] = truth[mask]
    assert ssim(spoilt, truth, mask) == pytest.approx(1.0)
    assert mean_squared_error(spoilt, truth, mask) == 0.0


@pytest.mark.parametrize(
    ("image", "truth", "mask", "words"),
    [
        (np.zeros((20, 20, 3)), np.zeros((20, 21, 3)), None, "cannot be compared"),
        (np.zeros((20, 20, 3), np.uint8), np.zeros((20, 20, 3), np.uint8), None, "divide 8-bit images by 255"),
        (np.zeros((20, 20, 3)), np.zeros((20, 20, 3)), np.ones((3, 3), bool), "a mask of shape"),
        (np.zeros((20, 20, 3)), np.zeros((20, 20, 3)), np.zeros((20, 20), bool), "no pixel"),
        (np.zeros((10, 20, 3)), np.zeros((10, 20, 3)), None, "smaller than the window"),
    ],
)
def test_what_cannot_be_compared_is_refused(image: np.ndarray, truth: np.ndarray, mask: np.ndarray | None, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        ssim(image, truth, mask)


@pytest.mark.parametrize("seed", range(3))
def test_a_change_of_exposure_and_white_balance_is_fitted_away(seed: int) -> None:
    random = np.random.default_rng(seed)
    _, truth = pair(seed)
    mix, shift = np.eye(3) + random.normal(0, 0.1, (3, 3)), random.normal(0, 0.05, 3)
    changed = (truth - shift) @ np.linalg.inv(mix).T
    np.testing.assert_allclose(colour_fitted(changed, truth), truth, atol=1e-6)
    noisy, truth = pair(seed)
    assert psnr(colour_fitted(noisy, truth), truth) >= psnr(noisy, truth)
    assert colour_fitted(noisy, truth).min() >= 0
