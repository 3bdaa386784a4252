"""Points of stereo as training uses them."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from efficientnerf.training.pixels import Pixels
from efficientnerf.training.sparse_depth import STEREO_ENDS, aimed_rays
from pipeline.errors import Interrupted
from stages.io import scene as scenes
from stages.io.capture import SparsePoints
from stages.io.png import write_png
from stages.io.scene import Scene, View
from stages.train import run as train
from stages.train import stereo
from stages.train.data import pixels_of, sparse_depth_of, with_stereo
from tests.efficientnerf.balls import settings
from tests.efficientnerf.capture.textured import PARALLAX, cameras, off, photograph, sparse
from tests.stages.balls import ORBIT, SIMILARITY, job

BOUNDS = np.array([[-1.0, -1.0, -0.5], [1.0, 1.0, 0.5]])


def made(folder: Path, count: int = 5, masked: int | None = None) -> tuple[Scene, Pixels, tuple[View, ...]]:
    """A scene of textured photographs, the second a test view; of one the upper half may be masked."""
    (folder / "images").mkdir()
    (folder / "masks").mkdir()
    views = []
    for number, camera in enumerate(cameras(count)):
        grey, name = photograph(camera), f"{number}.png"
        write_png(np.repeat(grey[..., None], 3, axis=2), folder / "images" / name)
        mask = np.where(np.arange(len(grey)) < len(grey) // 2, np.uint8(0), np.uint8(255))[:, None] * np.ones(grey.shape, np.uint8)
        write_png(mask, folder / "masks" / name)
        camera = replace(camera, name=name)
        split = "test" if number == 1 else "train"
        views.append(View(f"images/{name}", f"masks/{name}" if number == masked else None, split, camera, camera, 1.0, 50.0))
    s = Scene("photographs", tuple(views), BOUNDS, None, SIMILARITY, ORBIT, points=True, metric=False)
    scenes.save(s, folder)
    xyz, seen = sparse([view.camera for view in views])
    tracks = tuple(tuple(np.flatnonzero(own).tolist()) for own in seen.T)
    scenes.save_points(SparsePoints(xyz, np.zeros((len(xyz), 3), np.uint8), np.zeros(len(xyz)), tracks), folder)
    views_trained = scenes.views_of(s, "train")
    return s, pixels_of(folder, views_trained), views_trained


def found(folder: Path, s: Scene, pixels: Pixels, views: tuple[View, ...], **changes: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    dense = stereo.stereo_points(folder, s, pixels, views, settings(**changes), lambda share: None)
    assert dense is not None
    return dense


def test_points_come_from_training_views_and_lie_on_the_surfaces(tmp_path: Path) -> None:
    s, pixels, views = made(tmp_path)
    xyz, own, other = found(tmp_path, s, pixels, views)
    assert np.median(off(xyz)) < PARALLAX / 2
    centres = {view.camera.centre.tobytes() for view in views}
    assert {centre.tobytes() for centre in np.unique(own, axis=0)} == centres
    assert {centre.tobytes() for centre in np.unique(other, axis=0)} <= centres
    assert (np.linalg.norm(own - other, axis=1) > 0.1).all()


def test_pixels_that_masks_leave_out_give_no_points(tmp_path: Path) -> None:
    s, pixels, views = made(tmp_path, masked=0)
    xyz, own, _ = found(tmp_path, s, pixels, views)
    camera = s.views[0].camera
    of_first = xyz[(own == camera.centre).all(axis=1)]
    down = (of_first - camera.centre) @ camera.world_from_camera[:3, 1]
    assert len(of_first)
    assert (down > -0.05).all()


def test_views_that_are_left_out_are_not_compared(tmp_path: Path) -> None:
    s, pixels, views = made(tmp_path)
    fewer = replace(s, views=tuple(replace(view, split="") if number == 3 else view for number, view in enumerate(s.views)))
    _, own, other = found(tmp_path, fewer, pixels, views)
    for centres in (own, other):
        assert not (centres == s.views[3].camera.centre).all(axis=1).any()


def test_the_number_of_points_and_photographs_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    s, pixels, views = made(tmp_path)
    every = len(found(tmp_path, s, pixels, views)[0])
    assert 0 < len(found(tmp_path, s, pixels, views, time_budget=0.5)[0]) < every / 3, "smaller pictures where time is short"
    monkeypatch.setattr(stereo, "MOST_POINTS", 200)
    assert len(found(tmp_path, s, pixels, views)[0]) == 200
    monkeypatch.setattr(stereo, "MOST_PHOTOGRAPHS", 3)
    assert len(np.unique(found(tmp_path, s, pixels, views)[1], axis=0)) == 3


def test_too_few_sparse_points_give_none_and_a_stop_is_heard(tmp_path: Path) -> None:
    s, pixels, views = made(tmp_path)

    def stop(share: float) -> None:
        raise Interrupted(2)

    with pytest.raises(Interrupted):
        stereo.stereo_points(tmp_path, s, pixels, views, settings(), stop)
    scenes.save_points(SparsePoints(np.zeros((3, 3)), np.zeros((3, 3), np.uint8), np.zeros(3), ((0, 2, 3),) * 3), tmp_path)
    assert stereo.stereo_points(tmp_path, s, pixels, views, settings(), stop) is None


def test_rays_to_points_of_stereo_come_first_and_end_early(tmp_path: Path) -> None:
    s, pixels, views = made(tmp_path)
    alone = sparse_depth_of(tmp_path, s)
    assert alone is not None
    xyz, own, other = found(tmp_path, s, pixels, views)
    both = with_stereo(alone, xyz, own, other)
    assert len(both) == len(alone) + 2 * len(xyz)
    ends = both.origins + both.distance[:, None] * both.directions
    np.testing.assert_allclose(ends[: 2 * len(xyz)], np.concatenate([xyz, xyz]), atol=1e-4)
    np.testing.assert_allclose(both.origins[: len(own)], own, atol=1e-6)
    line = np.cross(both.origins[len(own) : 2 * len(own)] - own, other - own)
    assert np.abs(line).max() < 1e-5, "the other half begins between two cameras"
    np.testing.assert_array_equal(both.distance[2 * len(xyz) :], alone.distance)
    rng = np.random.default_rng(0)
    early, late = (aimed_rays(both, 500, fraction, rng).distance for fraction in (0.0, STEREO_ENDS))
    assert not np.isin(early, alone.distance).all()
    assert np.isin(late, alone.distance).all()


@pytest.mark.parametrize("stereo_on", [False, True])
def test_training_compares_photographs_where_it_is_asked_to(tmp_path: Path, stereo_on: bool) -> None:
    (tmp_path / "poses").mkdir()
    made(tmp_path / "poses")
    events: list[dict[str, Any]] = []
    few = settings(iterations=3, sample_batch_size=1024, occupancy_warmup_steps=2, preview_every=5, stereo=stereo_on)
    train.run(job(tmp_path, few, poses=tmp_path / "poses", events=events))
    assert any("stereo finds" in str(event.get("text")) for event in events) == stereo_on


def test_stereo_without_sparse_points_is_reported_to_have_no_effect(tmp_path: Path) -> None:
    (tmp_path / "poses").mkdir()
    s, _, _ = made(tmp_path / "poses")
    scenes.save(replace(s, points=False), tmp_path / "poses")
    events: list[dict[str, Any]] = []
    few = settings(iterations=3, sample_batch_size=1024, occupancy_warmup_steps=2, preview_every=5, stereo=True)
    train.run(job(tmp_path, few, poses=tmp_path / "poses", events=events))
    assert any("train.stereo has no effect" in str(event.get("text")) for event in events)
