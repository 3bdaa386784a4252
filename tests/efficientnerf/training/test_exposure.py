"""Exposure: factors of mean one, gradients, and photographs exposed differently from which the same scene is learned."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from efficientnerf.asset.refinement.targets import Targets
from efficientnerf.geometry.cameras import Camera
from efficientnerf.training.exposure import SCALE, averaged_image, exposed, exposure_loss, log_gains
from efficientnerf.training.loop import restore, state_of, train, trainer
from efficientnerf.training.pixels import Pixels
from efficientnerf.training.schedule import schedule_of
from tests.efficientnerf.balls import cameras, photograph, untrained


def random(*shape: int) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)


def test_the_mean_of_the_logarithms_is_zero_whatever_is_learned() -> None:
    learned = random(5, 3) + 4
    torch.testing.assert_close(log_gains(learned).mean(dim=0), torch.zeros(3, dtype=torch.float64), atol=1e-12, rtol=0)
    view = torch.tensor([0, 4, 4])
    expected = torch.ones(3, 3, dtype=torch.float64) * torch.exp(SCALE * (learned - learned.mean(0)))[view]
    torch.testing.assert_close(exposed(torch.ones(3, 3, dtype=torch.float64), view, learned), expected)
    torch.testing.assert_close(exposed(random(3, 3), view, learned * 0), random(3, 3))
    assert exposure_loss(learned * 0) == 0 < exposure_loss(learned)


def test_gradients() -> None:
    view = torch.tensor([0, 1, 1, 3, 3, 3])
    assert torch.autograd.gradcheck(lambda c, e: (exposed(c, view, e), exposure_loss(e)), (random(6, 3).requires_grad_(), random(4, 3).requires_grad_()))


def photographs(gains: np.ndarray) -> Pixels:
    made = cameras(len(gains))
    images = [np.clip(photograph(camera) * gain, 0, 255).astype(np.uint8) for camera, gain in zip(made, gains, strict=True)]
    return Pixels(made, images, [None] * len(made), np.full(len(made), 1.0), np.full(len(made), 50.0))


def test_differences_between_photographs_are_found() -> None:
    gains = np.exp(0.1 * np.array([1.0, -1, 1, -1, 1, -1, 1, -1]))[:, None] * np.array([1.0, 1.0, 0.95])
    losses = {}
    for kind in ("gain", "off"):
        m = untrained(contracted=True, iterations=150, exposure=kind)
        t = trainer(m, len(gains), replace(schedule_of(m.settings), ramp_steps=10))
        losses[kind] = np.mean([done.loss for done in train(t, photographs(gains))][-20:])
        if kind == "gain":
            assert t.exposure is not None
            found = log_gains(t.exposure.detach()).numpy()
            assert np.corrcoef(found.mean(axis=1), np.log(gains[:, 0]))[0, 1] > 0.7
            assert 0.02 < np.abs(found).mean() < 0.15
            assert "exposure" not in dict(t.model.parameters())
            again = trainer(untrained(contracted=True, iterations=150, exposure=kind), len(gains))
            restore(again, state_of(t))
            assert again.exposure is not None
            assert torch.equal(again.exposure, t.exposure)
        else:
            assert t.exposure is None
    assert losses["gain"] < 0.9 * losses["off"]


def test_scenes_on_a_constant_background_have_none() -> None:
    assert trainer(untrained(exposure="gain"), 8).exposure is None


def test_an_asset_is_fitted_to_what_the_field_was_photographs_over_their_gains() -> None:
    """Photographs of one scene that were exposed differently are alike again, on the host and where pixels were sent to a device."""
    scene = np.random.default_rng(0).integers(40, 120, (3, 8, 6, 3)).astype(np.uint8)
    gains = np.array([[0.5, 1.0, 2.0], [1.0, 1.0, 1.0], [2.0, 1.5, 0.75]])
    seen = [np.rint(image * gain).astype(np.uint8) for image, gain in zip(scene, gains, strict=True)]
    cameras = [Camera(f"{n}.png", 6, 8, "SIMPLE_PINHOLE", (9.0, 3.0, 4.0), np.eye(4)) for n in range(3)]
    made = Targets(Pixels(cameras, seen, [None] * 3, np.ones(3), np.full(3, 2.0)), None, np.zeros((4, 8, 3), np.float32), gains=gains)
    index = np.random.default_rng(1).permutation(3 * 48)[:60]
    for targets in (made, made.sent("cpu")):
        truth = np.asarray(targets.of(index)[2].colour)
        assert truth.dtype == np.float32
        np.testing.assert_allclose(truth, scene.reshape(-1, 3)[index] / 255, atol=1.1 / 255)
    plain = replace(made, gains=None).of(index)[2].colour
    np.testing.assert_array_equal(plain, np.concatenate(seen).reshape(-1, 3)[index].astype(np.float32) / np.float32(255))


def test_a_photograph_over_its_gains_keeps_its_alpha_and_is_no_brighter_than_white() -> None:
    image = np.array([[[100, 200, 10, 7], [255, 255, 255, 255]]], np.uint8)
    assert averaged_image(image, np.array([2.0, 0.5, 1.0])).tolist() == [[[50, 255, 10, 7], [128, 255, 255, 255]]]
    assert image[0, 0].tolist() == [100, 200, 10, 7]
