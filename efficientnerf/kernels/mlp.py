"""Chains of linear layers with ReLUs, forward and backward by hand: where nearly all of the paper's arithmetic is.

What autograd would do, with less traffic: rows go through all layers in chunks that stay in the cache, bias and ReLU are fused into the product
(oneDNN on the CPU), and the masks of the ReLUs are read off the activations. In "bfloat16" products and kept activations have 8 significant bits and
sums 24; parameters, gradients and whatever leaves the chain stay float32, so that small steps are not lost (Micikevicius et al. 2018, "Mixed precision
training"; bfloat16 has float32's range and needs no scaling of the loss).

N rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

ROWS = 4096  # in a chunk: 2 MiB of bfloat16 activations a layer of 256


@cache
def has_bfloat16(device: str) -> bool:
    """Whether the device multiplies bfloat16 matrices in hardware: elsewhere they are slower than float32."""
    if device == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    capability = torch.backends.cpu.get_cpu_capability()
    if not capability.startswith("AVX512"):
        return False
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        flags = next(line for line in lines if line.startswith("flags")).split()
    except (OSError, StopIteration):
        return False
    return "avx512_bf16" in flags or "amx_bf16" in flags


def precision_of(setting: str, device: str) -> torch.dtype:
    """The type to compute in: "auto" is bfloat16 where the device has it."""
    if setting == "auto":
        return torch.bfloat16 if has_bfloat16(torch.device(device).type) else torch.float32
    return {"float32": torch.float32, "bfloat16": torch.bfloat16}[setting]


def chain_reference(x: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor], skip: int | None, relu_last: bool) -> Tensor:
    """`chain` in plain torch: any type, any device, differentiable in everything."""
    again = x
    for layer, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
        if layer == skip:
            x = torch.cat([x, again], dim=-1)
        x = torch.nn.functional.linear(x, weight, bias)
        if relu_last or layer < len(weights) - 1:
            x = torch.relu(x)
    return x


def chain(
    x: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor], *, skip: int | None = None, relu_last: bool = False, precision: torch.dtype
) -> Tensor:
    """Linear layers with a ReLU after each but the last.

    x          (N, I) float32
    weights    (O, I) each, biases (O,) each
    skip       the layer at which x enters again, after what the layer before gave; x carries no gradient then
    relu_last  a ReLU after the last too
    returns    (N, O) of the last, float32
    """
    if x.dtype != torch.float32 or weights[0].dtype != torch.float32:
        return chain_reference(x, weights, biases, skip, relu_last)
    if skip is not None and x.requires_grad:
        return chain_reference(x, weights, biases, skip, relu_last)
    return _Chain.apply(x, skip, relu_last, precision, len(weights), *weights, *biases)


def product(x: Tensor, weight: Tensor, bias: Tensor | None, relu: bool) -> Tensor:
    """x weight^T + bias, and ReLU. On the CPU through oneDNN itself: it fuses all three, and its float32 is twice MKL's on some processors."""
    if x.device.type == "cpu" and len(x):
        return torch.ops.mkldnn._linear_pointwise(x, weight, bias, "relu" if relu else "none", [], "")
    y = torch.nn.functional.linear(x, weight, bias)
    return y.relu_() if relu else y


def outer(grad: Tensor, x: Tensor) -> Tensor:
    """grad^T x in float32."""
    if grad.dtype == torch.float32 and grad.device.type == "cpu":
        return torch.ops.mkldnn._linear_pointwise(grad.t(), x.t(), None, "none", [], "")
    return torch.mm(grad.t(), x).float()


class _Chain(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, skip: int | None, relu_last: bool, precision: torch.dtype, layers: int, *parameters: Tensor) -> Tensor:
        weights = [w.detach().to(precision) for w in parameters[:layers]]
        biases = [b.detach().to(precision) for b in parameters[layers:]]
        out = torch.empty(len(x), len(weights[-1]), device=x.device)
        keep = any(ctx.needs_input_grad)
        kept: list[list[Tensor]] = []
        for begin in range(0, len(x), ROWS):
            first = x[begin : begin + ROWS].to(precision)
            inputs, y = [], first
            for layer in range(layers):
                y = torch.cat([y, first], dim=1) if layer == skip else y
                inputs.append(y)
                y = product(y, weights[layer], biases[layer], relu_last or layer < layers - 1)
            out[begin : begin + ROWS] = y
            if keep:
                kept.append([*inputs, y] if relu_last else inputs)
        ctx.kept, ctx.weights, ctx.relu_last = kept, weights, relu_last
        return out

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        (grad,) = grads
        weights, layers = ctx.weights, len(ctx.weights)
        transposed = [w.t().contiguous() for w in weights]
        weight_grads = [torch.zeros(w.shape, device=grad.device) for w in weights]
        bias_grads = [torch.zeros(len(w), device=grad.device) for w in weights]
        x_grad = torch.empty(len(grad), weights[0].shape[1], device=grad.device) if ctx.needs_input_grad[0] else None
        for number, kept in enumerate(ctx.kept):
            begin = number * ROWS
            g = grad[begin : begin + ROWS].to(weights[0].dtype)
            if ctx.relu_last:
                g = torch.ops.aten.threshold_backward(g, kept[layers], 0)
            for layer in reversed(range(layers)):
                y = kept[layer]
                weight_grads[layer] += outer(g, y)
                bias_grads[layer] += g.sum(0)  # summed in float32, and rounded once
                if layer:
                    hidden = len(weights[layer - 1])  # what x adds at the skip needs no gradient
                    g = product(g, transposed[layer][:hidden], None, False)
                    g = torch.ops.aten.threshold_backward(g, y[:, :hidden], 0)
                elif x_grad is not None:
                    x_grad[begin : begin + ROWS] = product(g, transposed[0], None, False)
        ctx.kept = None
        return (x_grad, None, None, None, None, *weight_grads, *bias_grads)
