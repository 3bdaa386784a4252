"""Exposure: factors of mean one, gradients, and photographs exposed differently from which the same scene is learned."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from efficientnerf.training.exposure import SCALE, exposed, exposure_loss, log_gains
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
