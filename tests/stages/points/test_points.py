"""The stage `points` on a real asset file that holds a ball."""

from pathlib import Path

import numpy as np
import pytest

from pipeline.stage import Job
from stages.points import run as points
from stages.points.settings import PointsSettings
from tests.stages.mesh.balls import RADIUS, WORLD_FROM_CAPTURE, bake_ball, with_region


@pytest.fixture(scope="module")
def bake(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return bake_ball(tmp_path_factory.mktemp("ball") / "bake")


def test_points_lie_on_the_ball_in_the_captures_frame(bake: Path, tmp_path: Path) -> None:
    points.run(Job(settings=PointsSettings(num_points=5000), inputs={"bake": bake}, out=tmp_path / "out", work=tmp_path / "work"))
    header, body = (tmp_path / "out" / "points.ply").read_bytes().split(b"end_header\n", 1)
    assert b"element vertex 5000\n" in header
    assert b"element face" not in header
    rows = np.frombuffer(body, [("position", "<f4", 3), ("normal", "<f4", 3), ("colour", "u1", 3)])
    outward = rows["position"] - WORLD_FROM_CAPTURE.inverse().points(np.zeros(3))
    np.testing.assert_allclose(np.linalg.norm(outward, axis=1), RADIUS * 4, atol=0.2)
    assert ((rows["normal"] * outward).sum(1) / np.linalg.norm(outward, axis=1)).min() > 0.7
    assert np.abs(np.median(rows["colour"][outward[:, 1] < -0.5], 0) - [230, 128, 26]).max() <= 3
    assert np.abs(outward.mean(0)).max() < 0.05


def test_the_same_seed_gives_the_same_points(bake: Path, tmp_path: Path) -> None:
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        points.run(Job(settings=PointsSettings(num_points=500, seed=seed), inputs={"bake": bake}, out=tmp_path / name, work=tmp_path / "work"))
    a, b, c = ((tmp_path / name / "points.ply").read_bytes() for name in "abc")
    assert a == b
    assert a != c


def test_points_lie_on_the_foreground_unless_all_is_asked_for(bake: Path, tmp_path: Path) -> None:
    half = with_region(bake, tmp_path / "bake")
    for region, lowest in (("foreground", -0.2), ("all", -RADIUS)):
        settings = PointsSettings(num_points=2000, region=region)  # type: ignore[arg-type]
        points.run(Job(settings=settings, inputs={"bake": half}, out=tmp_path / region, work=tmp_path / "work"))
        body = (tmp_path / region / "points.ply").read_bytes().split(b"end_header\n", 1)[1]
        rows = np.frombuffer(body, [("position", "<f4", 3), ("normal", "<f4", 3), ("colour", "u1", 3)])
        assert WORLD_FROM_CAPTURE.points(rows["position"])[:, 2].min() == pytest.approx(lowest, abs=0.06)
