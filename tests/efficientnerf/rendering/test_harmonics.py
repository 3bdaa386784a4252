"""Spherical harmonics: orthonormal, of the documented order and signs."""

import numpy as np
import pytest
import torch

from efficientnerf.rendering.harmonics import MAX_DEGREE, basis, basis_numpy
from tests import reference


def test_they_are_orthonormal_over_the_sphere() -> None:
    z, weight = np.polynomial.legendre.leggauss(12)  # exact for the products: polynomials of degree 8 in z
    azimuth = np.arange(24) * 2 * np.pi / 24  # ... and of order 8 in the azimuth
    ring = np.sqrt(1 - z**2)[:, None]
    directions = np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), np.broadcast_to(z[:, None], (12, 24))], -1).reshape(-1, 3)
    area = np.repeat(weight * 2 * np.pi / 24, 24)
    y = basis_numpy(directions, MAX_DEGREE)
    np.testing.assert_allclose((y * area[:, None]).T @ y, np.eye((MAX_DEGREE + 1) ** 2), atol=1e-12)


@pytest.mark.parametrize("degree", [0, 4])
def test_they_are_those_of_the_definition(degree: int) -> None:
    directions = np.random.default_rng(degree).normal(size=(40, 3))
    directions = np.concatenate([directions / np.linalg.norm(directions, axis=1, keepdims=True), np.eye(3), -np.eye(3)])
    expected = np.array([reference.harmonics(d, degree) for d in directions])
    np.testing.assert_allclose(basis_numpy(directions, degree), expected, atol=1e-12)
    np.testing.assert_allclose(basis(torch.from_numpy(directions), degree).numpy(), expected, atol=1e-12)
