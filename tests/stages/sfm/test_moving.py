"""What moves between photographs is told by its matches, which one motion explains and the cameras do not."""

import numpy as np
import pytest

from efficientnerf.capture.moving_parts import motions, moving_parts, share_of_parts
from efficientnerf.geometry.cameras import project
from tests.stages.sfm.made_matches import COUNT, POINTS, cameras, clouds

BALL = 60  # points that move
NONE = np.zeros((0, 2))
TAKEN = dict(enumerate(cameras()))
Matches = dict[tuple[int, int], np.ndarray]


def seen(elsewhere: int) -> dict[int, np.ndarray]:
    """(POINTS, 2) pixels of each camera, half a pixel off."""
    rng = np.random.default_rng(2)
    return {k: project(TAKEN[k], cloud)[0] + rng.normal(0, 0.4, (POINTS, 2)) for k, cloud in enumerate(clouds(elsewhere=elsewhere))}


def all_matches(wrong: float = 0.2) -> Matches:
    """Of all points in all pairs of pictures, a share of them wrong."""
    rng, made = np.random.default_rng(3), {}
    for i in range(COUNT):
        for j in range(i + 1, COUNT):
            rows = np.stack([np.arange(POINTS)] * 2, 1)
            bad = np.flatnonzero(rng.random(POINTS) < wrong)
            rows[bad, 1] = rng.permutation(rows[bad, 1])
            made[i, j] = rows.astype(np.uint32)
    return made


def test_a_ball_that_is_elsewhere_in_each_photograph_is_found_in_all_of_them() -> None:
    pixels = seen(BALL)
    found = moving_parts(TAKEN, pixels, all_matches().items())
    assert sorted(found) == list(range(COUNT))
    for k, share in found.items():
        whole = share_of_parts(pixels[k][-BALL:], NONE, TAKEN[k])
        assert 0.5 * whole < share < 1.2 * whole
    assert found == moving_parts(TAKEN, pixels, all_matches().items())


@pytest.mark.parametrize("wrong", [0.0, 1.0])
def test_wrong_matches_move_nothing(wrong: float) -> None:
    assert moving_parts(TAKEN, seen(0), all_matches(wrong).items()) == {}


def test_a_motion_is_a_similarity_of_a_patch() -> None:
    rng = np.random.default_rng(5)
    a = rng.uniform(0.3, 0.5, (40, 2))
    turned = 1.2 * (a - 0.4) @ np.array([[0.8, 0.6], [-0.6, 0.8]]) + (0.7, 0.3)
    others = rng.uniform(0, 1, (30, 2)), rng.uniform(0, 1, (30, 2))
    group = motions(np.concatenate([a, others[0]]), np.concatenate([turned, others[1]]))
    assert set(range(40)) <= set(group.tolist())
    assert len(group) < 45
    assert not len(motions(a, 3 * turned))  # three times as large
    assert not len(motions(a[:5], turned[:5]))
    assert not len(motions(*others))


def test_a_part_with_more_still_features_than_moving_ones_stands_still() -> None:
    """As a carpet, whose stitches are matched with their neighbours in some pairs."""
    y, x = np.mgrid[0:5, 0:5]
    patch = 10.0 * np.stack([x.ravel(), y.ravel()], 1)
    both = np.concatenate([patch + 50, patch + 250])
    one = share_of_parts(patch + 50, NONE, TAKEN[0])
    within = patch[:24] * 0.8 + 53
    assert share_of_parts(both, within, TAKEN[0]) == pytest.approx(2 * one)
    assert share_of_parts(both, np.concatenate([within, patch[:1] * 0.8 + 90]), TAKEN[0]) == pytest.approx(one)
    assert share_of_parts(patch + 50, patch + 100, TAKEN[0]) == pytest.approx(one), "those outside of its outline say nothing"


def test_a_pattern_that_is_matched_a_stitch_away_moves_nothing() -> None:
    """Some of its features are, in every pair; of more the others say that it stands still."""
    pixels, matches = seen(0), all_matches(0.0)
    for k, cloud in enumerate(clouds()):
        stitches = cloud[-3 * BALL :] * 0.2
        pixels[k][-3 * BALL :] = project(TAKEN[k], stitches)[0]
        pixels[k][-BALL:] = project(TAKEN[k], stitches[-BALL:] + 0.12 * np.array((np.cos(k), np.sin(k), 0.0)))[0]
    assert moving_parts(TAKEN, pixels, matches.items()) == {}
