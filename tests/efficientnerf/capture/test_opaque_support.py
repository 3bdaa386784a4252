"""The floor or table that sparse points show is opaque, unless rays to other points go through it."""

import numpy as np
import pytest

from efficientnerf.capture.supports import Support, opaque_support, support_of_patches

CAMERAS = np.array([[3 * np.cos(a), 3 * np.sin(a), 1.5] for a in np.arange(0, 2 * np.pi, 0.4)])
HEIGHT = -0.2


def found(points: np.ndarray) -> Support | None:
    """By rays from each camera to each point."""
    offset = points[None] - CAMERAS[:, None]
    length = np.linalg.norm(offset, axis=-1)
    origins = np.broadcast_to(CAMERAS[:, None], offset.shape)
    return opaque_support(points, CAMERAS, origins.reshape(-1, 3), (offset / length[..., None]).reshape(-1, 3), length.reshape(-1))


@pytest.fixture
def table() -> np.ndarray:
    """A few points all over a table, and more of them on the flat top of what stands on it."""
    rng = np.random.default_rng(0)
    on = np.column_stack([rng.uniform(-1, 1, (120, 2)), np.full(120, HEIGHT)])
    top = np.column_stack([rng.uniform(-0.15, 0.15, (200, 2)), np.full(200, 0.15)])
    return np.concatenate([on, top]) + rng.normal(0, 0.001, (320, 3))


def test_the_broadest_level_plane_holds_the_subject_not_the_one_of_most_points(table: np.ndarray) -> None:
    support = found(table)
    assert support is not None
    assert support.normal[2] > 0.999
    origins = np.array([[0.0, 0, 2], [0, 0, 2], [0.5, 0, 2], [0, 0, -2], [0, 0, 2]])
    directions = np.array([[0.0, 0, -1], [0.6, 0, -0.8], [0, 0, 1], [0, 0, 1], [1, 0, 0]])
    distance = support.distances(origins, directions)
    assert distance[0] == pytest.approx(2 - HEIGHT, abs=0.01)
    assert np.isinf(distance[1:]).all(), "past its outline, away from it, from below, along it"


def test_what_points_are_seen_through_is_not_opaque(table: np.ndarray) -> None:
    rng = np.random.default_rng(1)
    below = np.column_stack([rng.uniform(-0.6, 0.6, (20, 2)), rng.uniform(-0.8, -0.4, 20)])
    assert found(np.concatenate([table, below])) is None
    assert found(table[:20]) is None, "too few"
    assert found(rng.normal(0, 0.5, (500, 3))) is None, "no plane"


def test_a_pit_of_which_few_points_are_seen_stays_open(table: np.ndarray) -> None:
    rng = np.random.default_rng(2)
    pit = np.column_stack([rng.uniform(0.5, 0.55, (6, 2)), np.full(6, HEIGHT - 0.1)])
    support = found(np.concatenate([table, pit]))
    assert support is not None
    down = np.tile([[0.0, 0, -1]], (2, 1))
    into, away = support.distances(np.array([[0.52, 0.52, 1], [-0.5, -0.5, 1]]), down)
    assert np.isinf(into)
    assert away == pytest.approx(1 - HEIGHT, abs=0.01)


def of_patches(patches: np.ndarray, others: np.ndarray) -> Support | None:
    """Of patches on the table under a subject; by rays from each camera to the subject and to other points."""
    subject = np.random.default_rng(3).uniform((-0.2, -0.2, HEIGHT), (0.2, 0.2, 0.3), (300, 3))
    points = np.concatenate([subject, others])
    offset = points[None] - CAMERAS[:, None]
    length = np.linalg.norm(offset, axis=-1)
    rays = np.broadcast_to(CAMERAS[:, None], offset.shape).reshape(-1, 3), (offset / length[..., None]).reshape(-1, 3), length.reshape(-1)
    return support_of_patches((np.array([0.0, 0, 1]), HEIGHT), patches, subject, *rays)


def test_patches_round_a_subject_are_a_table_with_an_edge() -> None:
    """Two boards of a table, with a wide gap between them that nothing is seen through: only what is under the subject is part of the table."""
    x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(-2, 2, 81), np.linspace(-0.6, 0.6, 25)))
    boards = np.column_stack([x, y, np.full(len(x), HEIGHT)])[(np.hypot(x, y) > 0.25) & ((np.abs(x) < 0.6) | (np.abs(x) > 1.4))]
    support = of_patches(boards, np.zeros((0, 3)))
    assert support is not None
    down = np.tile([[0.0, 0, -1]], (4, 1))
    under, board, gap, past = support.distances(np.array([[0.0, 0, 2], [0.5, 0.5, 2], [1, 0, 2], [1.7, 0.8, 2]]), down)
    assert under == board == pytest.approx(2 - HEIGHT)
    assert np.isinf([gap, past]).all()


def test_patches_that_rays_go_on_through_are_no_table() -> None:
    x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(-1, 1, 41), np.linspace(-1, 1, 41)))
    patches = np.column_stack([x, y, np.full(len(x), HEIGHT)])
    below = np.column_stack([np.random.default_rng(4).uniform(-0.6, 0.6, (60, 2)), np.full(60, HEIGHT - 0.5)])
    assert of_patches(patches, np.zeros((0, 3))) is not None
    assert of_patches(patches, below) is None
    assert of_patches(patches[:41], np.zeros((0, 3))) is None, "on a line"
    ring = patches[np.hypot(x, y) > 0.35]
    hole = np.column_stack([np.random.default_rng(5).uniform(-0.05, 0.05, (60, 2)), np.full(60, HEIGHT - 0.1)])
    support = of_patches(ring, hole)
    assert support is not None, "what is seen through the gap of a ring is no part of it"
    assert np.isinf(support.distances(np.array([[0.0, 0, 2]]), np.array([[0.0, 0, -1]]))[0])


@pytest.mark.parametrize(
    ("middle", "radius", "seen_through", "solid"),
    [((0.6, 0.6), 0.25, False, True), ((0.6, 0.6), 0.25, True, False), ((1.0, 0.0), 0.25, False, False), ((-0.5, 1.0), 0.7, False, False)],
    ids=["enclosed", "seen through", "at the edge", "large"],
)
def test_a_gap_that_patches_enclose_is_part_of_the_table(middle: tuple[float, float], radius: float, seen_through: bool, solid: bool) -> None:
    x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(-1.5, 1, 51), np.linspace(-1, 2, 61)))
    patches = np.column_stack([x, y, np.full(len(x), HEIGHT)])[np.hypot(x - middle[0], y - middle[1]) > radius]
    below = np.array([[*middle, HEIGHT - 0.1]] * 3) if seen_through else np.zeros((0, 3))
    support = of_patches(patches, below)
    assert support is not None
    distance = support.distances(np.array([[*middle, 2.0], [-0.9, -0.9, 2.0]]) - [0.01, 0, 0], np.tile([[0.0, 0, -1]], (2, 1)))
    assert np.isfinite(distance).tolist() == [solid, True]
