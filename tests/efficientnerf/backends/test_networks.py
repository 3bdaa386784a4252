"""The paper's networks: hand-written passes against autograd, in both types; NeRF's own network; sizes."""

from __future__ import annotations

import pytest
import torch

from efficientnerf.backends.torch import linear_chain
from efficientnerf.backends.torch.linear_chain import chain, chain_reference, has_bfloat16, precision_of
from efficientnerf.fields.mlp import MlpField, positional_encoding
from efficientnerf.fields.nerf import NerfField

TOLERANCE = {torch.float32: 2e-5, torch.bfloat16: 4e-2}


def layers(sizes: list[tuple[int, int]]) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
    generator = torch.Generator().manual_seed(1)
    weights = [(torch.randn(o, i, generator=generator) * (2 / i) ** 0.5).requires_grad_() for i, o in sizes]
    return weights, [(0.1 * torch.randn(o, generator=generator)).requires_grad_() for _, o in sizes]


CASES = {
    "skip": ([(7, 16), (16, 16), (23, 16), (16, 5)], 2, False),
    "no skip": ([(7, 16), (16, 3)], None, False),
    "relu last": ([(7, 16), (23, 16)], 1, True),
    "one layer": ([(7, 4)], None, False),
    "odd widths": ([(7, 13), (13, 11), (18, 9), (9, 5)], 2, False),
}


@pytest.mark.parametrize("precision", [torch.float32, torch.bfloat16], ids=["float32", "bfloat16"])
@pytest.mark.parametrize("case", CASES)
def test_passes_by_hand_are_those_of_autograd(case: str, precision: torch.dtype, monkeypatch: pytest.MonkeyPatch) -> None:
    """Over several chunks, the last of them short; gradients of weights, biases and, where nothing skips, of the input."""
    monkeypatch.setattr(linear_chain, "ROWS", 48)
    sizes, skip, relu_last = CASES[case]
    weights, biases = layers(sizes)
    generator = torch.Generator().manual_seed(2)
    x = torch.randn(100, 7, generator=generator).requires_grad_(skip is None)
    towards = torch.randn(100, sizes[-1][1], generator=generator)
    leaves = [*weights, *biases, *([x] if skip is None else [])]
    ours, theirs = chain(x, weights, biases, skip=skip, relu_last=relu_last, precision=precision), chain_reference(x, weights, biases, skip, relu_last)
    assert ours.dtype == torch.float32
    assert (ours - theirs).norm() < TOLERANCE[precision] * theirs.norm()
    for mine, its in zip(torch.autograd.grad((ours * towards).sum(), leaves), torch.autograd.grad((theirs * towards).sum(), leaves), strict=True):
        assert mine.dtype == torch.float32
        assert (mine - its).norm() < 5 * TOLERANCE[precision] * its.norm()  # a few ReLUs close to zero fall to the other side


def test_chains_of_nothing_and_of_float64_work() -> None:
    weights, biases = layers(CASES["skip"][0])
    out = chain(torch.zeros(0, 7), weights, biases, skip=2, precision=torch.float32)
    assert out.shape == (0, 5)
    out.sum().backward()
    assert weights[0].grad is not None
    assert float(weights[0].grad.abs().sum()) == 0
    double = chain(torch.zeros(3, 7, dtype=torch.float64), [w.double() for w in weights], [b.double() for b in biases], skip=2, precision=torch.float32)
    assert double.dtype == torch.float64


def test_gradients_of_a_chain_are_finite_differences() -> None:
    weights, biases = ([p.detach().double().requires_grad_() for p in group] for group in layers(CASES["skip"][0]))
    x = torch.randn(5, 7, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).requires_grad_()
    assert torch.autograd.gradcheck(lambda x, *p: chain_reference(x, p[:4], p[4:], 2, False), (x, *weights, *biases))


def test_auto_is_bfloat16_where_the_processor_has_it() -> None:
    assert precision_of("auto", "cpu") == (torch.bfloat16 if has_bfloat16("cpu") else torch.float32)
    assert precision_of("float32", "cpu") == torch.float32
    assert precision_of("bfloat16", "cpu") == torch.bfloat16


@pytest.mark.parametrize(
    ("field", "expected"),
    [
        (MlpField(hidden=256, layers=8, degree=3, generator=torch.Generator()), 505_649),
        (MlpField(hidden=128, layers=4, degree=3, generator=torch.Generator()), 72_113),
        (NerfField(hidden=256, layers=8, generator=torch.Generator()), 595_844),  # as NeRF's published code
    ],
    ids=["standard", "light", "nerf"],
)
def test_networks_have_the_sizes_that_their_docstrings_say(field: torch.nn.Module, expected: int) -> None:
    import sys

    assert sum(p.numel() for p in field.parameters()) == expected
    assert f"{expected:,}" in (sys.modules[type(field).__module__].__doc__ or "")


def nerf() -> NerfField:
    return NerfField(hidden=16, layers=4, generator=torch.Generator().manual_seed(0))


def test_nerfs_colour_depends_on_the_direction_and_its_density_does_not() -> None:
    field = nerf()
    points = torch.rand(20, 3, generator=torch.Generator().manual_seed(3))
    one, other = (torch.nn.functional.normalize(torch.randn(20, 3, generator=torch.Generator().manual_seed(n)), dim=1) for n in (1, 2))
    first, second = field(points, one), field(points, other)
    assert first.shape == (20, 4)
    torch.testing.assert_close(first[:, 0], second[:, 0])
    torch.testing.assert_close(first[:, 0], field.density(points))
    assert (first[:, 1:] - second[:, 1:]).abs().min() > 0


def test_every_parameter_of_nerfs_network_has_a_gradient() -> None:
    field = nerf()
    points, directions = torch.rand(50, 3), torch.nn.functional.normalize(torch.randn(50, 3), dim=1)
    field(points, directions).square().sum().backward()
    for name, p in field.named_parameters():
        assert p.grad is not None, name
        assert p.grad.abs().sum() > 0, name


@pytest.mark.parametrize("degree", range(5))
def test_any_degree_of_harmonics(degree: int) -> None:
    assert MlpField(hidden=8, layers=2, degree=degree, generator=torch.Generator())(torch.rand(3, 3)).shape == (3, 1 + 3 * (degree + 1) ** 2)


def test_positional_encoding_in_float32_is_close_to_its_closed_form() -> None:
    points = torch.rand(500, 3, generator=torch.Generator().manual_seed(0)) * 2 - 1
    angles = (points.double()[:, None] * 2.0 ** torch.arange(10)[:, None]).reshape(500, 30)
    expected = torch.cat([points, angles.sin(), angles.cos()], dim=1)
    torch.testing.assert_close(positional_encoding(points).double(), expected, rtol=0, atol=3e-5)
