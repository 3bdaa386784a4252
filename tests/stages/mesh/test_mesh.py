"""The stage `mesh` on a real asset file that holds a ball."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image

from efficientnerf.asset import format
from efficientnerf.geometry.cameras import Camera, rays
from efficientnerf.geometry.orbit import Orbit
from efficientnerf.surface import isosurface
from efficientnerf.surface import volume as volumes
from efficientnerf.surface.mesh import Mesh
from pipeline.errors import UsageError
from pipeline.stage import Job
from stages.artifacts import MeshOutputs
from stages.evaluate.mesh import load_mesh
from stages.io.png import write_png
from stages.io.scene import Scene, View, load, save
from stages.mesh import run as stage
from stages.mesh.settings import MeshSettings
from stages.mesh.texture import textured
from tests.poses import looking_at
from tests.stages.mesh.balls import RADIUS, WORLD_FROM_CAPTURE, bake_ball, with_region


def photograph_ball(folder: Path, colours: tuple[tuple[float, ...], ...] = ((0.9, 0.5, 0.1), (0.1, 0.2, 0.8)), splits: tuple[str, ...] = ("train",)) -> Path:
    """A scene (the artifact of poses) with photographs of that ball from eight sides, in two colours, above and below, on white. `splits` in turn."""
    width, height = 64, 48
    views = []
    (folder / "images").mkdir(parents=True)
    for number in range(8):
        turn, height_of_camera = number * np.pi / 4, 1.0 if number % 2 else -1.0
        centre = np.array([2.5 * np.cos(turn), 2.5 * np.sin(turn), height_of_camera])
        pose = looking_at(centre)
        camera = Camera(f"{number}.png", width, height, "SIMPLE_PINHOLE", (70.0, width / 2, height / 2), pose)
        origins, directions = rays(camera)
        along = -(origins * directions).sum(1)
        apart = RADIUS**2 - (origins**2).sum(1) + along**2
        up = (origins + (along - np.sqrt(np.maximum(apart, 0)))[:, None] * directions)[:, 2] > 0
        shown = np.where((apart > 0)[:, None], np.where(up[:, None], colours[0], colours[1]), 1.0)
        write_png(np.round(shown * 255).astype(np.uint8).reshape(height, width, 3), folder / "images" / camera.name)
        source = replace(camera, world_from_camera=WORLD_FROM_CAPTURE.inverse().pose(pose))
        views.append(View(f"images/{camera.name}", None, splits[number % len(splits)], camera, source, 0.5, 5.0))
    orbit = Orbit((0.0, 0.0, 0.0), 3.0, 20.0, False, 0.0)
    save(Scene("photographs", tuple(views), np.array([[-1.0] * 3, [1.0] * 3]), (1.0, 1.0, 1.0), WORLD_FROM_CAPTURE, orbit, metric=True), folder)
    return folder


@pytest.fixture(scope="session")
def photographed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return photograph_ball(tmp_path_factory.mktemp("photographed") / "poses")


def inputs(bake: Path, poses: Path) -> dict[str, Path]:
    """Of the stage: training refined no cameras."""
    return {"bake": bake, "poses": poses, "train": poses}


@pytest.fixture(scope="session")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return bake_ball(tmp_path_factory.mktemp("ball") / "bake")


def test_the_mesh_lies_in_the_captures_frame(ball: Path, photographed: Path, tmp_path: Path) -> None:
    events: list[dict] = []
    settings = MeshSettings(max_faces=4000, density_threshold=150.0, texture_size=256)
    stage.run(Job(settings=settings, inputs=inputs(ball, photographed), out=tmp_path / "out", work=tmp_path / "work", report=events.append))
    files = ["check.png", "mesh.glb", "mesh.mtl", "mesh.obj", "mesh.ply", "mesh.png", "preview.png", "report.json"]
    assert sorted(each.name for each in (tmp_path / "out").iterdir()) == files
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

    standing = trimesh.load(tmp_path / "out" / "mesh.glb", force="mesh", process=False)
    corners = np.asarray(standing.vertices)[standing.faces]  # its vertices are split where the texture has seams
    np.testing.assert_allclose(corners, (mesh.vertices * [1, -1, -1])[mesh.faces], atol=1e-5)

    preview = np.asarray(Image.open(tmp_path / "out" / "preview.png"))
    assert preview.shape == (840, 1680, 3)
    np.testing.assert_allclose(preview[120, 210], [230, 128, 26], atol=6)
    np.testing.assert_allclose(preview[320, 210], [26, 51, 204], atol=6)


def test_the_same_asset_gives_the_same_bytes(ball: Path, photographed: Path, tmp_path: Path) -> None:
    for name in ("a", "b"):
        stage.run(Job(settings=MeshSettings(max_faces=1000), inputs=inputs(ball, photographed), out=tmp_path / name, work=tmp_path / "work"))
    for file in (tmp_path / "a").iterdir():
        assert file.read_bytes() == (tmp_path / "b" / file.name).read_bytes(), file.name


def test_a_threshold_out_of_reach_names_the_remedy(ball: Path, photographed: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"mesh\.density_threshold"):
        stage.run(Job(settings=MeshSettings(density_threshold=1e4), inputs=inputs(ball, photographed), out=tmp_path / "out", work=tmp_path / "work"))


def test_an_empty_asset_makes_an_empty_mesh_that_can_be_measured(photographed: Path, tmp_path: Path) -> None:
    bake = bake_ball(tmp_path / "bake", density=0.01)
    events: list[dict[str, Any]] = []
    stage.run(Job(settings=MeshSettings(), inputs=inputs(bake, photographed), out=tmp_path / "out", work=tmp_path / "work", report=events.append))
    (warning,) = [event["text"] for event in events if event["event"] == "warning"]
    assert "empty" in warning
    assert "train longer" in warning
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert (report["faces"], report["bounds"], report["watertight"]) == (0, None, False)
    outputs = MeshOutputs(tmp_path / "out")
    for path in (outputs.ply, outputs.glb, outputs.obj, outputs.preview, outputs.check):
        assert path.stat().st_size
    assert len(trimesh.load(outputs.glb, force="scene").geometry) == 0
    tree = format.load(bake / "asset.nerftree")
    measured = load_mesh(outputs, tree, "foreground")
    assert measured.facts == {"faces": 0, "vertices": 0, "texture_size": None}
    for image in measured.shader.images(load(photographed).views[0].camera):
        assert not image.covered.any()
        assert np.isinf(image.depth).all()


@pytest.mark.parametrize(("region", "lowest"), [("foreground", -0.2), ("all", -RADIUS)])
def test_the_foreground_is_meshed_unless_all_is_asked_for(ball: Path, photographed: Path, tmp_path: Path, region: str, lowest: float) -> None:
    bake = with_region(ball, tmp_path / "bake")
    settings = MeshSettings(max_faces=3000, region=region)  # type: ignore[arg-type]
    stage.run(Job(settings=settings, inputs=inputs(bake, photographed), out=tmp_path / "out", work=tmp_path / "work"))
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    corners = WORLD_FROM_CAPTURE.points(np.array(report["bounds"]))
    assert corners[:, 2].min() == pytest.approx(lowest, abs=0.06)
    assert corners[:, 2].max() == pytest.approx(RADIUS, abs=0.05)
    assert report["watertight"]


@pytest.mark.parametrize(("choice", "above"), [("auto", (0.2, 0.9, 0.3)), ("asset", (0.9, 0.5, 0.1))])
def test_the_texture_shows_what_was_asked_for(ball: Path, tmp_path: Path, choice: str, above: tuple[float, ...]) -> None:
    poses = photograph_ball(tmp_path / "poses", ((0.2, 0.9, 0.3), (0.9, 0.1, 0.4)))
    tree = format.load(ball / "asset.nerftree")
    surface, _ = stage.mesh_of(tree, MeshSettings(max_faces=2000), lambda *each: None)
    found = textured(surface, tree, (poses, poses), choice, 256, lambda *each: None)
    side = len(found.texture.colours)
    u, v = found.texture.coordinates.mean(1).T
    shown = found.texture.colours[((1 - v) * side).astype(int), (u * side).astype(int)] / 255
    top = found.vertices[found.faces].mean(1)[:, 2] > 0.25
    np.testing.assert_allclose(np.median(shown[top], axis=0), above, atol=0.03)
    assert np.abs(shown[top] - above).max(1).mean() < 0.05


def test_more_charts_than_the_largest_texture_holds_name_the_settings(ball: Path, tmp_path: Path) -> None:
    tree = format.load(ball / "asset.nerftree")
    corners = np.array([[0.0, 0, 0], [0.02, 0, 0], [0, 0.02, 0]])
    vertices = (corners + np.random.default_rng(0).uniform(-0.5, 0.5, (60, 1, 3))).reshape(-1, 3)
    upwards = np.tile([[0.0, 0, 1]], (len(vertices), 1))
    mesh = Mesh(vertices, np.arange(len(vertices)).reshape(-1, 3), upwards, np.full(vertices.shape, 0.5, np.float32), {})
    with pytest.raises(UsageError, match=r"mesh\.texture_size"):
        textured(mesh, tree, (tmp_path, tmp_path), "asset", 32, lambda done, total, text: None)


def test_held_back_photographs_are_not_looked_at(ball: Path, tmp_path: Path) -> None:
    """Where all photographs but the training ones are gone, nothing changes."""
    poses = photograph_ball(tmp_path / "poses", splits=("train", "test", "train", "val"))
    settings = MeshSettings(max_faces=1000, texture_size=256)
    stage.run(Job(settings=settings, inputs=inputs(ball, poses), out=tmp_path / "a", work=tmp_path / "work"))
    for number in (1, 3, 5, 7):
        (poses / "images" / f"{number}.png").unlink()
    stage.run(Job(settings=settings, inputs=inputs(ball, poses), out=tmp_path / "b", work=tmp_path / "work"))
    assert (tmp_path / "a" / "report.json").read_bytes() == (tmp_path / "b" / "report.json").read_bytes()
    assert json.loads((tmp_path / "a" / "report.json").read_text())["texture_observed"] > 0.5


def test_the_preview_shows_all_of_a_subject_that_is_clipped() -> None:
    """What is not clipped may reach far behind the subject: there the outmost fifth is left out."""
    y, z = (part.ravel() for part in np.meshgrid(np.linspace(-1, 1, 21), np.linspace(-1, 1, 21), indexing="ij"))
    corner = 21 * np.arange(20)[:, None] + np.arange(20)
    faces = np.concatenate([np.stack([corner, corner + 21, corner + 22], -1), np.stack([corner, corner + 22, corner + 1], -1)]).reshape(-1, 3)
    outer = np.abs(y * z) > 0.6
    square = Mesh(np.stack([0 * y, y, z], 1), faces, np.tile([1.0, 0, 0], (441, 1)), np.where(outer[:, None], [1.0, 0, 0], [0, 1.0, 0]), {})
    orbit = {"orbit": {"heading": 0.0, "elevation": 20.0, "forward_facing": True}}
    whole, middle = (stage.preview_of(square, orbit, clipped=clipped) for clipped in (True, False))
    assert whole.shape == middle.shape == (840, 1680, 3)
    assert (whole == (255, 0, 0)).all(-1).sum() > 1000
    assert not (middle == (255, 0, 0)).all(-1).any()


def test_enclosed_space_is_found_with_any_number_of_bricks_at_once(ball: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    volume = volumes.volume_of(format.load(ball / "asset.nerftree"))
    whole = isosurface.enclosed_cells(volume, 1e-3, np.zeros((0, 3)))
    monkeypatch.setattr(volumes, "VOXELS_AT_ONCE", 1)
    assert np.array_equal(isosurface.enclosed_cells(volume, 1e-3, np.zeros((0, 3))), whole)
