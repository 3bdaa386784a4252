"""Chains of linear layers with ReLUs, with a backward pass of their own.

The sums are autograd's, with less memory traffic: rows go through all layers in chunks that stay in the cache, bias and ReLU are fused into the product
(oneDNN on the CPU), and the ReLUs' masks are those of the stored activations. In bfloat16 products and stored activations have 8 significant bits and sums
24; parameters, gradients and outputs are float32 (Micikevicius et al. 2018, "Mixed precision training"; bfloat16 has float32's range and needs no loss
scaling).

N rows.
"""

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

ROWS = 4096  # in a chunk: 2 MiB of bfloat16 activations a layer of 256
DEVICE_ROWS = 2**18  # on CUDA, whose caches are small and whose launches cost more than small products: nearly always all
ROW_STEP = 256  # on the CPU, to a multiple of which the last chunk is padded with zeros: oneDNN prepares code for each new shape, which costs more than
# the product itself, and each step of pruned sampling has another number of samples
COLUMN_STEP = 8  # to a multiple of which widths are padded, so that rows of bfloat16 begin at whole 16 bytes: the paper's 63 inputs and 49 outputs do not


@cache
def cpu_facts() -> dict[str, str]:
    """Of Linux' first processor, by name; none elsewhere."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").partition("\n\n")[0].splitlines()
    except OSError:
        return {}
    return {name.strip(): value.strip() for name, _, value in (line.partition(":") for line in lines)}


@cache
def has_bfloat16(device: str) -> bool:
    """Whether the device multiplies bfloat16 matrices in hardware: elsewhere they are slower than float32."""
    if device == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    flags = cpu_facts().get("flags", "").split()
    return torch.backends.cpu.get_cpu_capability().startswith("AVX512") and ("avx512_bf16" in flags or "amx_bf16" in flags)


def precision_of(setting: str, device: str) -> torch.dtype:
    """The type to compute in: "auto" is bfloat16 where the device supports it."""
    if setting == "auto":
        return torch.bfloat16 if has_bfloat16(torch.device(device).type) else torch.float32
    return {"float32": torch.float32, "bfloat16": torch.bfloat16}[setting]


def fused_precision_of(setting: str, device: str) -> torch.dtype:
    """The same of fused networks. On the CPU these use AVX-512's dot products, without AMX: on Intel's processors they take longer than sums in float32, on
    AMD's less. docs/experiments/training-kernels.md"""
    if setting == "auto" and torch.device(device).type == "cpu" and cpu_facts().get("vendor_id") != "AuthenticAMD":
        return torch.float32
    return precision_of(setting, device)


def chain_reference(x: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor], skip: int | None) -> Tensor:
    """`chain` in plain torch: any type, any device, differentiable in everything."""
    skipped = x
    for layer, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
        if layer == skip:
            x = torch.cat([x, skipped], dim=-1)
        x = torch.nn.functional.linear(x, weight, bias)
        if layer < len(weights) - 1:
            x = torch.relu(x)
    return x


def chain(x: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor], *, skip: int | None = None, precision: torch.dtype) -> Tensor:
    """Linear layers with a ReLU after each but the last.

    x        (N, I) float32
    weights  (O, I) each, biases (O,) each
    skip     the layer at which x enters again, behind the outputs of the layer before; x carries no gradient then
    returns  (N, O) of the last, float32
    """
    if x.dtype != torch.float32 or weights[0].dtype != torch.float32 or (skip is not None and x.requires_grad):
        return chain_reference(x, weights, biases, skip)
    return _Chain.apply(x, skip, precision, len(weights), *weights, *biases)


def product(x: Tensor, weight: Tensor, bias: Tensor | None, relu: bool) -> Tensor:
    """x weight^T + bias, and ReLU. On the CPU through oneDNN itself: it fuses all three, and its float32 is twice MKL's on some processors. It has bfloat16
    with AVX-512 alone."""
    if x.device.type == "cpu" and len(x) and (x.dtype == torch.float32 or torch.ops.mkldnn._is_mkldnn_bf16_supported()):
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
    def forward(ctx: Any, x: Tensor, skip: int | None, precision: torch.dtype, layers: int, *parameters: Tensor) -> Tensor:
        inputs, outputs = x.shape[1], parameters[layers - 1].shape[0]
        split = [None if layer != skip else len(parameters[layer - 1]) for layer in range(layers)]
        weights = [_padded_weight(w.detach(), at, precision) for w, at in zip(parameters[:layers], split, strict=True)]
        biases = [_padded(b.detach()[None], 1, _round_up(len(b), COLUMN_STEP), precision)[0] for b in parameters[layers:]]
        out = torch.empty(len(x), outputs, device=x.device)
        store = any(ctx.needs_input_grad)
        activations: list[list[Tensor]] = []
        rows = ROWS if x.device.type == "cpu" else DEVICE_ROWS
        for begin in range(0, len(x), rows):
            part = x[begin : begin + rows]
            padded = min(ROWS, _round_up(len(part), ROW_STEP)) if part.device.type == "cpu" else len(part)
            first = _padded(part, padded, _round_up(inputs, COLUMN_STEP), precision)
            given, y = [], first
            for layer in range(layers):
                y = torch.cat([y, first], dim=1) if layer == skip else y
                given.append(y)
                y = product(y, weights[layer], biases[layer], layer < layers - 1)
            out[begin : begin + rows] = y[: len(part), :outputs]
            if store:
                activations.append(given)
        ctx.activations, ctx.weights, ctx.split, ctx.rows = activations, weights, split, rows
        ctx.shapes = [p.shape for p in parameters]
        return out

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        (grad,) = grads
        weights, layers = ctx.weights, len(ctx.weights)
        transposed = [w.t().contiguous() for w in weights]
        weight_grads = [torch.zeros(w.shape, device=grad.device) for w in weights]
        bias_grads = [torch.zeros(len(w), device=grad.device) for w in weights]
        inputs = ctx.shapes[0][1]
        x_grad = torch.empty(len(grad), inputs, device=grad.device) if ctx.needs_input_grad[0] else None
        for number, activations in enumerate(ctx.activations):
            begin = number * ctx.rows
            part = grad[begin : begin + ctx.rows]
            g = _padded(part, len(activations[0]), len(weights[-1]), weights[0].dtype)
            for layer in reversed(range(layers)):
                y = activations[layer]
                weight_grads[layer] += outer(g, y)
                bias_grads[layer] += g.sum(0)  # summed in float32, and rounded once
                if layer:
                    hidden = len(weights[layer - 1])  # what x adds at the skip needs no gradient
                    g = torch.ops.aten.threshold_backward(product(g, transposed[layer][:hidden], None, False), y[:, :hidden], 0)
                elif x_grad is not None:
                    x_grad[begin : begin + ctx.rows] = product(g, transposed[0], None, False)[: len(part), :inputs]
        ctx.activations = None
        of_weights = [_unpadded(g, shape, at) for g, shape, at in zip(weight_grads, ctx.shapes[:layers], ctx.split, strict=True)]
        return (x_grad, None, None, None, *of_weights, *(g[: shape[0]] for g, shape in zip(bias_grads, ctx.shapes[layers:], strict=True)))


def _round_up(count: int, step: int) -> int:
    return -(-count // step) * step


def _padded(x: Tensor, rows: int, columns: int, precision: torch.dtype) -> Tensor:
    """x as the upper left part of a matrix of zeros."""
    if x.shape == (rows, columns):
        return x.to(precision)
    out = torch.zeros(rows, columns, dtype=precision, device=x.device)
    out[: x.shape[0], : x.shape[1]] = x
    return out


def _padded_weight(weight: Tensor, split: int | None, precision: torch.dtype) -> Tensor:
    """A weight (O, I) for padded rows; at the skip, its columns from `split` on meet the input, which begins after the padded width before it."""
    rows, step = _round_up(len(weight), COLUMN_STEP), COLUMN_STEP
    if split is None:
        return _padded(weight, rows, _round_up(weight.shape[1], step), precision)
    before, after = weight[:, :split], weight[:, split:]
    return torch.cat([_padded(part, rows, _round_up(part.shape[1], step), precision) for part in (before, after)], dim=1)


def _unpadded(grad: Tensor, shape: torch.Size, split: int | None) -> Tensor:
    """The gradient of a padded weight as that of the weight."""
    if split is None:
        return grad[: shape[0], : shape[1]]
    after = _round_up(split, COLUMN_STEP)
    return torch.cat([grad[: shape[0], :split], grad[: shape[0], after : after + shape[1] - split]], dim=1)
