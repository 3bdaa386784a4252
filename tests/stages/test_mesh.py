"""The stage `mesh` on a real asset file that holds a ball."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from efficientnerf.asset import format
from efficientnerf.asset.region import Region
from efficientnerf.asset.tree import tree_from_voxels
from efficientnerf.geometry.cameras import Similarity
from pipeline.errors import Interrupted, StageFailed, UsageError
from pipeline.stage import Job
from stages import mesh as stage
from stages.mesh import MeshSettings

# The capture lies on its side (y down), is four times as large as the training frame and somewhere else.
WORLD_FROM_CAPTURE = Similarity(0.25, np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), np.array([0.1, 0.2, 0.3]))
RADIUS = 0.55


def bake_ball(folder: Path, density: float = 300.0) -> Path:
    """A folder with asset.nerftree: a ball around the origin of the training frame, orange above and blue below."""
    cells, brick = 10, 4
    voxel = 2 / (cells * brick)
    index = np.stack(np.meshgrid(*[np.arange(cells * brick)] * 3, indexing="ij"), -1).reshape(-1, 3)
    centre = (index + 0.5) * voxel - 1
    distance = np.linalg.norm(centre, axis=1) - RADIUS
    kept = distance < voxel
    colour = np.where(centre[kept, 2:] > 0, [0.9, 0.5, 0.1], [0.1, 0.2, 0.8])
    sh = (np.log(colour / (1 - colour)) / 0.28209479177387814)[:, None]
    level = density * np.clip(0.5 - distance[kept] / voxel, 0, 1)
    similarity = WORLD_FROM_CAPTURE
    metadata = {
        "world_from_capture": {"scale": similarity.scale, "rotation": similarity.rotation.tolist(), "translation": similarity.translation.tolist()},
        "orbit": {"centre": [0.0, 0.0, 0.0], "radius": 3.0, "elevation": 25.0, "forward_facing": False, "heading": 40.0},
        "metric": True,
        "provenance": {},
    }
    tree = tree_from_voxels((cells,) * 3, voxel, np.full(3, -1.0), index[kept], level, sh.astype(np.float32), metadata=metadata)
    folder.mkdir(parents=True)
    format.save(tree, folder / "asset.nerftree")
    return folder


@pytest.fixture(scope="session")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return bake_ball(tmp_path_factory.mktemp("ball") / "bake")


def test_the_mesh_lies_in_the_captures_frame(ball: Path, tmp_path: Path) -> None:
    import trimesh
    from PIL import Image

    events: list[dict] = []
    settings = MeshSettings(max_faces=4000, density_threshold=150.0)
    stage.run(Job(settings=settings, inputs={"bake": ball}, out=tmp_path / "out", work=tmp_path / "work", report=events.append))
    assert sorted(each.name for each in (tmp_path / "out").iterdir()) == ["check.png", "mesh.glb", "mesh.obj", "mesh.ply", "preview.png", "report.json"]
    mesh = trimesh.load(tmp_path / "out" / "mesh.ply", process=False)
    centre = WORLD_FROM_CAPTURE.inverse().points(np.zeros(3))
    np.testing.assert_allclose(mesh.bounds.mean(0), centre, atol=0.05)
    outward = mesh.vertices - centre
    np.testing.assert_allclose(np.linalg.norm(outward, axis=1), RADIUS * 4, atol=0.2)
    assert (mesh.vertex_normals * outward / np.linalg.norm(outward, axis=1, keepdims=True)).sum(1).min() > 0.8
    # Up in the capture is -y: that is where it is orange.
    top = mesh.visual.vertex_colors[outward[:, 1] < -0.5][:, :3].mean(0)
    np.testing.assert_allclose(top, [0.9 * 255, 0.5 * 255, 0.1 * 255], atol=3)

    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["watertight"] is True
    assert report["components"] == 1
    assert report["faces"] == len(mesh.faces) <= 4000
    assert report["unit"] == "metre"
    np.testing.assert_allclose(report["bounds"], mesh.bounds, atol=1e-5)
    assert report["volume"] == pytest.approx(4 / 3 * np.pi * (RADIUS * 4) ** 3, rel=0.03)
    assert [event["faces"] for event in events if "faces" in event] == [report["faces"]]
    assert events[-1]["text"] == f"{report['faces']} faces in 1 component"

    standing = trimesh.load(tmp_path / "out" / "mesh.glb", force="mesh", process=False)
    np.testing.assert_allclose(standing.vertices, mesh.vertices * [1, -1, -1], atol=1e-5)

    preview = np.asarray(Image.open(tmp_path / "out" / "preview.png"))
    assert preview.shape == (840, 1680, 3)
    np.testing.assert_allclose(preview[120, 210], [230, 128, 26], atol=6)
    np.testing.assert_allclose(preview[320, 210], [26, 51, 204], atol=6)


def test_the_same_asset_gives_the_same_bytes(ball: Path, tmp_path: Path) -> None:
    for name in ("a", "b"):
        stage.run(Job(settings=MeshSettings(max_faces=1000), inputs={"bake": ball}, out=tmp_path / name, work=tmp_path / "work"))
    for file in (tmp_path / "a").iterdir():
        assert file.read_bytes() == (tmp_path / "b" / file.name).read_bytes(), file.name


def test_a_threshold_out_of_reach_names_the_remedy(ball: Path, tmp_path: Path) -> None:
    with pytest.raises(StageFailed, match=r"nowhere reaches 1e\+04.*Lower mesh.density_threshold"):
        stage.run(Job(settings=MeshSettings(density_threshold=1e4), inputs={"bake": ball}, out=tmp_path / "out", work=tmp_path / "work"))


def test_an_empty_asset_names_the_remedy(tmp_path: Path) -> None:
    bake = bake_ball(tmp_path / "bake", density=0.01)
    with pytest.raises(StageFailed, match="train longer"):
        stage.run(Job(settings=MeshSettings(), inputs={"bake": bake}, out=tmp_path / "out", work=tmp_path / "work"))


def test_a_signal_stops_it(ball: Path, tmp_path: Path) -> None:
    with pytest.raises(Interrupted):
        stage.run(Job(settings=MeshSettings(), inputs={"bake": ball}, out=tmp_path / "out", work=tmp_path / "work", stop=lambda: 2))


def test_progress_never_goes_back(ball: Path) -> None:
    tree = format.load(ball / "asset.nerftree")
    told: list[tuple[int, int, str]] = []
    stage.mesh_of(tree, MeshSettings(max_faces=500), lambda *each: told.append(each))
    assert [each[:2] for each in told] == sorted(each[:2] for each in told)
    assert {each[2] for each in told} == {"views of the asset", *stage.PARTS}
    assert told[-1][0] == told[-1][1]


def with_region(ball: Path, folder: Path) -> Path:
    """The same asset whose foreground is its upper half and a little more."""
    folder.mkdir(parents=True)
    region = Region(np.array([[-0.9, -0.9, -0.2], [0.9, 0.9, 0.9]]), 0.9, 0.05)
    format.save(replace(format.load(ball / "asset.nerftree"), region=region), folder / "asset.nerftree")
    return folder


@pytest.mark.parametrize(("region", "lowest"), [("foreground", -0.2), ("all", -RADIUS)])
def test_the_foreground_is_meshed_unless_all_is_asked_for(ball: Path, tmp_path: Path, region: str, lowest: float) -> None:
    bake = with_region(ball, tmp_path / "bake")
    settings = MeshSettings(max_faces=3000, region=region)  # type: ignore[arg-type]
    stage.run(Job(settings=settings, inputs={"bake": bake}, out=tmp_path / "out", work=tmp_path / "work"))
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    corners = WORLD_FROM_CAPTURE.points(np.array(report["bounds"]))
    assert corners[:, 2].min() == pytest.approx(lowest, abs=0.06)
    assert corners[:, 2].max() == pytest.approx(RADIUS, abs=0.05)
    assert report["watertight"]


def test_a_region_without_anything_is_said(ball: Path, tmp_path: Path) -> None:
    (tmp_path / "bake").mkdir()
    far = Region(np.array([[0.9, 0.9, 0.9], [0.95, 0.95, 0.95]]))
    format.save(replace(format.load(ball / "asset.nerftree"), region=far), tmp_path / "bake" / "asset.nerftree")
    with pytest.raises(UsageError, match="nothing of the asset lies in its foreground region"):
        stage.run(Job(settings=MeshSettings(), inputs={"bake": tmp_path / "bake"}, out=tmp_path / "out", work=tmp_path / "work"))
