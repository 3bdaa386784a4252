"""Adam in plain torch."""

import torch
from torch import Tensor


@torch.no_grad()
def adam(
    value: Tensor, grad: Tensor, first: Tensor, second: Tensor, rate: float, beta1: float, beta2: float, correction1: float, correction2: float,
    epsilon: float, *, skip_zeros: bool,
) -> None:  # fmt: skip
    """One step of Kingma and Ba's Adam, in place on tensors of one shape.

    first, second  moments
    corrections    1 - beta^step of either moment
    skip_zeros     entries whose gradient is zero stay as they are, their moments too
    """
    stepped = (grad != 0) if skip_zeros else torch.ones_like(grad, dtype=torch.bool)
    first.copy_(torch.where(stepped, first.lerp(grad, 1 - beta1), first))
    second.copy_(torch.where(stepped, second.lerp(grad**2, 1 - beta2), second))
    value.sub_(stepped * rate * (first / correction1) / ((second / correction2).sqrt() + epsilon))
