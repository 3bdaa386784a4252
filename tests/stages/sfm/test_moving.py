"""What moves between photographs is told by its matches, which one motion explains and the cameras do not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from efficientnerf.capture.moving_parts import OF_A_PART, motions, moving_parts, share_of_parts
from efficientnerf.geometry.cameras import project
from stages.sfm import mapping
from stages.sfm.attempts import Search
from stages.sfm.reconstruction import find_models
from tests.stages.sfm.made_matches import COUNT, POINTS, QUIET, SIZE, cameras, clouds, matched

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


def test_a_patch_that_comes_twice_is_no_motion() -> None:
    """In half of the pairs it is matched with its twin; by the others both stand still."""
    pixels = {}
    for k, cloud in enumerate(clouds()):
        cloud[-BALL:] = cloud[-2 * BALL : -BALL] * 0.4 + np.array((0.3, -0.4, 0.2))
        cloud[-2 * BALL : -BALL] = cloud[-BALL:] + np.array((0.1, 0.7, 0.0))
        pixels[k] = project(TAKEN[k], cloud)[0]
    matches = all_matches(0.0)
    for (i, j), rows in matches.items():
        if (i + j) % 2:
            rows[-BALL:, 1] -= BALL
            rows[-2 * BALL : -BALL, 1] += BALL
    i, j = 0, 1
    a, b = (pixels[k][matches[i, j][-BALL:, side]] / SIZE[0] for side, k in enumerate((i, j)))
    assert len(motions(a, b)) > BALL / 2  # of this pair alone it looks like one
    assert moving_parts(TAKEN, pixels, matches.items()) == {}


def test_what_stays_in_the_picture_is_no_motion() -> None:
    """As a date that was burnt in."""
    pixels = seen(0)
    for places in pixels.values():
        places[-BALL:] = np.random.default_rng(4).uniform((20, 20), (120, 60), (BALL, 2))
    assert moving_parts(TAKEN, pixels, all_matches(0.1).items()) == {}


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


def test_the_share_is_that_of_the_outlines_of_what_lies_together() -> None:
    y, x = np.mgrid[0:5, 0:5]
    patch = 10.0 * np.stack([x.ravel(), y.ravel()], 1)  # 40 by 40 px
    one = share_of_parts(patch + 50, NONE, TAKEN[0])
    assert one == pytest.approx(1600 / (SIZE[0] * SIZE[1]))
    assert share_of_parts(np.concatenate([patch + 50, patch + 250]), NONE, TAKEN[0]) == pytest.approx(2 * one)
    assert share_of_parts(np.concatenate([patch + 50, patch[:3] + 250, patch + 50.2]), NONE, TAKEN[0]) == pytest.approx(one)
    assert share_of_parts(patch[: OF_A_PART - 1], NONE, TAKEN[0]) == 0.0
    assert share_of_parts(patch[:0], NONE, TAKEN[0]) == 0.0


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


@pytest.mark.parametrize("elsewhere", [0, BALL])
def test_the_mapper_s_cameras_show_what_moved(tmp_path: Path, elsewhere: int) -> None:
    images = matched(tmp_path, list(TAKEN.values()), elsewhere)
    found = find_models(Search(tmp_path, images, 0, POINTS, 1, **QUIET), "exhaustive")
    model = mapping.bundle_adjusted(found.work, images, found.models[0], QUIET["safe_point"])
    shares = mapping.moving_shares(found.work, images, model, QUIET["safe_point"])
    assert sorted(shares) == ([image.name for image in images] if elsewhere else [])
    assert all(0.001 < share < 0.1 for share in shares.values())
