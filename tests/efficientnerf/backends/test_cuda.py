"""The CUDA kernels of the hash encoding at sizes and in places that `backends/test_operations.py` does not have."""

import numpy as np
import pytest
import torch
from torch import Tensor

from efficientnerf.backends.torch.hash_grid import HashLevels
from tests.efficientnerf.device import DEVICE

cuda = pytest.importorskip("efficientnerf.backends.triton.hash_grid")

LEVELS = HashLevels(np.array([4, 10, 25, 64]), np.array([True, False, False, False]), np.array([0, 64, 576, 1088]), np.uint32(511))


def points(count: int) -> Tensor:
    """In the cube, on its faces and corners, and a little outside."""
    x = torch.rand(count, 3, generator=torch.Generator().manual_seed(1)) * 1.1 - 0.05
    x[::7] = x[::7].round()
    return x.to(DEVICE)


def encoded(encode: object, x: Tensor, grad: Tensor) -> tuple[Tensor, Tensor]:
    """Features, and the gradient of the table."""
    table = torch.randn(1600, 2, generator=torch.Generator().manual_seed(0)).to(DEVICE).requires_grad_()
    out = encode(x, table, LEVELS)  # type: ignore[operator]
    (out * grad).sum().backward()
    assert table.grad is not None
    return out.detach(), table.grad


def test_an_encoding_of_no_points() -> None:
    out, grad = encoded(cuda.encode, torch.zeros(0, 3, device=DEVICE), torch.zeros(0, 8, device=DEVICE))
    assert out.shape == (0, 8)
    assert not grad.any()


def test_points_may_be_strided() -> None:
    x = points(50)
    strided = torch.stack([x, x], dim=-1)[..., 0]
    assert not strided.is_contiguous()
    grad = torch.ones(50, 8, device=DEVICE)
    assert torch.equal(encoded(cuda.encode, strided, grad)[0], encoded(cuda.encode, x, grad)[0])
