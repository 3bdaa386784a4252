"""What a set of Gaussians may hold, and its frames."""

import re
from dataclasses import replace

import numpy as np
import pytest

from efficientnerf.splats.gaussians import Gaussians, quaternions_from, rotation_matrices
from tests.efficientnerf.splats_reference import covariances


def some(count: int = 50, degree: int = 1, seed: int = 0) -> Gaussians:
    rng = np.random.default_rng(seed)
    rotations = rng.normal(size=(count, 4))
    rotations /= np.linalg.norm(rotations, axis=1, keepdims=True)
    harmonics = rng.normal(size=(count, (degree + 1) ** 2, 3))
    parts = rng.normal(size=(count, 3)), rng.uniform(0.01, 1, (count, 3)), rotations, rng.uniform(0.1, 0.9, count), harmonics
    return Gaussians(*(part.astype(np.float32) for part in parts))


@pytest.mark.parametrize(
    ("name", "value", "complaint"),
    [
        ("means", np.zeros((49, 3), np.float32), "scales of shape"),
        ("means", np.zeros((50, 3)), "means of shape (50, 3) and type float64"),
        ("means", np.full((50, 3), np.nan, np.float32), "means that are not finite"),
        ("scales", np.zeros((50, 3), np.float32), "scales that are not above 0"),
        ("opacities", np.zeros(50, np.float32), "opacities that are not between"),
        ("opacities", np.ones(50, np.float32), "opacities that are not between"),
        ("rotations", np.full((50, 4), 0.4, np.float32), "rotations that are not unit"),
        ("harmonics", np.zeros((50, 5, 3), np.float32), "harmonics of shape"),
        ("harmonics", np.zeros((50, 25, 3), np.float32), "harmonics of shape"),
        ("harmonics", np.zeros((50, 12), np.float32), "harmonics of shape"),
    ],
)
def test_what_no_gaussian_may_be_is_refused(name: str, value: np.ndarray, complaint: str) -> None:
    with pytest.raises(ValueError, match=re.escape(complaint)):
        replace(some(), **{name: value})


def test_quaternions_and_matrices_are_each_others_inverse() -> None:
    quaternions = np.concatenate([some(200).rotations.astype(np.float64), np.eye(4)])
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    matrices = rotation_matrices(quaternions)
    np.testing.assert_allclose(np.einsum("nij,nkj->nik", matrices, matrices), np.broadcast_to(np.eye(3), matrices.shape), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(matrices), 1)
    back = quaternions_from(matrices)
    np.testing.assert_allclose(np.abs((back * quaternions).sum(axis=1)), 1, atol=1e-12)  # a quaternion and its negative are one rotation


def test_covariances_are_those_of_the_own_axes() -> None:
    gaussians = some()
    found, axes = covariances(gaussians), rotation_matrices(gaussians.rotations)
    np.testing.assert_allclose(np.einsum("nij,njk->nik", found, axes), axes * np.square(gaussians.scales)[:, None], rtol=1e-5, atol=1e-7)
