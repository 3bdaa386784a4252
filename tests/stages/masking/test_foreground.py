"""Silhouettes of the foreground: what of a trained scene is its subject, how masks of it are made, and when they are refused."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from efficientnerf.asset.tree import Region
from efficientnerf.capture.foreground import Foreground
from efficientnerf.geometry.cameras import Camera, rays
from pipeline.errors import BadInput
from stages.io import scene
from stages.masking import foreground
from stages.masking.subject import Subject, subject_of
from stages.poses import run as poses
from tests.stages import captures

RADIUS = 0.6
FLOOR = ((np.array([0.0, 0.0, 1.0]), 0.0),)


def on_plane(count: int, noise: float) -> np.ndarray:
    generator = np.random.default_rng(1)
    places = generator.uniform(-2, 2, (count, 3))
    places[:, 2] = noise * generator.normal(size=count)
    return places


def test_a_subject_is_cut_off_close_to_what_supports_it() -> None:
    """By a plane found anew from all points round it: the one that is given is off by half a cell, and tilted."""
    side = 0.1
    grid = np.stack(np.meshgrid(*(np.arange(-0.5, 0.55, side),) * 2, np.arange(0.05, 0.9, side), indexing="ij"), axis=-1).reshape(-1, 3)
    tilted = np.array([0.02, 0.0, 1.0]) / np.linalg.norm([0.02, 0.0, 1.0])
    given = Foreground(Region(np.array([[-0.8] * 3, [0.8, 0.8, 1.1]])), side, grid, ((tilted, 0.05),))
    slab = np.random.default_rng(3).uniform([0.55, -0.3, 0.02], [0.75, 0.3, 0.06], (2000, 3))  # within the tolerance by which the support was found
    seen_of_it = np.random.default_rng(4).uniform([-0.5, -0.5, 0.01], [0.55, 0.5, 0.9], (20_000, 3))
    found = subject_of(given, np.concatenate([on_plane(20_000, 0.004), slab, seen_of_it]))
    ((normal, offset), above), *others = found.planes
    assert not others
    np.testing.assert_allclose(normal, [0, 0, 1], atol=1e-3)
    assert abs(offset) < 1e-3
    assert 0.004 < above < 0.02
    places = np.array([[0, 0, 0.5], [0, 0, above + 0.01], [0, 0, 0.0], [1.5, 0, 0.5], [0.56, 0, 0.4], [0.7, 0, 0.04], [0.7, 0, 0.0]])
    assert found.holds(places).tolist() == [True, True, False, False, True, True, False]


def ball_pictures(made: list[Camera], offset: float = 0.0) -> dict[str, np.ndarray]:
    """How much of each pixel a ball covers; it is elsewhere in each picture by so much."""
    found = {}
    for index, camera in enumerate(made):
        y, x = np.mgrid[: camera.height, : camera.width] + 0.5
        origins, directions = rays(camera, np.stack([x, y], -1).reshape(-1, 2))
        to = np.array([offset * np.cos(2.4 * index), offset * np.sin(2.4 * index), 0]) - origins
        away = np.linalg.norm(to - (to * directions).sum(1)[:, None] * directions, axis=1)
        found[camera.name] = (away < RADIUS).astype(float).reshape(camera.height, camera.width)
    return found


@pytest.fixture
def source(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A posed data set whose first training is left out: a ball is found in it."""
    made = captures.cameras(8)
    seen(monkeypatch, ball_pictures(made))
    return captures.nerfstudio(tmp_path / "source", made)


def seen(monkeypatch: pytest.MonkeyPatch, pictures: dict[str, np.ndarray]) -> list[str]:
    """Let the silhouettes be these; returns the names of those that were asked for, as they are."""
    asked: list[str] = []

    class Field:
        model, near, far = None, 0.1, 10.0

        def __init__(self, cameras: list[Camera]) -> None:
            self.cameras = cameras

    def coverage(_: object, subject: object, camera: Camera, *planes: float) -> np.ndarray:
        asked.append(camera.name)
        return pictures[camera.name.rsplit("/", 1)[-1]]

    monkeypatch.setattr(foreground, "first_field", lambda job, capture, images: Field([photo.camera for photo in capture.photos]))
    monkeypatch.setattr(foreground, "_subject", lambda field: Subject(np.zeros((1, 3)), 0.1, FLOOR_ABOVE))
    monkeypatch.setattr(foreground, "coverage", coverage)
    return asked


FLOOR_ABOVE = ((FLOOR[0], 0.01),)


def test_the_foreground_is_trained_alone_on_silhouettes_as_on_masks_of_users(source: Path, tmp_path: Path) -> None:
    poses.run(captures.poses_job(source, tmp_path, mask_from="foreground"))
    made = scene.load(tmp_path / "poses")
    assert made.background == (1.0, 1.0, 1.0)
    assert not made.contracted
    for view in made.views:
        alpha = scene.read_image(tmp_path / "poses", view)[..., 3]
        truth = ball_pictures([view.source_camera])[view.source_camera.name] > 0
        assert ((alpha >= 128) & truth).sum() > 0.75 * ((alpha >= 128) | truth).sum()
    report = json.loads((tmp_path / "poses/report.json").read_text())
    assert report["facts"]["foreground"]["photographs"] == 8
    assert report["facts"]["foreground"]["overlap"] > 0.8
    assert report["masks"]["masks"]["use"] == "silhouette"


def test_a_photograph_whose_silhouette_does_not_fit_is_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = captures.cameras(12)
    seen(monkeypatch, ball_pictures(made))
    monkeypatch.setattr("stages.masking.foreground.hull_overlaps", lambda capture, pictures: np.array([0.95] * 5 + [0.6] + [0.95] * 6))
    events: list[dict[str, Any]] = []
    poses.run(captures.poses_job(captures.nerfstudio(tmp_path / "source", made), tmp_path, events.append, mask_from="foreground"))
    kept = {view.name for view in scene.load(tmp_path / "poses").views}
    assert len(kept) == 11
    (left,) = {f"images/{camera.name}" for camera in made} - kept
    assert any("have no silhouette" in event["text"] and left in event["text"] for event in events if event["event"] == "warning")


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda pictures: {name: np.ones_like(each) for name, each in pictures.items()}, "keep more than 80% of the picture"),
        (lambda pictures: {name: np.zeros_like(each) for name, each in pictures.items()}, "keep next to nothing"),
        (lambda pictures: {name: np.roll(each, each.shape[0] // 2, axis=0) for name, each in pictures.items()}, "the border of the picture cuts off"),
        (lambda pictures: ball_pictures(captures.cameras(8), 0.6), "no thing has all of these silhouettes"),
    ],
)
def test_silhouettes_of_no_compact_thing_are_refused(change: Any, why: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = captures.cameras(8)
    seen(monkeypatch, change(ball_pictures(made)))
    with pytest.raises(BadInput, match=rf"--mask foreground: .*{why}.* Photograph it from all sides.*masks/") as error:
        poses.run(captures.poses_job(captures.nerfstudio(tmp_path / "source", made), tmp_path, mask_from="foreground"))
    assert error.value.exit_code == 2
    assert not (tmp_path / "poses/scene.json").exists()
