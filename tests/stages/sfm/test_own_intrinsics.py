"""Intrinsics of each photograph's own: found where they differ, and left alone where they do not."""

from typing import Any

import numpy as np
import pytest

from benchmarks.poses import aligned_errors
from stages.sfm.database import WorkImage
from stages.sfm.intrinsics.own import FOCAL_LENGTH, PRINCIPAL_POINT, with_own_intrinsics
from tests.stages.sfm.made_matches import centres_of, synthesized

FOCAL, MIDDLE = 1280.0, np.array([512.0, 384.0])


def made_model(factors: np.ndarray, shifts: np.ndarray, *, noise: float = 0.3) -> tuple[Any, list[WorkImage], np.ndarray]:
    """Cameras round 500 points, of focal lengths that differ by factors (C,), and principal points by shifts (C, 2) pixels; and the true centres."""
    model, images = synthesized(len(factors), 500, (FOCAL, *MIDDLE, 0.0))
    rng = np.random.default_rng(0)
    for image_id, factor, shift in zip(sorted(model.reg_image_ids()), factors, shifts, strict=True):
        for point in model.images[image_id].points2D:
            point.xy = (point.xy - MIDDLE) * factor + MIDDLE + shift + rng.normal(0, noise, 2)
    model.update_point_3d_errors()
    return model, images, centres_of(model)


def test_focus_breathing_is_found() -> None:
    factors = np.random.default_rng(1).uniform(0.97, 1.03, 12)
    model, images, centres = made_model(factors, np.zeros((12, 2)))
    own, which = with_own_intrinsics(images, model, lambda: None)
    assert which == FOCAL_LENGTH
    found = np.array([own.cameras[own.images[i].camera_id].mean_focal_length() for i in sorted(own.reg_image_ids())])
    assert found / found.mean() == pytest.approx(factors / factors.mean(), rel=2e-3)
    assert own.num_points3D() == model.num_points3D()
    assert own.compute_mean_reprojection_error() < 0.5
    assert np.sqrt((aligned_errors(centres_of(own), centres) ** 2).mean()) < 0.01


def test_principal_points_are_found_where_they_matter() -> None:
    """A small shift is as good as a rotation: it is not worth the accuracy of the centres."""
    shifts = np.random.default_rng(2).normal(0, 1, (12, 2))
    model, images, _ = made_model(np.ones(12), 3 * shifts)
    assert with_own_intrinsics(images, model, lambda: None)[1] is None
    model, images, _ = made_model(np.ones(12), 40 * shifts)
    shared = model.compute_mean_reprojection_error()
    own, which = with_own_intrinsics(images, model, lambda: None)
    assert which == PRINCIPAL_POINT
    assert own.compute_mean_reprojection_error() < min(0.5, 0.9 * shared)
