"""The CUDA kernels of the hash encoding and of Adam against torch."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from efficientnerf.backends.numba import adam
from efficientnerf.fields.hash import HashField, encode_reference
from tests.efficientnerf.device import DEVICE
from tests.efficientnerf.steps import RATES, gradients

cuda = pytest.importorskip("efficientnerf.backends.triton.hash_grid")
cuda_adam = pytest.importorskip("efficientnerf.backends.triton.adam")


def field(log2_table: int = 9) -> HashField:
    """Four levels: two dense, two hashed (with 2^9 entries)."""
    made = HashField(
        levels=4, log2_table=log2_table, coarsest=4, finest=64, hidden=8, layers=1, degree=0, initial_density=0.1, generator=torch.Generator().manual_seed(0)
    )
    made.table.data.mul_(1e4)
    return made.to(DEVICE)


def points(count: int) -> Tensor:
    """In the cube, on its faces and corners, and a little outside."""
    generator = torch.Generator().manual_seed(1)
    x = torch.rand(count, 3, generator=generator) * 1.1 - 0.05
    x[::7] = x[::7].round()
    x[1] = 1.0
    return x.to(DEVICE)


def encoded(made: HashField, x: Tensor, pull: Tensor, kernel: bool) -> tuple[Tensor, Tensor]:
    made.table.grad = None
    if kernel:
        out = cuda.encode(x, made.table, made.sides, made.dense, made.starts, int(made.mask))
    else:
        out = encode_reference(x, made.table, made.sides, made.dense, made.starts, int(made.mask))
    (out * pull).sum().backward()
    assert made.table.grad is not None
    return out.detach(), made.table.grad


@pytest.mark.parametrize("count", [1, 37, 1500])
def test_encoding_and_its_gradient(count: int) -> None:
    made, x = field(), points(count) if count > 1 else torch.tensor([[0.3, 0.9, 0.5]], device=DEVICE)
    assert made.dense.any()
    assert not made.dense.all()
    pull = torch.randn(count, 8, generator=torch.Generator().manual_seed(2)).to(DEVICE)
    pull[count // 2 :] = 0 if count > 1 else 1  # as behind an opaque surface
    for ours, theirs in zip(encoded(made, x, pull, True), encoded(made, x, pull, False), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-4)


def test_an_encoding_of_no_points() -> None:
    made = field()
    out, grad = encoded(made, torch.zeros(0, 3, device=DEVICE), torch.zeros(0, 8, device=DEVICE), True)
    assert out.shape == (0, 8)
    assert not grad.any()


def test_points_may_lie_scattered_in_memory() -> None:
    made, x = field(), points(50)
    strided = torch.stack([x, x], dim=-1)[..., 0]
    assert not strided.is_contiguous()
    pull = torch.ones(50, 8, device=DEVICE)
    assert torch.equal(encoded(made, strided, pull, True)[0], encoded(made, x, pull, True)[0])


@pytest.mark.parametrize("skip_zeros", [False, True])
def test_adam_is_the_cpu_kernel(skip_zeros: bool) -> None:
    start = torch.linspace(-1, 1, 2600).reshape(1300, 2)
    ours = [start.clone().to(DEVICE), torch.zeros_like(start, device=DEVICE), torch.zeros_like(start, device=DEVICE)]
    theirs = [start.clone(), torch.zeros_like(start), torch.zeros_like(start)]
    for number, (grad, rate) in enumerate(zip(gradients((1300, 2)), RATES, strict=True), 1):
        grad[300 : 900 if number > 1 else 300 : 2] = 0
        corrections = (1 - 0.9**number, 1 - 0.99**number)
        cuda_adam.adam(ours[0], grad.to(DEVICE), *ours[1:], rate, 0.9, 0.99, *corrections, 1e-15, skip_zeros=skip_zeros)
        flat = [t.view(-1).numpy() for t in (theirs[0], grad.clone(), *theirs[1:])]
        adam.adam(*flat, *(np.float32(x) for x in (rate, 0.9, 0.99, *corrections, 1e-15)), skip_zeros)
    for a, b in zip(ours, theirs, strict=True):
        torch.testing.assert_close(a.cpu(), b, rtol=2e-5, atol=1e-7)
    once, never = ours[0][302].cpu(), start[302]
    first_step = never - RATES[0] * torch.sign(gradients((1300, 2))[0][302])
    assert torch.allclose(once, first_step, atol=1e-6) == skip_zeros
