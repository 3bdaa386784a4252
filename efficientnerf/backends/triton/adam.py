"""Adam on CUDA (Triton)."""

from __future__ import annotations

import triton
import triton.language as tl
from torch import Tensor

from efficientnerf.backends.triton.launch import blocks

BLOCK = 1024


@triton.jit
def _adam(value, grad, first, second, count, rate, beta1, beta2, correction1, correction2, epsilon, SKIP_ZEROS: tl.constexpr, BLOCK: tl.constexpr):  # type: ignore[no-untyped-def]
    n = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    live = n < count
    g = tl.load(grad + n, live, other=0.0)
    if SKIP_ZEROS:
        live = live & (g != 0)  # where no lane of a sector has a gradient, nothing but the gradient is read
    m = beta1 * tl.load(first + n, live, other=0.0) + (1 - beta1) * g
    v = beta2 * tl.load(second + n, live, other=0.0) + (1 - beta2) * g * g
    tl.store(first + n, m, live)
    tl.store(second + n, v, live)
    x = tl.load(value + n, live, other=0.0)
    tl.store(value + n, x - rate * (m / correction1) / (tl.sqrt(v / correction2) + epsilon), live)


def adam(
    value: Tensor, grad: Tensor, first: Tensor, second: Tensor, rate: float, beta1: float, beta2: float, correction1: float, correction2: float,
    epsilon: float, *, skip_zeros: bool,
) -> None:  # fmt: skip
    """`efficientnerf.backends.torch.adam.adam` on contiguous float32 tensors."""
    _adam[(blocks(value.numel(), BLOCK),)](
        value.detach(), grad.contiguous(), first, second, value.numel(),
        rate, beta1, beta2, correction1, correction2, epsilon, SKIP_ZEROS=skip_zeros, BLOCK=BLOCK,
    )  # fmt: skip
