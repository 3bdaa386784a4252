"""The hash field's network in tiles: products and passes are those of numpy and autograd, in both precisions, for every size, on any processor."""

import copy
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest
import torch

from efficientnerf.backends.numba import mlp
from efficientnerf.backends.numba.vector import products
from efficientnerf.backends.numba.vector.memory import pointer
from efficientnerf.fields import hash
from efficientnerf.training.optimiser import ParameterGroup
from tests.efficientnerf.networks import passes, weights_of

ROOT = Path(__file__).resolve().parents[3]
SHAPES = [(24, 64, 2, 28), (24, 32, 1, 1), (6, 8, 1, 13), (2, 40, 3, 4), (10, 20, 4, 49), (34, 100, 2, 16)]  # inputs, width, hidden layers, outputs


class Rounding(torch.autograd.Function):
    """To bfloat16, as the kernels round: values on the way forward, and what comes back if `both`."""

    @staticmethod
    def forward(ctx: Any, value: torch.Tensor, both: bool) -> torch.Tensor:
        ctx.both = both
        return value.bfloat16().double()

    @staticmethod
    def backward(ctx: Any, *grads: torch.Tensor) -> tuple[torch.Tensor, None]:
        return grads[0].bfloat16().double() if ctx.both else grads[0], None


def expected(features: np.ndarray, weights: list[np.ndarray], grad: np.ndarray, bfloat16: bool) -> list[torch.Tensor]:
    """Outputs, and gradients of features and weights, in float64 but for bfloat16's roundings."""

    def narrow(value: torch.Tensor, both: bool = False) -> torch.Tensor:
        return Rounding.apply(value, both) if bfloat16 else value  # type: ignore[no-any-return, no-untyped-call]

    x = torch.tensor(features, dtype=torch.float64, requires_grad=True)
    parameters = [torch.tensor(weight, dtype=torch.float64, requires_grad=True) for weight in weights]
    y = narrow(x.t())
    for weight in parameters[:-1]:
        y = torch.relu(narrow(y @ narrow(weight).t(), both=True))
    out = y @ narrow(parameters[-1]).t()
    out.backward(narrow(torch.tensor(grad, dtype=torch.float64)))
    return [out.detach(), x.grad, *(w.grad for w in parameters)]  # type: ignore[list-item]


@pytest.mark.parametrize(("shape", "bfloat16"), [(shape, n % 2 == 0) for n, shape in enumerate(SHAPES)] + [(SHAPES[0], False), (SHAPES[5], True)])
def test_passes_are_those_of_autograd(shape: tuple[int, int, int, int], bfloat16: bool) -> None:
    """With as many samples as fill no block, one block, blocks and a rest, and chunks and a rest."""
    rng = np.random.default_rng(0)
    weights = weights_of(*shape, rng)
    for samples in (1, 64, 64 + 16, 2 * mlp.CHUNK + 129):
        features, grad = rng.normal(size=(shape[0], samples)).astype(np.float32), rng.normal(size=(samples, shape[3])).astype(np.float32)
        for ours, theirs in zip(passes(features, weights, grad, bfloat16), expected(features, weights, grad, bfloat16), strict=True):
            error = np.linalg.norm(ours - theirs.numpy()) / np.linalg.norm(theirs.numpy())
            # bfloat16: sums that round to either side, and ReLUs close to zero that fall to the other.
            assert error < (1e-2 if bfloat16 else 1e-6), (samples, ours.shape)


@pytest.mark.parametrize("bfloat16", [False, True])
def test_all_outputs_and_nothing_else_are_written(bfloat16: bool) -> None:
    rng = np.random.default_rng(1)
    for inputs, width, layers, outputs in SHAPES:
        weights = weights_of(inputs, width, layers, outputs, rng)
        for samples in (0, 1, 63, 64, 65, mlp.CHUNK + 1):
            features = rng.normal(size=(inputs, samples)).astype(np.float32)
            around = np.full((samples + 2 * outputs + 32, outputs), 7, np.float32)
            out = around[outputs : outputs + samples]
            out[:] = np.nan
            packed = mlp.pack_weights(weights, bfloat16)
            assert mlp.forward(features, packed, 0.5, out, keep=False).size == 0
            assert (around[:outputs] == 7).all()
            assert (around[outputs + samples :] == 7).all()
            activations = np.full((samples, outputs), np.nan, np.float32)
            mlp.forward(features, packed, 0.5, activations, keep=True)
            assert np.isfinite(out).all()
            assert np.array_equal(out, activations)


@pytest.mark.parametrize("bfloat16", [False, True])
def test_nan_stays_nan(bfloat16: bool) -> None:
    """A diverged loss must show, and not be hidden by a ReLU or a rounding."""
    rng = np.random.default_rng(4)
    weights, features, grad = weights_of(8, 16, 2, 5, rng), rng.normal(size=(8, 100)).astype(np.float32), np.ones((100, 5), np.float32)
    features[3, 70] = np.nan
    grad[20, 2] = np.nan
    out, grad_inputs, *grad_weights = passes(features, weights, grad, bfloat16)
    assert np.isnan(out[70]).all()
    assert np.isfinite(np.delete(out, 70, axis=0)).all()
    assert np.isnan(grad_inputs[:, 20]).all()
    assert all(np.isnan(w).any() for w in grad_weights)


@numba.njit
def _copy_rows(x, out):  # type: ignore[no-untyped-def]
    products.copy_rows(products.Rows(pointer(x), 0, x.shape[1]), x.shape[1], pointer(out), out.shape[0], out.shape[1])


@numba.njit
def _pack_row_pairs(x, out):  # type: ignore[no-untyped-def]
    products.pack_row_pairs(products.Rows(pointer(x), 0, x.shape[1]), x.shape[1], pointer(out), out.shape[0], out.shape[1])


def test_conversion_to_bfloat16_rounds_as_torch_does() -> None:
    special = torch.tensor([0.0, -0.0, 1.0, float("inf"), -float("inf"), float("nan"), 3.3895e38, 2.0**-126, -1.0039062, 1.0117188])
    x = torch.cat([special, torch.randn(998, generator=torch.Generator().manual_seed(0))]).reshape(21, 48)
    x.view(torch.int32)[20, 46:] = torch.tensor([0x7FFFFFFF, -1], dtype=torch.int32)  # none, whose bits a rounding would carry over into numbers
    out = np.full(x.shape, 7, np.int16)
    _copy_rows(x.numpy(), out)
    torch.testing.assert_close(torch.from_numpy(out).view(torch.bfloat16), x.bfloat16(), rtol=0, atol=0, equal_nan=True)
    paired = np.empty((10, 48), np.int32)
    _pack_row_pairs(x.numpy(), paired)
    assert np.array_equal(paired.view(np.int16).reshape(10, 48, 2), np.stack([out[:20:2], out[1:20:2]], axis=2))
    again = np.empty((10, 48), np.int32)
    _pack_row_pairs(out, again)
    assert np.array_equal(again, paired)


PROGRAM = """
import sys
import numpy as np
from efficientnerf.backends.numba.vector import products
from tests.efficientnerf.networks import passes, weights_of

assert not products.DOTS and products.VECTORS == 1
rng = np.random.default_rng(5)
weights = weights_of(24, 64, 2, 28, rng)
features, grad = rng.normal(size=(24, 200)).astype(np.float32), rng.normal(size=(200, 28)).astype(np.float32)
np.savez(sys.argv[1], *passes(features, weights, grad, True))
"""


@pytest.mark.slow
def test_a_processor_without_wide_registers_gives_the_same(tmp_path: Path) -> None:
    """Compiled for the oldest there is of this kind: pairs are multiplied in float32, and tiles are small."""
    environment = {**os.environ, "NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": "", "NUMBA_CACHE_DIR": str(tmp_path / "cache"), "NUMBA_NUM_THREADS": "1"}
    subprocess.run([sys.executable, "-c", PROGRAM, str(tmp_path / "out.npz")], cwd=ROOT, env=environment, check=True)
    rng = np.random.default_rng(5)
    weights = weights_of(24, 64, 2, 28, rng)
    features, grad = rng.normal(size=(24, 200)).astype(np.float32), rng.normal(size=(200, 28)).astype(np.float32)
    with np.load(tmp_path / "out.npz") as there:
        for here, other in zip(passes(features, weights, grad, True), there.values(), strict=True):
            assert np.linalg.norm(here - other) < 1e-2 * np.linalg.norm(here)


@pytest.mark.parametrize(("precision", "near", "layers"), [("float32", 1e-5, 1), ("bfloat16", 3e-2, 2), ("float32", 1e-5, 3)])
def test_the_field_is_that_of_plain_torch(precision: str, near: float, layers: int) -> None:
    """The same field in float64 goes through autograd alone."""
    generator = torch.Generator().manual_seed(0)
    field = hash.HashField(
        levels=3, log2_table=10, coarsest=4, finest=16, hidden=16, layers=layers, degree=1, initial_density=0.5, generator=generator, precision=precision
    )
    field.table.data.normal_(generator=generator)
    plain = copy.deepcopy(field).double()
    at = torch.rand(777, 3, generator=generator)
    towards = torch.randn(777, 13, generator=generator)
    ours, theirs = field(at), plain(at.double())
    (ours * towards).sum().backward()
    (theirs * towards).sum().backward()
    assert (ours - theirs).norm() < near * theirs.norm()
    groups = (ParameterGroup(dict(each.named_parameters()), buffers=each.gradient_buffers) for each in (field, plain))
    mine, its = ([group.gradient(name) for name in group.parameters] for group in groups)
    for one, other in zip(mine, its, strict=True):
        assert one is not None
        assert (one - other).norm() < 5 * near * other.norm()  # ReLUs close to zero fall to the other side
