"""The path along the captured cameras: smooth, in order, at constant speed, through cameras."""

import itertools

import numpy as np
import pytest

from efficientnerf.asset.camera_paths import pose_on_sphere
from efficientnerf.capture.captured_path import captured_path

ARC = [pose_on_sphere((0.0, 0.0, 0.0), 3.0, azimuth, 15.0) for azimuth in range(0, 150, 10)]
ROUND = [pose_on_sphere((0.1, 0.0, 0.0), 3.0, azimuth, 15.0) for azimuth in range(0, 360, 15)]


def moved(path: list[np.ndarray]) -> np.ndarray:
    return np.array([np.linalg.norm(b[:3, 3] - a[:3, 3]) for a, b in itertools.pairwise(path)])


def is_rotation(pose: np.ndarray) -> bool:
    return np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-9) and np.linalg.det(pose) > 0 and pose[3].tolist() == [0, 0, 0, 1]


def test_a_path_along_an_arc_stays_on_it_from_end_to_end_at_constant_speed() -> None:
    path = captured_path(ARC, 60)
    assert len(path) == 60
    assert all(is_rotation(pose) for pose in path)
    np.testing.assert_allclose(path[0], ARC[0], atol=1e-6)
    np.testing.assert_allclose(path[-1], ARC[-1], atol=1e-6)
    for pose in path:
        assert np.linalg.norm(pose[:3, 3]) == pytest.approx(3.0, rel=0.02)
        assert pose[:3, 2] @ (-pose[:3, 3] / np.linalg.norm(pose[:3, 3])) > np.cos(np.radians(2)), "it looks at the middle, as the cameras do"
    assert moved(path).max() < 1.15 * moved(path).min()


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("poses", [ARC, ROUND], ids=["arc", "round"])
def test_files_in_no_order_are_walked_past_neighbour_by_neighbour(poses: list[np.ndarray], seed: int) -> None:
    shuffled = [poses[k] for k in np.random.default_rng(seed).permutation(len(poses))]
    ordered, path = moved(captured_path(poses, 60)).sum(), moved(captured_path(shuffled, 60)).sum()
    assert path < 1.3 * ordered


def test_rolled_photographs_do_not_roll_the_path() -> None:
    quarter = np.eye(4)
    quarter[:2, :2] = [[0.0, -1.0], [1.0, 0.0]]
    rolled = [pose @ quarter if k % 3 == 0 else pose for k, pose in enumerate(ARC)]
    np.testing.assert_allclose(captured_path(rolled, 30), captured_path(ARC, 30), atol=1e-9)


@pytest.mark.parametrize("count", [1, 2, 3, 1000])
def test_any_number_of_cameras_gives_a_path(count: int) -> None:
    poses = [pose_on_sphere((0.0, 0.0, 0.0), 3.0, 90.0 * k / count, 15.0) for k in range(count)]
    path = captured_path(poses, 30)
    assert len(path) == 30
    assert all(is_rotation(pose) for pose in path)
    assert np.isfinite(path).all()
    assert captured_path(poses, 1)[0].shape == (4, 4)
