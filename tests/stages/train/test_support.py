"""The table that photographs show is where rays end in training, if sparse points show none."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from efficientnerf.capture.plane_sweep import SweptPlane
from efficientnerf.training.pixels import Pixels
from pipeline.errors import CorruptArtifact
from stages.io import scene as scenes
from stages.io.capture import SparsePoints
from stages.io.png import write_png
from stages.io.scene import Scene, View
from stages.train import run as train
from stages.train import support
from stages.train.data import pixels_of, sparse_depth_of
from stages.train.support import find_planes
from tests.efficientnerf.balls import settings
from tests.efficientnerf.capture.plain_table import LEVEL, NORMAL, cameras, height, photograph, subject
from tests.stages.balls import ORBIT, SIMILARITY, job

BOUNDS = np.array([[-0.8, -0.8, -0.5], [0.8, 0.8, 0.5]])
BELOW = np.array([[0.5, 0.5, -1.0]])  # a point that would be seen through the table


def made(folder: Path, points: np.ndarray | None = None) -> tuple[Scene, Pixels, tuple[View, ...]]:
    """A scene of photographs of a plain table, the second a test view, whose sparse points are on the subject alone."""
    (folder / "images").mkdir(parents=True)
    views = []
    for number, camera in enumerate(cameras()):
        write_png(np.repeat(photograph(camera)[..., None], 3, axis=2), folder / "images" / f"{number}.png")
        camera = replace(camera, name=f"{number}.png")
        views.append(View(f"images/{number}.png", None, "test" if number == 1 else "train", camera, camera, 1.0, 50.0))
    s = Scene("photographs", tuple(views), BOUNDS, None, SIMILARITY, ORBIT, points=True, metric=False)
    scenes.save(s, folder)
    xyz = subject() if points is None else points
    tracks = (tuple(range(len(views))),) * len(xyz)
    scenes.save_points(SparsePoints(xyz, np.zeros((len(xyz), 3), np.uint8), np.zeros(len(xyz)), tracks), folder)
    trained = scenes.views_of(s, "train")
    return s, pixels_of(folder, trained), trained


def test_rays_end_on_the_table(tmp_path: Path) -> None:
    s, pixels, views = made(tmp_path)
    alone = sparse_depth_of(tmp_path, s)
    assert alone is not None
    assert not alone.on_support.any()
    asked: list[np.ndarray] = []

    def found(points: np.ndarray) -> list[SweptPlane]:
        asked.append(points)
        return find_planes(s, pixels, views, points, 0, lambda share: None)

    with_table = sparse_depth_of(tmp_path, s, sweep=found)
    assert with_table is not None
    assert len(asked) == 1
    np.testing.assert_allclose(np.sort(asked[0], axis=0), np.sort(subject(), axis=0), atol=1e-6)
    ends = with_table.origins + with_table.distance[:, None] * with_table.directions
    added = ends[len(alone) :]
    assert np.abs(height(added)).max() < 0.02
    assert with_table.on_support.any()
    patches = ~with_table.on_support[len(alone) :]
    assert patches.sum() > 200, "two to each patch"
    centres = np.array([view.camera.centre for view in views])
    apart = np.linalg.norm(with_table.origins[len(alone) :, None] - centres, axis=-1).min(axis=1)
    assert apart.max() < 1e-5, "no test view is used"


def test_a_table_that_points_are_seen_through_is_none(tmp_path: Path) -> None:
    plane = SweptPlane(NORMAL / np.linalg.norm(NORMAL), LEVEL / float(np.linalg.norm(NORMAL)), *patches_on_the_table())
    s, _, _ = made(tmp_path / "solid")
    solid = sparse_depth_of(tmp_path / "solid", s, sweep=lambda points: [plane])
    assert solid is not None
    assert solid.on_support.any()
    seen_through = np.concatenate([subject()[:20], np.repeat(BELOW, 20, axis=0)])
    s, _, _ = made(tmp_path / "open", seen_through)
    alone, still = sparse_depth_of(tmp_path / "open", s), sparse_depth_of(tmp_path / "open", s, sweep=lambda points: [plane])
    assert alone is not None
    assert still is not None
    np.testing.assert_array_equal(still.distance, alone.distance)


def patches_on_the_table() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    at = rng.uniform(-1, 1, (200, 2))
    centres = np.array([camera.centre for camera in cameras()])
    return np.column_stack([at, LEVEL - (at @ NORMAL[:2]) / NORMAL[2]]), centres[rng.integers(len(centres), size=(200, 2))]


def test_points_on_one_half_of_a_table_and_photographs_of_the_other_show_all_of_it(tmp_path: Path) -> None:
    """As where half of it is printed with dots."""
    at = np.random.default_rng(0).uniform((0.3, -0.7), (0.7, 0.7), (100, 2))
    s, pixels, views = made(tmp_path, np.concatenate([subject(), np.column_stack([at, LEVEL - (at @ NORMAL[:2]) / NORMAL[2]])]))
    found = [sparse_depth_of(tmp_path, s), sparse_depth_of(tmp_path, s, sweep=lambda points: find_planes(s, pixels, views, points, 0, lambda share: None))]
    reached = []
    for rays in found:
        assert rays is not None
        ends = (rays.origins + rays.distance[:, None] * rays.directions)[rays.on_support]
        assert len(ends)
        assert np.abs(height(ends)).max() < 0.02
        reached.append(ends[:, 0].min())
    assert reached[0] > -0.3, "the feet of the subject lie on it too"
    assert reached[1] < -0.7


def test_views_that_are_left_out_and_those_beyond_the_most_are_not_compared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    s, pixels, views = made(tmp_path)
    fewer = replace(s, views=tuple(replace(view, split="") if number == 3 else view for number, view in enumerate(s.views)))
    (plane,) = find_planes(fewer, pixels, views, subject(), 0, lambda share: None)
    assert not (plane.cameras == s.views[3].camera.centre).all(axis=-1).any()
    monkeypatch.setattr(support, "MOST_PHOTOGRAPHS", 2)
    assert not find_planes(s, pixels, views, subject(), 0, lambda share: None), "two are too few"


@pytest.mark.parametrize("weight", [0.1, 0.0])
def test_training_reports_the_plane_and_asks_for_it_where_it_counts(tmp_path: Path, weight: float) -> None:
    made(tmp_path / "poses")
    events: list[dict[str, Any]] = []
    few = settings(iterations=3, sample_batch_size=1024, occupancy_warmup_steps=2, preview_every=5, sparse_depth_loss_weight=weight)
    train.run(job(tmp_path, few, poses=tmp_path / "poses", events=events))
    assert any("a plane supports the subject" in str(event.get("text")) for event in events) == (weight > 0)
    planes, length = support.load(tmp_path / "out"), np.linalg.norm(NORMAL)
    assert len(planes) == (weight > 0), "later stages know it too"
    for normal, offset in planes:
        np.testing.assert_allclose(normal, NORMAL / length, atol=0.02)
        assert offset == pytest.approx(LEVEL / length, abs=0.02)


@pytest.mark.parametrize("planes", ["{", "[0]", '[{"normal": [0, 0], "offset": 0}]', '[{"normal": [0, 0, 0.9], "offset": 0}]', '[{"normal": [0, 0, 1]}]'])
def test_a_damaged_plane_is_refused(tmp_path: Path, planes: str) -> None:
    (tmp_path / "support.json").write_text(f'{{"format": 1, "planes": {planes}}}')
    with pytest.raises(CorruptArtifact):
        support.load(tmp_path)


def test_planes_are_read_as_they_were_written(tmp_path: Path) -> None:
    planes = [(normal / np.linalg.norm(normal), 0.1) for normal in (NORMAL, np.array([1.0, -0.2, 0.1]))]
    support.write(planes, tmp_path / "support.json")
    for (normal, offset), (other, level) in zip(planes, support.load(tmp_path), strict=True):
        np.testing.assert_array_equal(normal, other)
        assert offset == level
    support.write((), tmp_path / "support.json")
    assert support.load(tmp_path) == ()
    support.write((), tmp_path / "support.json")
