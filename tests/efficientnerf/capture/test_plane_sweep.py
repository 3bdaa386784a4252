"""Photographs agree along the table that a subject stands on, however faint its grain is, and along nothing else."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from efficientnerf.capture import plane_sweep
from efficientnerf.capture.plane_sweep import Picture, SweptPlane, picture_of, swept_plane, swept_wall, wall_faces
from efficientnerf.geometry.cameras import Camera, project
from tests.efficientnerf.capture.plain_table import LEVEL, NORMAL, cameras, height, photograph, subject
from tests.poses import looking_at

ALL = cameras()


def pictures(images: Sequence[np.ndarray], usable: bool = True) -> list[Picture]:
    return [picture_of(image, np.full(image.shape, usable), camera, subject()) for image, camera in zip(images, ALL, strict=True)]


def found(images: Sequence[np.ndarray], points: np.ndarray | None = None) -> SweptPlane | None:
    return swept_plane(pictures(images), subject() if points is None else points, 0)


@pytest.fixture(scope="module")
def table() -> list[np.ndarray]:
    return [photograph(camera) for camera in ALL]


def test_the_table_is_found_where_no_feature_is(table: list[np.ndarray]) -> None:
    plane = found(table)
    assert plane is not None
    assert plane.normal @ NORMAL / np.linalg.norm(NORMAL) > np.cos(np.radians(0.5))
    assert plane.offset / plane.normal[2] == pytest.approx(LEVEL, abs=0.01)


def test_patches_lie_on_it_and_both_photographs_show_them(table: list[np.ndarray]) -> None:
    plane = found(table)
    assert plane is not None
    assert np.abs(height(plane.xyz)).max() < 0.02
    centres = np.array([camera.centre for camera in ALL])
    numbers = np.linalg.norm(plane.cameras[:, :, None] - centres, axis=-1).argmin(axis=-1)
    np.testing.assert_allclose(centres[numbers], plane.cameras)
    assert (numbers[:, 0] != numbers[:, 1]).all()
    for xyz, own in zip(plane.xyz[::40], numbers[::40], strict=True):
        for number in own:
            at, depth = project(ALL[number], xyz[None])
            assert depth[0] > 0
            assert (at[0] > 0).all()
            assert (at[0] < (ALL[number].width, ALL[number].height)).all()


def test_patches_keep_away_from_the_subject_and_from_what_is_masked(table: list[np.ndarray]) -> None:
    plane = found(table)
    assert plane is not None
    for number, picture in enumerate(pictures(table)):
        mine = np.linalg.norm(plane.cameras[:, 0] - picture.centre, axis=1) < 1e-9
        to = (plane.xyz[mine] - picture.centre) @ picture.rotation @ picture.matrix.T
        x, y = np.rint(to[:, :2] / to[:, 2:]).astype(int).T
        assert len(x), number
        assert picture.clear[y, x].all()
    assert swept_plane(pictures(table, usable=False), subject(), 0) is None


def test_a_patch_correlates_along_the_table_alone(table: list[np.ndarray]) -> None:
    made = pictures(table)[::2]
    stack = plane_sweep._Stack(made)
    patches = plane_sweep._Patches(stack, plane_sweep._pairs(stack.centres), np.eye(3), np.zeros(3), 0.8, np.random.default_rng(0)).chosen(LEVEL, 2.0, 96)
    slopes = NORMAL[:2] / NORMAL[2]
    assert patches.agreement(np.array([*slopes, LEVEL])) > 0.6
    for away in ([*slopes, LEVEL - 0.1], [*slopes, LEVEL + 0.1], [0.2, -0.2, LEVEL]):
        assert patches.agreement(np.array(away)) < 0.2


# The table stood up on its edge: its normal along -y, before it cameras in an arc.
UPRIGHT = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
WALL = np.array([np.cos(0.35), np.sin(0.35), 0, -np.sin(0.35), np.cos(0.35), 0, 0, 0, 1]).reshape(3, 3) @ UPRIGHT


def before_the_wall(turn: np.ndarray, step: int = 1) -> tuple[list[Picture], list[Camera], np.ndarray]:
    """Pictures of every so many cameras of the table's, their cameras, and the subject, all of them turned."""
    chosen = ALL[::step]
    images = [photograph(camera) for camera in chosen]
    turned = []
    for camera in chosen:
        pose = camera.world_from_camera.copy()
        pose[:3] = turn @ pose[:3]
        turned.append(replace(camera, world_from_camera=pose))
    points = subject() @ turn.T
    return [picture_of(image, np.full(image.shape, True), camera, points) for image, camera in zip(images, turned, strict=True)], turned, points


def test_a_wall_behind_the_subject_is_found_whichever_way_it_faces() -> None:
    made, turned, points = before_the_wall(WALL)
    faces = wall_faces(turned, points)
    assert faces is not None
    true = WALL @ NORMAL / np.linalg.norm(NORMAL)
    assert true @ [np.cos(faces), np.sin(faces), 0] > 0.9
    for off in (0.0, 0.7, -0.7):  # it faces elsewhere than the photographs are taken from
        plane = swept_wall(made, points, faces + off, 0)
        assert plane is not None
        assert plane.normal @ true > np.cos(np.radians(1))
        np.testing.assert_allclose(plane.offset, LEVEL / np.linalg.norm(NORMAL), atol=0.01)
        assert np.abs(plane.xyz @ true - plane.offset).max() < 0.03
    assert swept_plane(made, points, 0) is None, "nothing is below"


def test_no_wall_is_behind_what_is_photographed_from_all_round_or_above() -> None:
    assert wall_faces(ALL, subject()) is None
    assert wall_faces(ALL[:2], subject()) is None
    _, above, points = before_the_wall(np.eye(3))
    steep = [replace(camera, world_from_camera=looking_at((0.5, 0.3 * number, 4), (0, 0, 0))) for number, camera in enumerate(above[:6])]
    assert wall_faces(steep, points) is None


@pytest.mark.parametrize("case", ["each photograph shows another pattern", "half of them show another height", "no grain"])
def test_photographs_that_agree_along_no_plane_find_none(case: str) -> None:
    if case == "no grain":
        images = [photograph(camera, grain=0.0) for camera in ALL]
    elif case == "half of them show another height":
        images = [photograph(camera, level=LEVEL + 0.25 * (number % 2)) for number, camera in enumerate(ALL)]
    else:
        images = [photograph(camera, seed=number) for number, camera in enumerate(ALL)]
    assert found(images) is None


def test_a_plane_over_the_subject_is_none_that_it_stands_on(table: list[np.ndarray]) -> None:
    assert found(table, subject() - (0, 0, 0.6)) is None


def test_too_little_to_compare_finds_none_and_a_stop_is_heard(table: list[np.ndarray]) -> None:
    assert swept_plane(pictures(table)[:2], subject(), 0) is None
    assert swept_plane([], np.zeros((0, 3)), 0) is None
    assert found(table, np.zeros((5, 3))) is None, "points without extent"

    def stop(share: float) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        swept_plane(pictures(table), subject(), 0, stop)


def test_the_same_photographs_give_the_same_plane(table: list[np.ndarray]) -> None:
    first, second = found(table), found(table)
    assert first is not None
    assert second is not None
    np.testing.assert_array_equal(first.xyz, second.xyz)
    np.testing.assert_array_equal(first.normal, second.normal)
