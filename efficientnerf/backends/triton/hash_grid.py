"""The training step's kernels on CUDA (Triton): the hash encoding and Adam. Sampling, compositing and the tree are in `cuda_*.py` beside.

Each function takes what the torch function it stands for takes, and gives the same but for rounding. What adds up gradients by atomics gives sums
whose last bits depend on the order in which the device happened to run: on CUDA two runs with one seed agree closely, not to the byte.

None of these waits for the device. With TRITON_INTERPRET=1, set before the first import, Triton's interpreter runs all of them on CPU tensors.
"""

from __future__ import annotations

import functools
import os
import warnings
from typing import Any

import numpy as np
import torch
import triton
import triton.language as tl
from torch import Tensor

INTERPRETED = os.environ.get("TRITON_INTERPRET") == "1"
FEATURES = 2
# Programs are many and small on a device; the interpreter runs one after the other, each operation at a price whatever the size of its block.
LANES = 1024 if INTERPRETED else 128


def blocks(count: int, block: int = LANES) -> int:
    """Programs of `block` lanes for so many; never none, which CUDA would refuse to launch."""
    return max(1, -(-count // block))


@functools.cache
def usable() -> bool:
    """Whether kernels can be built and launched here; says once why not. Triton's launcher is compiled by the system's C compiler."""
    if not torch.cuda.is_available():
        return False
    try:
        probe = torch.ones(1, device="cuda")
        adam(probe, probe.clone(), probe.clone(), probe.clone(), 0.0, 0.9, 0.99, 1.0, 1.0, 1e-8, skip_zeros=False)
    except Exception as error:  # whatever the compiler, the driver or the launcher may say
        reason = str(error).strip().splitlines()[-1:] or [type(error).__name__]
        warnings.warn(
            f"The CUDA kernels cannot be built here ({reason[0][:200]}); plain torch is used, many times slower. Usually a C compiler is missing: install gcc.",
            RuntimeWarning,
            stacklevel=2,
        )
        return False
    return True


@triton.jit
def _lattice(points, n, live, level, levels):  # type: ignore[no-untyped-def]
    """Where samples lie in a level's lattice: lower corner and fraction along x, y, z; and the level's side, start and whether it is dense."""
    side = tl.load(levels + level * 3).to(tl.int32)
    start = tl.load(levels + level * 3 + 1)
    flat = tl.load(levels + level * 3 + 2).to(tl.int32)
    cells = (side - 1).to(tl.float32)
    x = tl.load(points + n * 3, live, other=0.0) * cells
    y = tl.load(points + n * 3 + 1, live, other=0.0) * cells
    z = tl.load(points + n * 3 + 2, live, other=0.0) * cells
    i = tl.minimum(tl.maximum(x.to(tl.int32), 0), side - 2)
    j = tl.minimum(tl.maximum(y.to(tl.int32), 0), side - 2)
    k = tl.minimum(tl.maximum(z.to(tl.int32), 0), side - 2)
    return i, j, k, x - i.to(tl.float32), y - j.to(tl.float32), z - k.to(tl.float32), side, start, flat


@triton.jit
def _corner(i, j, k, fx, fy, fz, side, flat, mask, CORNER: tl.constexpr):  # type: ignore[no-untyped-def]
    """Slot in the level's table and trilinear weight of one of the eight corners."""
    p: tl.constexpr = CORNER // 4
    q: tl.constexpr = CORNER // 2 % 2
    s: tl.constexpr = CORNER % 2
    weight = (fx if p else 1 - fx) * (fy if q else 1 - fy) * (fz if s else 1 - fz)
    x, y, z = i + p, j + q, k + s
    if flat != 0:
        slot = (x * side + y) * side + z
    else:
        # The primes of Mueller et al. 2022, section 3.
        hashed = x.to(tl.uint32) ^ (y.to(tl.uint32) * 2654435761) ^ (z.to(tl.uint32) * 805459861)
        slot = (hashed & mask.to(tl.uint32)).to(tl.int32)
    return slot, weight


@triton.jit
def _encode(points, table, levels, out, samples, mask, L: tl.constexpr, BLOCK: tl.constexpr):  # type: ignore[no-untyped-def]
    """One program: a block of samples at one level. A lattice point's two features are one load of eight bytes."""
    level = tl.program_id(1)
    n = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    live = n < samples
    both = tl.arange(0, 2)
    i, j, k, fx, fy, fz, side, start, flat = _lattice(points, n, live, level, levels)
    total = tl.zeros((BLOCK, 2), tl.float32)
    for corner in tl.static_range(8):
        slot, weight = _corner(i, j, k, fx, fy, fz, side, flat, mask, corner)
        total += weight[:, None] * tl.load(table + start * 2 + (slot[:, None] * 2 + both[None, :]), live[:, None], other=0.0)
    tl.store(out + (n[:, None] * (2 * L) + level * 2 + both[None, :]), total, live[:, None])


@triton.jit
def _encode_backward(points, grad, levels, table_grad, samples, mask, L: tl.constexpr, BLOCK: tl.constexpr):  # type: ignore[no-untyped-def]
    level = tl.program_id(1)
    n = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    live = n < samples
    both = tl.arange(0, 2)
    pull = tl.load(grad + (n[:, None] * (2 * L) + level * 2 + both[None, :]), live[:, None], other=0.0)
    i, j, k, fx, fy, fz, side, start, flat = _lattice(points, n, live, level, levels)
    pulled = (tl.max(tl.abs(pull), 1) > 0)[:, None]
    for corner in tl.static_range(8):
        slot, weight = _corner(i, j, k, fx, fy, fz, side, flat, mask, corner)
        # Samples without a gradient (behind an opaque surface, or the padding of a bundle) cost no traffic.
        tl.atomic_add(table_grad + start * 2 + (slot[:, None] * 2 + both[None, :]), weight[:, None] * pull, mask=pulled, sem="relaxed")


@functools.lru_cache(maxsize=32)
def _levels(sides: bytes, dense: bytes, starts: bytes, device: torch.device) -> Tensor:
    """(L, 3) int64 side, start in the table, dense or not; kept, so that a step sends nothing."""
    columns = [np.frombuffer(sides, np.int64), np.frombuffer(starts, np.int64), np.frombuffer(dense, np.bool_).astype(np.int64)]
    return torch.from_numpy(np.stack(columns, axis=1)).to(device)


def _levels_of(sides: np.ndarray, dense: np.ndarray, starts: np.ndarray, device: torch.device) -> Tensor:
    return _levels(sides.astype(np.int64).tobytes(), dense.astype(np.bool_).tobytes(), starts.astype(np.int64).tobytes(), device)


class Encode(torch.autograd.Function):
    """`efficientnerf.fields.hash.encode_reference` on float32 tensors, differentiable in the table (summed by atomics: see the module)."""

    @staticmethod
    def forward(ctx: Any, points: Tensor, table: Tensor, sides: np.ndarray, dense: np.ndarray, starts: np.ndarray, mask: int) -> Tensor:
        points = points.detach().contiguous()
        levels = _levels_of(sides, dense, starts, points.device)
        out = torch.empty(len(points), FEATURES * len(sides), device=points.device)
        _encode[(blocks(len(points)), len(sides))](points, table.detach(), levels, out, len(points), int(mask), L=len(sides), BLOCK=LANES)
        ctx.save_for_backward(points, levels)
        ctx.size, ctx.mask = table.shape, int(mask)
        return out

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        points, levels = ctx.saved_tensors
        table_grad = torch.zeros(ctx.size, device=points.device)
        grad = grads[0].contiguous()
        _encode_backward[(blocks(len(points)), len(levels))](points, grad, levels, table_grad, len(points), ctx.mask, L=len(levels), BLOCK=LANES)
        return None, table_grad, None, None, None, None


@triton.jit
def _adam(value, grad, first, second, count, rate, beta1, beta2, correction1, correction2, epsilon, SKIP_ZEROS: tl.constexpr, BLOCK: tl.constexpr):  # type: ignore[no-untyped-def]
    n = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    live = n < count
    g = tl.load(grad + n, live, other=0.0)
    if SKIP_ZEROS:
        live = live & (g != 0)  # where no lane of a sector is touched, nothing but the gradient is read
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
    """One step of Kingma and Ba's Adam in place on contiguous float32 tensors of one shape; with `skip_zeros`, entries without a gradient stay as they are."""
    block = 1024
    _adam[(blocks(value.numel(), block),)](
        value.detach(), grad.contiguous(), first, second, value.numel(),
        rate, beta1, beta2, correction1, correction2, epsilon, SKIP_ZEROS=skip_zeros, BLOCK=block,
    )  # fmt: skip
