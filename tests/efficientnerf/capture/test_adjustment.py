"""How sure the shape of adjusted cameras and points is: as bundle adjustments of noisy observations differ, in any frame."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from efficientnerf.capture.adjustment import shape_spread
from efficientnerf.geometry.cameras import Camera, Similarity, project
from tests.efficientnerf.capture.rings import cameras_round

FOCAL = 1200.0
NOISE = 0.5  # px
MISS = NOISE * np.sqrt(np.pi / 2)  # how far off it is in the mean


def scene() -> tuple[list[Camera], np.ndarray]:
    """Four cameras of one lens, and points that all of them see."""
    rng = np.random.default_rng(0)
    cameras = [replace(each, params=(FOCAL, FOCAL, 800.0, 600.0, 0.0, 0.0, 0.0, 0.0)) for each in cameras_round(4, rng)]
    return cameras, rng.uniform(-0.8, 0.8, (20, 3))


def spread(cameras: list[Camera], xyz: np.ndarray, miss: float = MISS) -> float:
    observers = np.tile(np.arange(len(cameras)), len(xyz))
    return shape_spread(cameras, xyz, np.full(len(xyz), len(cameras)), observers, miss, np.ones(len(xyz), bool), and_cameras=True)


def moved(cameras: list[Camera], xyz: np.ndarray, step: np.ndarray) -> tuple[list[Camera], np.ndarray]:
    """By turns and shifts of the cameras, a focal length, a radial distortion, and shifts of the points."""
    count, out = len(cameras), []
    f, bend = cameras[0].params[0] * np.exp(step[6 * count]), step[6 * count + 1]
    for camera, (turn, shift) in zip(cameras, step[: 6 * count].reshape(count, 2, 3), strict=True):
        pose = camera.world_from_camera.copy()
        pose[:3, :3] = Rotation.from_rotvec(turn).as_matrix() @ pose[:3, :3]
        pose[:3, 3] += shift
        out.append(replace(camera, params=(f, f, 800.0, 600.0, bend, 0.0, 0.0, 0.0), world_from_camera=pose))
    return out, xyz + step[6 * count + 2 :].reshape(-1, 3)


def test_adjustments_of_noisy_observations_differ_by_as_much() -> None:
    """Those of least squares, of numerical derivatives."""
    cameras, xyz = scene()
    size, true = 6 * len(cameras) + 2 + 3 * len(xyz), np.concatenate([xyz, [camera.centre for camera in cameras]])

    def seen(step: np.ndarray) -> np.ndarray:
        own, points = moved(cameras, xyz, step)
        return np.concatenate([project(camera, points)[0].ravel() for camera in own])

    slope = np.stack([(seen(1e-5 * unit) - seen(-1e-5 * unit)) / 2e-5 for unit in np.eye(size)], 1)
    fitted, middle, strains = np.linalg.pinv(slope, 1e-9), true - true.mean(0), []
    for seed in range(200):
        own, points = moved(cameras, xyz, fitted @ np.random.default_rng(seed).normal(0, NOISE, len(slope)))
        found = np.concatenate([points, [camera.centre for camera in own]])
        affine = np.linalg.lstsq(middle, found - found.mean(0), rcond=None)[0]
        strains.append(((affine + affine.T) / 2 / np.cbrt(np.linalg.det(affine))).ravel())
    most = np.sqrt(2 * np.linalg.eigvalsh(np.cov(np.array(strains).T))[-1])
    assert most == pytest.approx(spread(cameras, xyz), rel=0.25)


def test_it_depends_on_no_frame_nor_on_cameras_that_see_nothing_and_grows_with_the_noise() -> None:
    cameras, xyz = scene()
    frame = Similarity(3.7, Rotation.from_rotvec([0.3, -0.8, 0.5]).as_matrix(), np.array([5.0, 1.0, -2.0]))
    expected = spread(cameras, xyz)
    assert spread([frame.camera(camera) for camera in cameras], frame.points(xyz)) == pytest.approx(expected, rel=1e-3)
    assert spread(cameras, xyz, 2 * MISS) == pytest.approx(2 * expected)
    observers, counts, every = np.tile(np.arange(4), len(xyz)), np.full(len(xyz), 4), np.ones(len(xyz), bool)
    assert shape_spread([*cameras, cameras[0]], xyz, counts, observers, MISS, every, and_cameras=True) == pytest.approx(expected)


def test_what_is_not_determined_is_not_known() -> None:
    cameras, xyz = scene()
    assert np.isnan(spread(cameras[:2], xyz))
    assert np.isnan(spread(cameras, xyz[:5]))
    assert spread([replace(camera, world_from_camera=cameras[0].world_from_camera) for camera in cameras], xyz) > 0.1
