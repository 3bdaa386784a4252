"""The paper's networks: hand-written passes against autograd, in both types; NeRF's own network; sizes."""

import pytest
import torch

from efficientnerf.backends.torch import linear_chain
from efficientnerf.backends.torch.linear_chain import chain, chain_reference
from efficientnerf.fields.mlp import MlpField
from efficientnerf.fields.nerf import NerfField

TOLERANCE = {torch.float32: 2e-5, torch.bfloat16: 4e-2}


def layers(sizes: list[tuple[int, int]]) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
    generator = torch.Generator().manual_seed(1)
    weights = [(torch.randn(o, i, generator=generator) * (2 / i) ** 0.5).requires_grad_() for i, o in sizes]
    return weights, [(0.1 * torch.randn(o, generator=generator)).requires_grad_() for _, o in sizes]


CASES = {
    "skip": ([(7, 16), (16, 16), (23, 16), (16, 5)], 2),
    "no skip": ([(7, 16), (16, 3)], None),
    "one layer": ([(7, 4)], None),
    "odd widths": ([(7, 13), (13, 11), (18, 9), (9, 5)], 2),
}


@pytest.mark.parametrize(("case", "precision"), [(case, (torch.float32, torch.bfloat16)[n % 2]) for n, case in enumerate(CASES)])
def test_passes_by_hand_are_those_of_autograd(case: str, precision: torch.dtype, monkeypatch: pytest.MonkeyPatch) -> None:
    """Over several chunks, the last of them short; gradients of weights, biases and, where nothing skips, of the input."""
    monkeypatch.setattr(linear_chain, "ROWS", 48)
    sizes, skip = CASES[case]
    weights, biases = layers(sizes)
    generator = torch.Generator().manual_seed(2)
    x = torch.randn(100, 7, generator=generator).requires_grad_(skip is None)
    towards = torch.randn(100, sizes[-1][1], generator=generator)
    leaves = [*weights, *biases, *([x] if skip is None else [])]
    ours, theirs = chain(x, weights, biases, skip=skip, precision=precision), chain_reference(x, weights, biases, skip)
    assert ours.dtype == torch.float32
    assert (ours - theirs).norm() < TOLERANCE[precision] * theirs.norm()
    for mine, its in zip(torch.autograd.grad((ours * towards).sum(), leaves), torch.autograd.grad((theirs * towards).sum(), leaves), strict=True):
        assert mine.dtype == torch.float32
        assert (mine - its).norm() < 5 * TOLERANCE[precision] * its.norm()  # a few ReLUs close to zero fall to the other side


def test_gradients_of_a_chain_are_finite_differences() -> None:
    weights, biases = ([p.detach().double().requires_grad_() for p in group] for group in layers(CASES["skip"][0]))
    x = torch.randn(5, 7, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).requires_grad_()
    assert torch.autograd.gradcheck(lambda x, *p: chain_reference(x, p[:4], p[4:], 2), (x, *weights, *biases))


@pytest.mark.parametrize(
    ("field", "expected"),
    [
        (MlpField(hidden=256, layers=8, degree=3, generator=torch.Generator()), 505_649),
        (MlpField(hidden=128, layers=4, degree=3, generator=torch.Generator()), 72_113),
        (NerfField(hidden=256, layers=8, generator=torch.Generator()), 595_844),  # as NeRF's published code
    ],
    ids=["standard", "light", "nerf"],
)
def test_networks_have_the_sizes_that_their_docstrings_say(field: torch.nn.Module, expected: int) -> None:
    import sys

    assert sum(p.numel() for p in field.parameters()) == expected
    assert f"{expected:,}" in (sys.modules[type(field).__module__].__doc__ or "")


def nerf() -> NerfField:
    return NerfField(hidden=16, layers=4, generator=torch.Generator().manual_seed(0))


def test_nerfs_colour_depends_on_the_direction_and_its_density_does_not() -> None:
    field = nerf()
    points = torch.rand(20, 3, generator=torch.Generator().manual_seed(3))
    one, other = (torch.nn.functional.normalize(torch.randn(20, 3, generator=torch.Generator().manual_seed(n)), dim=1) for n in (1, 2))
    first, second = field(points, one), field(points, other)
    assert first.shape == (20, 4)
    torch.testing.assert_close(first[:, 0], second[:, 0])
    torch.testing.assert_close(first[:, 0], field.density(points))
    assert (first[:, 1:] - second[:, 1:]).abs().min() > 0


@pytest.mark.parametrize("degree", [0, 4])
def test_any_degree_of_harmonics(degree: int) -> None:
    assert MlpField(hidden=8, layers=2, degree=degree, generator=torch.Generator())(torch.rand(3, 3)).shape == (3, 1 + 3 * (degree + 1) ** 2)


@pytest.mark.parametrize(("vendor", "flags", "chain_type", "fused_type"), [
    ("AuthenticAMD", "avx512f avx512_bf16", torch.bfloat16, torch.bfloat16),
    ("GenuineIntel", "avx512f avx512_bf16 amx_bf16", torch.bfloat16, torch.float32),
    ("AuthenticAMD", "avx512f", torch.float32, torch.float32),
    (None, "", torch.float32, torch.float32),
])  # fmt: skip
def test_bfloat16_is_used_where_it_is_faster(
    vendor: str | None, flags: str, chain_type: torch.dtype, fused_type: torch.dtype, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Fused networks multiply by dot products of AVX-512, which are slow on Intel's processors; layers one by one by AMX where there is any."""
    monkeypatch.setattr(linear_chain, "cpu_facts", lambda: {"flags": flags} | ({} if vendor is None else {"vendor_id": vendor}))
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: "AVX512")
    linear_chain.has_bfloat16.cache_clear()
    try:
        assert linear_chain.precision_of("auto", "cpu") is chain_type
        assert linear_chain.fused_precision_of("auto", "cpu") is fused_type
        assert {linear_chain.fused_precision_of(name, "cpu") for name in ("float32", "bfloat16")} == {torch.float32, torch.bfloat16}
    finally:
        linear_chain.has_bfloat16.cache_clear()
