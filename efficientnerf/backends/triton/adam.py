"""Adam on CUDA (Triton)."""

from __future__ import annotations

import triton
import triton.language as tl
from torch import Tensor

from efficientnerf.backends.triton.launch import blocks

BLOCK = 1024


@triton.jit
def _adam(
    value, grad, first, second, count, rate, beta1, beta2, correction1, correction2, epsilon,
    SKIP_ZEROS: tl.constexpr, ON_DEVICE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """ON_DEVICE: rate and corrections are pointers, so that a step that is replayed (`efficientnerf.training.step_graphs`) can have others each time."""
    if ON_DEVICE:
        step_rate, by1, by2 = tl.load(rate), tl.load(correction1), tl.load(correction2)
    else:
        step_rate, by1, by2 = rate, correction1, correction2
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
    tl.store(value + n, x - step_rate * (m / by1) / (tl.sqrt(v / by2) + epsilon), live)


def adam(
    value: Tensor, grad: Tensor, first: Tensor, second: Tensor, rate: float | Tensor, beta1: float, beta2: float, correction1: float | Tensor,
    correction2: float | Tensor, epsilon: float, *, skip_zeros: bool,
) -> None:  # fmt: skip
    """`efficientnerf.backends.torch.adam.adam` on contiguous float32 tensors; the rate and both corrections may be float32 tensors () of the device."""
    _adam[(blocks(value.numel(), BLOCK),)](
        value.detach(), grad.contiguous(), first, second, value.numel(),
        rate, beta1, beta2, correction1, correction2, epsilon, SKIP_ZEROS=skip_zeros, ON_DEVICE=isinstance(rate, Tensor), BLOCK=BLOCK,
    )  # fmt: skip
