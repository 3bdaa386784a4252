"""The stage `points` on the mesh of a ball, and on none."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from efficientnerf.asset.format import describe
from efficientnerf.surface.mesh import Mesh, moved
from pipeline.errors import StageFailed
from pipeline.stage import Job
from stages.artifacts import BakeOutputs, MeshOutputs, PointsOutputs
from stages.formats.exporters import MESH_EXPORTERS
from stages.formats.exporters.writing import CAPTURE_IS_Z_UP, source_frame
from stages.mesh.files import write_empty_meshes
from stages.points import run as points
from stages.points.settings import PointsSettings
from tests.stages.mesh.balls import RADIUS, WORLD_FROM_CAPTURE, bake_ball

ROW = [("position", "<f4", 3), ("normal", "<f4", 3), ("colour", "u1", 3)]


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A baked ball and its mesh, orange above and blue below."""
    folder = tmp_path_factory.mktemp("ball")
    bake = bake_ball(folder / "bake")
    ball = trimesh.creation.icosphere(4, RADIUS)
    vertices = np.asarray(ball.vertices)
    colours = np.where(vertices[:, 2:] > 0, [0.9, 0.5, 0.1], [0.1, 0.2, 0.8]).astype(np.float32)
    frame = source_frame(describe(bake / BakeOutputs.asset))
    back, outputs = WORLD_FROM_CAPTURE.inverse(), MeshOutputs(folder / "mesh")
    mesh = moved(Mesh(vertices, np.asarray(ball.faces), vertices / RADIUS, colours), back.scale, back.rotation, back.translation)
    outputs.folder.mkdir()
    for path in (outputs.ply, outputs.glb):
        MESH_EXPORTERS[path.suffix](mesh, path, frame)
    return {"bake": bake, "mesh": outputs.folder}


def pointed(inputs: dict[str, Path], folder: Path, settings: PointsSettings) -> bytes:
    points.run(Job(settings=settings, inputs=inputs, out=folder / "out", work=folder / "work"))
    return PointsOutputs(folder / "out").ply.read_bytes()


def test_points_lie_on_the_ball_in_the_captures_frame(inputs: dict[str, Path], tmp_path: Path) -> None:
    header, body = pointed(inputs, tmp_path, PointsSettings(num_points=5000)).split(b"end_header\n", 1)
    assert b"element vertex 5000\n" in header
    assert b"element face" not in header
    rows = np.frombuffer(body, ROW)
    outward = rows["position"] - WORLD_FROM_CAPTURE.inverse().points(np.zeros(3))
    np.testing.assert_allclose(np.linalg.norm(outward, axis=1), RADIUS * 4, rtol=0.01)
    np.testing.assert_allclose(np.linalg.norm(rows["normal"], axis=1), 1, atol=1e-6)
    assert ((rows["normal"] * outward).sum(1) / np.linalg.norm(outward, axis=1)).min() > 0.999
    assert np.abs(np.median(rows["colour"][outward[:, 1] < -0.5], 0) - [230, 128, 26]).max() <= 3
    assert np.abs(outward.mean(0)).max() < 0.05


def test_the_same_seed_gives_the_same_points(inputs: dict[str, Path], tmp_path: Path) -> None:
    a, b, c = (pointed(inputs, tmp_path / name, PointsSettings(num_points=500, seed=seed)) for name, seed in (("a", 1), ("b", 1), ("c", 2)))
    assert a == b
    assert a != c


def test_of_an_empty_mesh_there_are_none(inputs: dict[str, Path], tmp_path: Path) -> None:
    write_empty_meshes(MeshOutputs(tmp_path), CAPTURE_IS_Z_UP)
    with pytest.raises(StageFailed, match=r"the mesh has no faces.*train longer"):
        pointed({**inputs, "mesh": tmp_path}, tmp_path / "points", PointsSettings())
    assert not PointsOutputs(tmp_path / "points/out").ply.exists()
