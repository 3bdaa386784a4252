"""Whether photographs were taken from almost one place: what lies behind a subject says nothing of it."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from efficientnerf.geometry.cameras import Camera
from stages.io.capture import Capture, Photo, Provenance, SparsePoints
from stages.verdict.parallax import SMALL_ANGLE, parallax
from stages.verdict.verdict import verdict_on
from tests.poses import looking_at

COUNT = 48
RNG = np.random.default_rng


def looking(centre: np.ndarray, at: np.ndarray, number: int) -> Photo:
    return Photo(Camera(f"{number:02d}.jpg", 640, 480, "SIMPLE_PINHOLE", (500.0, 320.0, 240.0), looking_at(centre, at)), Path("none"))


def on_circle(radius: float, height: float = 0.0, count: int = COUNT) -> np.ndarray:
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(count, height)], 1)


def seen_by(xyz: np.ndarray, photos: list[Photo], most: int) -> SparsePoints:
    """The points, each with a track of so many photographs at most, those whose axes pass it most closely."""
    centres, forward = np.array([photo.camera.centre for photo in photos]), np.array([photo.camera.forward for photo in photos])
    tracks = []
    for point in xyz:
        towards = point - centres
        cosine = (towards * forward).sum(1) / np.linalg.norm(towards, axis=1)
        best = np.argsort(-cosine)[:most]
        first = int(best[0])
        near = np.argsort(np.linalg.norm(centres - centres[first], axis=1), kind="stable")[:most]  # neighbours match, of those that have it in view
        tracks.append(tuple(sorted(int(n) for n in near if cosine[n] > 0.75)) or (first,))
    return SparsePoints(xyz, np.zeros(xyz.shape, np.uint8), np.zeros(len(xyz)), tuple(tracks))


def room(count: int, distance: float, seed: int = 0) -> np.ndarray:
    directions = RNG(seed).normal(size=(count, 3))
    directions[:, 2] *= 0.3
    return np.asarray(distance * directions / np.linalg.norm(directions, axis=1, keepdims=True))


def ring(wrong: int = 0, subject: int = 40) -> tuple[SparsePoints, list[Photo]]:
    """Round a subject of few points in a room of many."""
    photos = [looking(centre, np.zeros(3) + RNG(n).normal(0, 0.15, 3), n) for n, centre in enumerate(on_circle(3.0, 1.5))]
    for n in range(wrong):
        photos[7 * n] = looking(RNG(n).normal(0, 5, 3), RNG(n + 1).normal(0, 5, 3), 7 * n)
    xyz = np.concatenate([RNG(1).normal(0, 0.4, (subject, 3)), room(2000, 70.0)])
    return seen_by(xyz, photos, 4), photos


def turned(cone: float, noise: float) -> tuple[SparsePoints, list[Photo]]:
    """A camera that turns on the spot by so many degrees, found up to so much noise of its centre, in a scene that begins 3 away."""
    azimuth = np.radians(np.linspace(0, cone, COUNT))
    centres = RNG(2).normal(0, noise, (COUNT, 3))
    photos = [looking(c, c + np.array([np.cos(a), np.sin(a), 0.1 * np.sin(3 * a)]), n) for n, (c, a) in enumerate(zip(centres, azimuth, strict=True))]
    away = RNG(3).uniform(3, 20, 1500)
    angle = np.radians(RNG(4).uniform(-20, cone + 20, 1500))
    return seen_by(np.stack([away * np.cos(angle), away * np.sin(angle), away * RNG(5).uniform(-0.3, 0.3, 1500)], 1), photos, 8), photos


def outward() -> tuple[SparsePoints, list[Photo]]:
    """At arm's length of somebody who turns round: the axes meet behind the cameras."""
    photos = [looking(centre, 2 * centre, n) for n, centre in enumerate(on_circle(0.3))]
    return seen_by(room(1500, 30.0), photos, 6), photos


def inward() -> tuple[SparsePoints, list[Photo]]:
    """The axes meet a little before the cameras, where nothing is."""
    photos = [looking(centre, np.zeros(3), n) for n, centre in enumerate(on_circle(0.3))]
    return seen_by(room(1500, 30.0), photos, 6), photos


def verdict_words(points: SparsePoints, photos: list[Photo]) -> set[str]:
    found = Provenance(pairs_agreeing=0.97, planar_pairs=0.9, components=[len(photos)], models=[len(photos)])
    return {each.what for each in verdict_on(Capture("photographs", tuple(photos), None, points=points, provenance=found), {}).problems}


@pytest.mark.parametrize("wrong", [0, 1, 3])
@pytest.mark.parametrize("subject", [15, 40])
def test_a_ring_in_a_large_room_is_not_one_place(wrong: int, subject: int) -> None:
    points, photos = ring(wrong, subject)
    towards = [np.array([photos[n].camera.centre for n in track]) - xyz for xyz, track in zip(points.xyz, points.tracks, strict=True)]
    every = [np.degrees(np.arccos((t @ t.T / np.outer(*2 * [np.linalg.norm(t, axis=1)])).min().clip(-1, 1))) for t in towards if len(t) > 1]
    assert np.median(every) < SMALL_ANGLE, "as most points have it"
    found = parallax(points, photos)
    assert found.subject
    assert not found.small
    assert found.angle > SMALL_ANGLE
    assert not {"parallax", "one place"} & verdict_words(points, photos)


@pytest.mark.parametrize("made", [lambda: turned(300, 0.0), lambda: turned(300, 0.02), lambda: turned(60, 0.02), lambda: turned(60, 0.001), outward, inward])
def test_a_camera_that_only_turns_is_in_one_place(made: Callable[[], tuple[SparsePoints, list[Photo]]]) -> None:
    points, photos = made()
    found = parallax(points, photos)
    assert (found.subject, found.small) == (False, True)
    assert {"parallax", "one place"} <= verdict_words(points, photos)


def test_no_points_and_hardly_a_camera_show_no_depth() -> None:
    points, photos = ring()
    none = SparsePoints(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(0), ())
    assert parallax(none, photos).small
    assert parallax(SparsePoints(points.xyz[:1], points.rgb[:1], points.error[:1], ((0,),)), photos[:1]).angle == 0.0
