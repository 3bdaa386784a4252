"""The paper's networks: hand-written passes against autograd, in both types; NeRF's own network; sizes."""

from __future__ import annotations

import pytest
import torch

from efficientnerf.backends.torch import linear_chain
from efficientnerf.backends.torch.linear_chain import chain, chain_reference
from efficientnerf.fields.nerf import NerfField

TOLERANCE = {torch.float32: 2e-5, torch.bfloat16: 4e-2}


def layers(sizes: list[tuple[int, int]]) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
    generator = torch.Generator().manual_seed(1)
    weights = [(torch.randn(o, i, generator=generator) * (2 / i) ** 0.5).requires_grad_() for i, o in sizes]
    return weights, [(0.1 * torch.randn(o, generator=generator)).requires_grad_() for _, o in sizes]


CASES = {
    "skip": ([(7, 16), (16, 16), (23, 16), (16, 5)], 2),
    "no skip": ([(7, 16), (16, 3)], None),
    "one layer": ([(7, 4)], None),
    "odd widths": ([(7, 13), (13, 11), (18, 9), (9, 5)], 2),
}


@pytest.mark.parametrize(("case", "precision"), [(case, (torch.float32, torch.bfloat16)[n % 2]) for n, case in enumerate(CASES)])
def test_passes_by_hand_are_those_of_autograd(case: str, precision: torch.dtype, monkeypatch: pytest.MonkeyPatch) -> None:
    """Over several chunks, the last of them short; gradients of weights, biases and, where nothing skips, of the input."""
    monkeypatch.setattr(linear_chain, "ROWS", 48)
    sizes, skip = CASES[case]
    weights, biases = layers(sizes)
    generator = torch.Generator().manual_seed(2)
    x = torch.randn(100, 7, generator=generator).requires_grad_(skip is None)
    towards = torch.randn(100, sizes[-1][1], generator=generator)
    leaves = [*weights, *biases, *([x] if skip is None else [])]
    ours, theirs = chain(x, weights, biases, skip=skip, precision=precision), chain_reference(x, weights, biases, skip)
    assert ours.dtype == torch.float32
    assert (ours - theirs).norm() < TOLERANCE[precision] * theirs.norm()
    for mine, its in zip(torch.autograd.grad((ours * towards).sum(), leaves), torch.autograd.grad((theirs * towards).sum(), leaves), strict=True):
        assert mine.dtype == torch.float32
        assert (mine - its).norm() < 5 * TOLERANCE[precision] * its.norm()  # a few ReLUs close to zero fall to the other side


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
