"""Parts of the kernel that renders packed trees against their definitions: harmonics, rows, colours of a view."""

import numpy as np
import pytest

from efficientnerf.backends.numba.tree.view_colours import sh_basis
from efficientnerf.rendering.harmonics import basis_numpy


@pytest.mark.parametrize("degree", range(5))
def test_the_kernels_harmonics_are_those_of_the_project(degree: int) -> None:
    directions = np.random.default_rng(0).normal(size=(50, 3))
    directions = (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)
    expected = basis_numpy(directions.astype(np.float64), degree)
    for d, row in zip(directions, expected, strict=True):
        out = np.zeros(len(row), np.float32)
        sh_basis(*d, degree, out)
        np.testing.assert_allclose(out, row, atol=2e-6)
