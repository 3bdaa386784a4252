"""Losses of colours: highlights on what is dark count less, and gradients follow."""

import numpy as np
import pytest
import torch

from efficientnerf.model import RayOutputs, render_rays
from efficientnerf.training.loop import state_of, train, trainer
from efficientnerf.training.losses import BRIGHT, SPARED_UNTIL, colour_losses, crosses_box, highlight_weights, spares_highlights
from efficientnerf.training.pixels import Pixels
from tests.efficientnerf.balls import cameras, untrained


def _weights(shown: float, seen: float, crossing: bool = True, weight: float = 0.1) -> float:
    found = highlight_weights(torch.full((1, 3), shown), torch.full((1, 3), seen), torch.tensor([crossing]), weight)
    assert found.unique().numel() == 1
    return float(found[0, 0])


def test_only_what_is_brighter_than_a_dark_surface_counts_less() -> None:
    assert _weights(0.1, 0.9) == pytest.approx(0.1)
    assert _weights(BRIGHT[0], 0.9) == pytest.approx(0.1)
    assert _weights(sum(BRIGHT) / 2, 0.9) == pytest.approx(0.55)
    assert _weights(BRIGHT[1], 0.9) == _weights(0.9, 1.0) == 1
    assert _weights(0.1, 0.05) == _weights(0.1, 0.1) == 1
    assert _weights(0.1, 0.9, crossing=False) == 1
    assert _weights(0.1, 0.9, weight=1.0) == 1


def test_a_dark_point_takes_the_colour_that_most_photographs_show() -> None:
    """One photograph in five shows a highlight: the mean is pulled to it, and errors of the others grow with it."""
    seen = torch.tensor([0.1, 0.1, 0.1, 0.1, 0.9])[:, None].expand(5, 3)

    def fitted(weight: float) -> float:
        colour = torch.full((1, 3), 0.2, requires_grad=True)
        for _ in range(400):
            shown = colour.expand(5, 3)
            (highlight_weights(shown, seen, torch.ones(5, dtype=torch.bool), weight) * (shown - seen) ** 2).mean().backward()
            assert colour.grad is not None
            with torch.no_grad():
                colour -= colour.grad
            colour.grad = None
        return float(colour.detach()[0, 0])

    assert fitted(1.0) == pytest.approx(0.26, abs=1e-3)
    assert fitted(0.1) == pytest.approx((4 * 0.1 + 0.1 * 0.9) / 4.1, abs=1e-3)


def _rays(count: int = 64) -> tuple[torch.Tensor, torch.Tensor]:
    """Towards the box from 3 away, and as many away from it."""
    rng = np.random.default_rng(0)
    origins = rng.normal(size=(count, 3))
    origins *= 3 / np.linalg.norm(origins, axis=1, keepdims=True)
    towards = -origins / 3 + rng.normal(scale=0.05, size=(count, 3))
    towards[count // 2 :] *= -1
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    return torch.tensor(origins, dtype=torch.float32), torch.tensor(towards, dtype=torch.float32)


def _rendered(origins: torch.Tensor, directions: torch.Tensor) -> RayOutputs:
    count = len(origins)
    near, far = torch.full((count,), 0.1), torch.full((count,), 30.0)
    m = untrained(contracted=True, initial_density=5.0)
    return render_rays(m, origins, directions, near, far, torch.full((count,), 0.5), torch.ones(count, 3))


def test_rays_cross_the_box_ahead_of_the_camera_or_not_at_all() -> None:
    origins, directions = _rays()
    m = untrained(contracted=True)
    along = origins[:, None] + torch.linspace(0, 6, 2000)[None, :, None] * directions[:, None]
    inside = (m.space.unit(along).abs().amax(dim=2) <= 1).any(dim=1)
    assert inside[:32].all()
    assert not inside[32:].any()
    assert torch.equal(crosses_box(m, origins, directions), inside)
    assert crosses_box(m, torch.zeros(1, 3), torch.tensor([[0.0, 0.0, 1.0]])).all()  # a camera in the box


def test_the_losses_of_both_stages_are_weighted() -> None:
    outputs = RayOutputs(*(part.detach() if isinstance(part, torch.Tensor) else part for part in _rendered(*_rays())))
    white, black, crossing = torch.ones(64, 3), torch.zeros(64, 3), torch.ones(64, dtype=torch.bool)
    assert colour_losses(outputs, white, None, highlights=(crossing, 1.0)) == colour_losses(outputs, white, None)
    assert colour_losses(outputs, black, None, highlights=(crossing, 0.1)) == colour_losses(outputs, black, None)  # darker than the field: none is spared
    assert outputs.coarse_colour is not None
    dark = outputs._replace(fine_colour=0.1 * outputs.fine_colour, coarse_colour=0.1 * outputs.coarse_colour)
    for spared, plain in zip(colour_losses(dark, white, None, highlights=(crossing, 0.1)), colour_losses(dark, white, None), strict=True):
        assert spared is not None
        assert plain is not None
        assert float(spared) == pytest.approx(0.1 * float(plain), rel=1e-4)


def test_highlights_are_spared_at_first_where_asked_for() -> None:
    assert spares_highlights(untrained(contracted=True, highlight_loss_weight=0.1), 0.0)
    assert not spares_highlights(untrained(contracted=True, highlight_loss_weight=0.1), SPARED_UNTIL)
    assert not spares_highlights(untrained(contracted=True), 0.0)
    assert not spares_highlights(untrained(highlight_loss_weight=0.1), 0.0)


def _trained(steps: int, weight: float) -> dict[str, torch.Tensor]:
    settings = {"iterations": 10, "highlight_loss_weight": weight, "occupancy_warmup_steps": 2}
    t = trainer(untrained(contracted=True, **settings))
    images = [np.random.default_rng(k).integers(0, 255, (24, 24, 3), np.uint8) for k in range(3)]
    pixels = Pixels(cameras(3, 24), images, [None] * 3, np.full(3, 1.0), np.full(3, 5.0))
    for done in train(t, pixels):
        if done.step == steps:
            break
    return {name: value.clone() for name, value in state_of(t).items()}


def test_the_weight_changes_the_first_steps_of_a_training() -> None:
    plain, spared = _trained(3, 1.0), _trained(3, 0.1)
    assert any(not torch.equal(plain[name], spared[name]) for name in plain)
    again = _trained(3, 0.1)
    assert all(torch.equal(spared[name], again[name]) for name in spared)
