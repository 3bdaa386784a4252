"""Chunks of rows side by side: the hash field's passes do not depend on how many threads share them, and are those of autograd."""

from __future__ import annotations

import copy
from collections.abc import Iterator

import numpy as np
import pytest
import torch

from efficientnerf.fields import hash as hash_module
from efficientnerf.kernels import cpu_network
from efficientnerf.kernels.rows import chunks_of, side_by_side
from tests.efficientnerf.test_fields import hash_field


@pytest.fixture(autouse=True)
def same_threads_after() -> Iterator[None]:
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)


@pytest.mark.parametrize("count", [0, 1, 2, 7, 100, 1001])
def test_chunks_cover_all_rows_once_and_are_as_even_as_may_be(count: int) -> None:
    chunks = chunks_of(count, 64)
    assert [n for chunk in chunks for n in range(count)[chunk]] == list(range(count))
    assert all(0 < chunk.stop - chunk.start <= 64 for chunk in chunks)
    assert count < 2 or len(chunks) % 2 == 0


def test_results_come_in_order_and_errors_come_out() -> None:
    torch.set_num_threads(2)
    assert side_by_side(lambda n: n * n, range(20)) == [n * n for n in range(20)]
    with pytest.raises(ZeroDivisionError):
        side_by_side(lambda n: 1 // (n - 3), range(5))
    assert torch.get_num_threads() == 2


def passes(threads: int, precision: str) -> list[torch.Tensor]:
    torch.set_num_threads(threads)
    field = hash_field()
    field.precision = precision
    generator = torch.Generator().manual_seed(3)
    at = torch.rand(3001, 3, generator=generator)
    raw = field(at)
    (raw * torch.randn(raw.shape, generator=generator)).sum().backward()
    return [raw.detach(), *(p.grad for p in field.parameters())]  # type: ignore[list-item]


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_the_number_of_threads_changes_no_byte(precision: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hash_module, "ROWS", 300)
    for one, two in zip(passes(1, precision), passes(2, precision), strict=True):
        assert torch.equal(one, two)


@pytest.mark.parametrize(("precision", "near"), [("float32", 1e-5), ("bfloat16", 3e-2)])
@pytest.mark.parametrize("layers", [1, 2, 3])
def test_passes_are_those_of_autograd(precision: str, near: float, layers: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Over several chunks, the last of them padded; autograd's are of the same field in float64."""
    monkeypatch.setattr(hash_module, "ROWS", 100)
    generator = torch.Generator().manual_seed(0)
    field = hash_module.HashField(
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
    for mine, its in zip(field.parameters(), plain.parameters(), strict=True):
        assert mine.grad is not None
        assert its.grad is not None
        assert (mine.grad - its.grad).norm() < 5 * near * its.grad.norm()  # ReLUs close to zero fall to the other side


def test_narrowing_rounds_as_torch_does() -> None:
    special = torch.tensor([0.0, -0.0, 1.0, float("inf"), -float("inf"), float("nan"), 3.3895e38, 1e-45, -1.0039062, 1.0117188])
    x = torch.cat([special, torch.randn(1000, generator=torch.Generator().manual_seed(0))])[:, None]
    out = np.full((1016, 1), 7, np.int16)
    cpu_network.narrow(x.view(torch.int32).numpy(), False, out)
    narrowed = torch.from_numpy(out).view(torch.bfloat16)
    assert not out[len(x) :].any()
    torch.testing.assert_close(narrowed[: len(x)], x.bfloat16(), rtol=0, atol=0, equal_nan=True)
    quiet = np.array([[0x7FFFFFFF], [-1]], np.int32)  # not numbers, whose bits a rounding would carry over into numbers
    cpu_network.narrow(quiet, False, out)
    assert torch.from_numpy(out[:2]).view(torch.bfloat16).isnan().all()
    back = np.empty((len(x), 1), np.float32)
    cpu_network.narrow(x.view(torch.int32).numpy(), False, out)
    cpu_network.widen(out, False, np.float32(0), back)
    torch.testing.assert_close(torch.from_numpy(back), x.bfloat16().float(), equal_nan=True, rtol=0, atol=0)
