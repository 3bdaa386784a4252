"""Fields: the hash grid against the loop, the paper's networks by their sizes, one contract for both."""

from __future__ import annotations

import copy
from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import nn

from efficientnerf.backends.torch.hash_grid import encode
from efficientnerf.fields.hash import HashField
from efficientnerf.fields.mlp import MlpField, positional_encoding
from efficientnerf.training.optimiser import ParameterGroup


def hash_field(degree: int = 2, seed: int = 0) -> HashField:
    """Levels of 4, 8 and 16 points a side: the first two stored whole, the last hashed into 1024 entries."""
    generator = torch.Generator().manual_seed(seed)
    field = HashField(levels=3, log2_table=10, coarsest=4, finest=16, hidden=16, layers=2, degree=degree, initial_density=1.0, generator=generator)
    field.table.data.normal_(generator=generator)
    return field


def mlp_field(degree: int = 2, seed: int = 0) -> MlpField:
    return MlpField(hidden=16, layers=4, degree=degree, generator=torch.Generator().manual_seed(seed))


def gradients(field: nn.Module) -> dict[str, torch.Tensor | None]:
    """Of a field's parameters, by name."""
    group = ParameterGroup(dict(field.named_parameters()), buffers=field.gradient_buffers)  # type: ignore[arg-type]
    return {name: group.gradient(name) for name in group.parameters}


def points(count: int = 200) -> torch.Tensor:
    corners = torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0], [0.0, 1.0, 0.5]])
    return torch.cat([torch.rand(count, 3, generator=torch.Generator().manual_seed(4)), corners])


def test_encoding_is_continuous_and_hits_the_lattice() -> None:
    field = hash_field()
    lattice = torch.tensor([[1 / 3, 2 / 3, 0.0]])
    features = [encode(lattice + shift, field.table, field.hash_levels) for shift in (0.0, 1e-6, -1e-6)]
    torch.testing.assert_close(features[0][0, :2], field.table[(1 * 4 + 2) * 4 + 0], rtol=1e-5, atol=1e-5)
    for beside in features[1:]:
        torch.testing.assert_close(beside, features[0], rtol=0, atol=1e-3)


@pytest.mark.parametrize("make", [hash_field, mlp_field], ids=["hash", "mlp"])
@pytest.mark.parametrize("degree", [0, 2, 3])
def test_the_contract(make: Callable[..., nn.Module], degree: int) -> None:
    field = make(degree)
    at = points()
    out = field(at)
    assert out.shape == (len(at), 1 + 3 * (degree + 1) ** 2)
    torch.testing.assert_close(field.density(at), out[:, 0])
    assert field.degree == degree
    assert field.activation in ("exp", "softplus")
    assert field(at[:0]).shape == (0, out.shape[1])
    assert torch.equal(make(degree)(at), out)  # the same generator gives the same field
    assert not torch.equal(make(degree, seed=1)(at), out)


@pytest.mark.parametrize(
    ("hidden", "layers", "expected"),
    [
        # (inputs + 1) * outputs, layer by layer: 63 in, the skip adds 63 to the layer in the middle, 49 out
        (256, 8, 64 * 256 + 6 * 257 * 256 + (256 + 64) * 256 + 257 * 49),
        (128, 4, 64 * 128 + 2 * 129 * 128 + (128 + 64) * 128 + 129 * 49),
    ],
)
def test_the_papers_networks_have_the_papers_sizes(hidden: int, layers: int, expected: int) -> None:
    field = MlpField(hidden=hidden, layers=layers, degree=3, generator=torch.Generator().manual_seed(0))
    assert sum(p.numel() for p in field.parameters()) == expected
    assert field(torch.rand(2, 3)).shape == (2, 49)


def test_positional_encoding_has_63_numbers_and_its_closed_form() -> None:
    at = torch.tensor([[0.3, -0.7, 1.0]], dtype=torch.float64)
    x = at[0].tolist()
    angles = [2**l * v for l in range(10) for v in x]
    expected = [*x, *np.sin(angles), *np.cos(angles)]
    np.testing.assert_allclose(positional_encoding(at)[0], expected, atol=1e-12)
    assert positional_encoding(at).shape == (1, 63)


@pytest.mark.parametrize(("precision", "tolerance"), [("float32", 1e-5), ("bfloat16", 6e-2)])
@pytest.mark.parametrize("count", [1, 203, 2300])
def test_the_hash_fields_passes_are_autograds(precision: str, tolerance: float, count: int) -> None:
    """Values and gradients of the written-out passes against plain torch in float64, by their norms."""
    field, at = hash_field(), points(count)
    field.precision = precision
    towards = torch.randn(len(at), 28, generator=torch.Generator().manual_seed(2))
    exact = copy.deepcopy(field).double()
    seen = field(at)
    (seen * towards).sum().backward()
    expected = exact(at.double())
    (expected * towards).sum().backward()
    assert (seen - expected).norm() <= tolerance * expected.norm()
    for (name, ours), theirs in zip(gradients(field).items(), gradients(exact).values(), strict=True):
        assert ours is not None
        assert (ours - theirs).norm() <= tolerance * theirs.norm(), name
