"""Volume rendering: laws, a closed form, and loop, torch and kernel against each other, values and gradients."""

import math

import numpy as np
import pytest
import torch

from efficientnerf.backends import dispatch
from efficientnerf.rendering.compositing import activate, sample_weights
from tests import reference
from tests.efficientnerf.bundles import bundle, in_float32


def test_weights_sum_to_one_at_most() -> None:
    rng = np.random.default_rng(0)
    for scale in (0.01, 1.0, 100.0, 1e4):
        depth = torch.from_numpy((scale * rng.random(400)).astype(np.float32))
        first = torch.arange(0, 401, 20)
        weight = sample_weights(depth, first)
        assert weight.min() >= 0
        assert weight.reshape(20, 20).sum(1).max() <= 1 + 1e-6


def test_weights_of_a_ray_do_not_feel_the_rays_before_it() -> None:
    depth = torch.rand(1000, generator=torch.Generator().manual_seed(0))
    many = sample_weights(torch.cat([torch.full((100_000,), 50.0), depth]), torch.tensor([0, 100_000, 101_000]))
    torch.testing.assert_close(many[100_000:], sample_weights(depth, torch.tensor([0, 1000])), rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("activation", ["exp", "softplus"])
def test_activations(activation: str) -> None:
    raw = torch.tensor([-80.0, -3.0, 0.0, 1.0, 2.5, 14.9], dtype=torch.float64)
    torch.testing.assert_close(activate(raw, activation), torch.tensor([reference.activate(x, activation) for x in raw.tolist()], dtype=torch.float64))
    assert math.isfinite(float(activate(torch.tensor(1e6), activation)))


def test_beyond_the_cap_the_density_has_no_gradient_and_stays_finite() -> None:
    raw = torch.tensor([[40.0, 0.3, 0.1, -0.2], [0.5, 0.0, 0.0, 0.0]], requires_grad=True)
    out = dispatch.composite(raw, torch.full((2,), 0.1), torch.tensor([0, 2]), torch.full((1, 1), 0.28), torch.ones(1, 3), "exp")
    out.colour.sum().backward()
    assert torch.isfinite(raw.grad).all()
    assert raw.grad[0, 0] == 0
    assert float(out.opacity.detach()) == pytest.approx(1.0)


@pytest.mark.parametrize("column", [0, 3])
@pytest.mark.parametrize("activation", ["exp", "softplus"])
def test_what_is_no_number_shows_in_its_ray_alone(activation: str, column: int) -> None:
    raw = torch.zeros(4, 28)
    raw[1, column] = math.nan
    out = dispatch.composite(raw, torch.full((4,), 0.1), torch.tensor([0, 2, 4]), torch.full((2, 9), 0.28), torch.ones(2, 3), activation)
    assert out.colour[0].isnan().any()
    assert out.colour[1].isfinite().all()


def test_splitting_a_sample_in_two_leaves_the_pixel_unchanged() -> None:
    b = in_float32(bundle(2))
    whole = dispatch.composite(*b, "softplus")
    twice = b._replace(raw=b.raw.repeat_interleave(2, 0), length=(b.length / 2).repeat_interleave(2), first=b.first * 2)
    halves = dispatch.composite(*twice, "softplus")
    torch.testing.assert_close(halves.colour, whole.colour, rtol=0, atol=1e-6)
    torch.testing.assert_close(halves.opacity, whole.opacity, rtol=0, atol=1e-6)


def test_a_thin_surface_is_less_distorted_than_fog() -> None:
    raw = torch.zeros(20, 4)
    raw[:10, 0], raw[10:, 0] = 0.0, -9.0
    raw[15, 0] = 9.0
    out = dispatch.composite(raw, torch.full((20,), 0.1), torch.tensor([0, 10, 20]), torch.ones(2, 1), torch.ones(2, 3), "exp")
    assert float(out.distortion[0]) > 3 * float(out.distortion[1]) > 0


def test_a_uniform_ball_has_its_closed_form() -> None:
    """Opacity 1 - exp(-sigma chord) whatever the number of samples; the rest is background."""
    radius, sigma = 0.8, 1.7
    height = np.linspace(0, 1.0, 23)
    chord = 2 * np.sqrt(np.maximum(radius**2 - height**2, 0))
    samples = 1 + np.arange(23) % 6
    first = torch.tensor([0, *np.cumsum(samples)])
    length = torch.from_numpy(np.repeat(chord / samples, samples).astype(np.float32))
    raw = torch.zeros(int(first[-1]), 4)
    raw[:, 0] = math.log(sigma)
    out = dispatch.composite(raw, length, first, torch.ones(23, 1), torch.ones(23, 3), "exp")
    expected = 1 - np.exp(-sigma * chord)
    np.testing.assert_allclose(out.opacity, expected, atol=1e-6)
    np.testing.assert_allclose(out.colour[:, 0], 0.5 * expected + 1 - expected, atol=1e-6)
