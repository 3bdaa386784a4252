"""The last adjustment of all cameras and points."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.poses import aligned_errors
from stages.sfm import mapping
from stages.sfm.colmap import import_pycolmap
from stages.sfm.database import WorkImage
from tests.stages.sfm.made_matches import centres_of, synthesized


def made_model() -> tuple[Any, list[WorkImage], np.ndarray]:
    """Twelve cameras round 800 points that all of them see, pixels off by 0.4 px and points by a hundredth of a unit; and the true centres."""
    model, images = synthesized(12, 800, (1280, 512, 384, -0.04))
    centres = centres_of(model)
    rng = np.random.default_rng(0)
    for _, image in sorted(model.images.items()):
        for point in image.points2D:
            point.xy = point.xy + rng.normal(0, 0.4, 2)
    for _, point in sorted(model.points3D.items()):
        point.xyz = point.xyz + rng.normal(0, 0.01, 3)
    model.update_point_3d_errors()
    return model, images, centres


def test_an_even_choice_of_points_gives_the_cameras_of_all(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(mapping, "match_agreement", lambda *_: 1.0)
    start, images, centres = made_model()
    errors, points = {}, {}
    for most in (10**9, start.compute_num_observations() // 4):
        monkeypatch.setattr(mapping, "MANY_OBSERVATIONS", most)
        model = mapping.bundle_adjusted(tmp_path, images, start.__deepcopy__({}), lambda: None)
        errors[most] = float(np.sqrt((aligned_errors(centres_of(model), centres) ** 2).mean()))
        points[most] = model.compute_mean_reprojection_error()
        assert model.num_points3D() == start.num_points3D()
        assert model.cameras[1].mean_focal_length() == pytest.approx(1280, rel=0.01)
    every, some = errors
    assert errors[every] < errors[some] < 3 * errors[every] < 0.003
    assert points[some] == pytest.approx(points[every], rel=0.03)


def test_points_behind_a_camera_are_dropped() -> None:
    """One of them makes the mean error as large as can be."""
    pycolmap = import_pycolmap()
    model, images, _ = made_model()
    image = model.images[min(model.reg_image_ids())]
    frame = model.frames[image.frame_id]
    frame.rig_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.0, 1.0, 0.0, 0.0])), np.zeros(3)) * frame.rig_from_world  # looks away
    model.update_point_3d_errors()
    assert model.compute_mean_reprojection_error() > 1e6
    mapping.bundle_adjust(pycolmap, model, set(), iterations=1)
    assert model.compute_mean_reprojection_error() < 5
    assert image.num_points3D == 0
    assert model.compute_num_observations() == (len(images) - 1) * 800


def from_straight_above() -> tuple[Any, list[WorkImage]]:
    """Twelve cameras 10 above flat ground, in three rows of a flight, which look straight down; pixels off by 0.4 px."""
    pycolmap = import_pycolmap()
    model, images, _ = made_model()
    rng = np.random.default_rng(1)
    for k, (_, frame) in enumerate(sorted(model.frames.items())):
        centre = np.array([k % 4 - 1.5, k // 4 - 1.0, 10.0])
        frame.rig_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(np.diag([1.0, -1.0, -1.0])), np.diag([1.0, -1.0, -1.0]) @ -centre)
    for _, point in sorted(model.points3D.items()):
        point.xyz = np.array([*rng.uniform([-2.0, -1.5], [2.0, 1.5]), rng.normal(0, 0.02)])
    for _, image in sorted(model.images.items()):
        for point in image.points2D:
            if point.has_point3D():
                point.xy = image.project_point(model.points3D[point.point3D_id].xyz) + rng.normal(0, 0.4, 2)
    model.update_point_3d_errors()
    return model, images


def test_a_focal_length_that_photographs_do_not_determine_is_that_of_exif_data(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Straight down on flat ground a longer lens from higher up sees the same."""
    monkeypatch.setattr(mapping, "match_agreement", lambda *_: 1.0)
    from_above, views = from_straight_above()
    all_round, others, centres = made_model()
    for exif in (1000.0, 1600.0):
        images = [replace(image, focal=exif) for image in views]
        model = mapping.bundle_adjusted(tmp_path, images, from_above.__deepcopy__({}), lambda: None)
        assert model.cameras[1].mean_focal_length() == exif
        assert mapping.cameras_with_fixed_focal(images, model) == {1}
        ground = np.mean([point.xyz for point in model.points3D.values()], 0)
        assert np.linalg.norm(centres_of(model).mean(0) - ground) == pytest.approx(10 * exif / 1280, rel=0.03)
        images = [replace(image, focal=exif) for image in others]
        model = mapping.bundle_adjusted(tmp_path, images, all_round.__deepcopy__({}), lambda: None)
        assert model.cameras[1].mean_focal_length() == pytest.approx(1280, rel=0.01)
        assert not mapping.cameras_with_fixed_focal(images, model)
        assert np.sqrt((aligned_errors(centres_of(model), centres) ** 2).mean()) < 0.003
    model = mapping.bundle_adjusted(tmp_path, views, from_above.__deepcopy__({}), lambda: None)
    assert not mapping.cameras_with_fixed_focal(views, model)
