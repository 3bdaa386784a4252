"""The floor or table that sparse points show is opaque, unless rays to other points go through it."""

import numpy as np
import pytest

from efficientnerf.capture.supports import Support, opaque_support

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
