"""export, render and inspect with a bare asset file: a ball."""

import json
import typing
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from efficientnerf.asset import format
from efficientnerf.asset.camera_paths import pose_on_sphere
from efficientnerf.asset.captured import captured_metadata
from efficientnerf.asset.cascades import cascade_grids, nested
from efficientnerf.asset.tree import NerfTree, Region, tree_from_voxels
from efficientnerf.geometry.cameras import Camera
from pipeline.errors import UsageError
from stages.formats.exporters import MESH_EXPORTERS, POINT_EXPORTERS, SPLAT_EXPORTERS, VOLUME_EXPORTERS
from stages.formats.exporters.splats.ply import read_splats
from stages.mesh.settings import MeshSettings
from stages.turntable.settings import TurntableSettings
from tests.stages.formats.gaussians import scattered
from tests.stages.io.meshes import Z_UP, block
from tests.workflows.command import Enerf
from workflows.cli.files import EXR, TEXTURES
from workflows.cli.main import COMMANDS
from workflows.exporting import faces_from_text

SCALE = 0.5


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A red ball of radius 0.6 about the origin of the training frame, which is the capture's times 0.5."""
    cells, brick, voxel = 6, 4, 2 / 24
    centres = (np.stack(np.meshgrid(*[np.arange(24)] * 3, indexing="ij"), -1) + 0.5) * voxel - 1  # (24, 24, 24, 3)
    density = np.where(np.linalg.norm(centres, axis=-1) < 0.6, 200.0, 0.0)
    blocks = density.reshape(cells, brick, cells, brick, cells, brick).transpose(0, 2, 4, 1, 3, 5).reshape(-1, brick**3)
    sh = np.zeros((cells**3 * brick**3, 1, 3), np.float32)
    sh[:, 0] = (8.0, -8.0, -8.0)
    tree = NerfTree(
        shape=(cells,) * 3,
        brick=brick,
        voxel=voxel,
        bounds_min=np.full(3, -1.0),
        brick_index=np.arange(cells**3, dtype=np.int32).reshape((cells,) * 3),
        voxel_index=np.arange(cells**3 * brick**3, dtype=np.int32).reshape(cells**3, brick**3),
        density_values=blocks.reshape(-1).astype(np.float32),
        harmonics=sh,
        metadata={"world_from_capture": {"scale": SCALE, "rotation": np.eye(3).tolist(), "translation": [0.0, 0.0, 0.0]}},
    )
    path = tmp_path_factory.mktemp("asset") / "ball.nerftree"
    format.save(tree, path)
    return path


def test_a_texture_of_the_asset_in_all_formats(enerf: Enerf, ball: Path, tmp_path: Path) -> None:
    """The ball is red. Nothing is written twice: OBJ and USDC share their picture."""
    names = ["ball.glb", "ball.obj", "ball.stl", *(["ball.usdz", "ball.usdc"] if find_spec("pxr") else [])]
    result = enerf("export", ball, "--to", *(tmp_path / name for name in names), "--faces", "0.5k", "--texture-size", 256, "--json")
    assert result.code == 0, result.err
    written = {Path(entry["path"]).name: entry for entry in result.objects[-1]["written"]}
    assert sorted(written) == sorted(names)
    assert sorted([*names, "ball.mtl", "ball.png"]) == sorted(path.name for path in tmp_path.iterdir())
    assert [Path(each).name for each in written["ball.obj"]["beside"]] == ["ball.png", "ball.mtl"]
    assert "texels a side" not in written["ball.stl"]
    assert 100 < written["ball.glb"]["faces"] <= 500
    assert written["ball.glb"]["texels a side"] <= 256
    picture = np.asarray(Image.open(tmp_path / "ball.png"))
    dark, bright = 255 / (1 + np.exp(8 * 0.2820948)), 255 / (1 + np.exp(-8 * 0.2820948))
    np.testing.assert_allclose(np.median(picture[picture.any(-1)], axis=0), [bright, dark, dark], atol=3)
    without = tmp_path / "without"
    without.mkdir()
    assert enerf("export", ball, "--to", without / "a.obj", without / "a.ply", "--texture", "off", "--faces", 500).code == 0
    assert enerf("export", ball, "--points", "--to", without / "p.ply", without / "p.xyz", "--set", "points.num_points=300").code == 0
    assert sorted(path.name for path in without.iterdir()) == ["a.obj", "a.ply", "p.ply", "p.xyz"]
    assert enerf("inspect", without / "p.ply", "--json").object["vertices"] == 300
    for path in (*(tmp_path / name for name in names[:3]), without / "a.ply"):  # in the frame of the capture
        np.testing.assert_allclose(enerf("inspect", path, "--json").object["bounds"], np.array([[-1.0] * 3, [1.0] * 3]) * 0.6 / SCALE, atol=0.1)


def test_an_obj_replaces_none_of_its_three_files_without_force(enerf: Enerf, ball: Path, tmp_path: Path) -> None:
    for name in ("ball.obj", "ball.mtl", "ball.png"):
        (tmp_path / name).write_text("mine", encoding="utf-8")
        result = enerf("export", ball, "--to", tmp_path / "ball.obj")
        assert (result.code, str(tmp_path / name) in result.err) == (2, True)
        assert [each.name for each in tmp_path.iterdir()] == [name]
        (tmp_path / name).unlink()
    for name in ("ball.obj", "ball.mtl", "ball.jpg"):
        (tmp_path / name).write_text("mine", encoding="utf-8")
    result = enerf("export", ball, "--to", tmp_path / "ball.obj", "--force", "--jpeg", "--faces", 500, "--texture-size", 256)
    assert result.code == 0, result.err
    assert sorted(each.name for each in tmp_path.iterdir()) == ["ball.jpg", "ball.mtl", "ball.obj"]
    assert (tmp_path / "ball.jpg").read_bytes()[:2] == b"\xff\xd8"
    assert "map_Kd ball.jpg" in (tmp_path / "ball.mtl").read_text("ascii")


def test_the_list_names_every_format(enerf: Enerf) -> None:
    rows = enerf("export", "--list", "--json").objects[-1]["formats"]
    others = {".json", ".html", ".png", ".exr", ".mp4", ".nerftree"}
    assert {row["extension"] for row in rows} == {*MESH_EXPORTERS, *POINT_EXPORTERS, *SPLAT_EXPORTERS, *VOLUME_EXPORTERS, *others}
    assert all(row["keeps"] and row["loses"] and row["opened_by"] for row in rows)
    assert all(row["command"].split()[1] in COMMANDS for row in rows)
    listed = enerf("export", "--list").out
    assert all(row["command"] in listed for row in rows)
    assert all(listed.count(f"pip install 'efficientnerf[{extra}]'") == 2 for extra in ("usd", "las"))


def test_what_can_be_asked_for_is_what_there_is() -> None:
    assert typing.get_args(typing.get_type_hints(MeshSettings)["texture"]) == TEXTURES
    assert typing.get_args(typing.get_type_hints(TurntableSettings)["exr"]) == EXR


@pytest.mark.parametrize(("text", "expected"), [("20k", 20_000), ("0.5K", 500), ("1m", 1_000_000), ("150000", 150_000)])
def test_faces_may_be_given_in_thousands(text: str, expected: int) -> None:
    assert faces_from_text(text) == expected
    for other in ("", "k", "-5", "1e6", "nan", "0", "5kk", "٣k", "1_000"):
        with pytest.raises(UsageError, match="--faces"):
            faces_from_text(other)


def test_a_volume_of_what_is_asked_for(enerf: Enerf, scene: Path, tmp_path: Path) -> None:
    """The foreground is the red ball, with fewer voxels than all; a grid of its own for what lies around it."""
    for name, more in (("subject", []), ("all", ["--region", "all"])):
        result = enerf("export", scene, "--to", tmp_path / f"{name}.vdb", *more, "--json")
        assert result.code == 0, result.err
        assert result.objects[-1]["written"][0]["voxels"] > 1000
    subject, everything = ((tmp_path / f"{name}.vdb").read_bytes() for name in ("subject", "all"))
    assert b"density_1" in everything
    assert b"density_1" not in subject
    again = enerf("export", scene, "--to", tmp_path / "all.vdb")
    assert (again.code, (tmp_path / "all.vdb").read_bytes()) == (2, everything)
    assert enerf("export", scene, "--to", tmp_path / "few.vdb", "--memory", "100m").code == 2


def test_splats_of_what_is_asked_for(enerf: Enerf, scene: Path, tmp_path: Path) -> None:
    """All with its surroundings, unless a region says otherwise; in the capture's frame, where the red ball has a radius of 1.2."""
    few = ["--set", "splats.count=400", "--set", "splats.iterations=2", "--set", "splats.sh_degree=0"]
    result = enerf("export", scene, "--splats", "--to", *(tmp_path / f"all{each}" for each in SPLAT_EXPORTERS), *few, "--json")
    assert result.code == 0, result.err
    written = result.objects[-1]["written"]
    assert [entry["bytes"] for entry in written] == [(tmp_path / f"all{each}").stat().st_size for each in SPLAT_EXPORTERS]
    assert enerf("export", scene, "--splats", "--to", tmp_path / "subject.ply", "--region", "foreground", *few).code == 0
    everything, subject = (np.abs(read_splats(tmp_path / f"{name}.ply").means).max() for name in ("all", "subject"))
    assert everything > 3.5
    assert subject < 1.6
    assert written[0]["Gaussians"] == len(read_splats(tmp_path / "all.ply")) <= 400
    assert enerf("export", scene, "--splats", "--to", tmp_path / "all.spz", *few).code == 2, "it is there"


def test_every_frame_has_its_passes_where_asked_for(enerf: Enerf, ball: Path, tmp_path: Path) -> None:
    result = enerf("render", ball, "--out", tmp_path, "--frames", 2, "--width", 16, "--height", 16, "--exr", "all")
    assert result.code == 0, result.err
    assert sorted(path.name for path in tmp_path.iterdir()) == [f"frame_000{k}.{kind}" for k in range(2) for kind in ("exr", "png")]
    for k in range(2):
        with OpenEXR.File(str(tmp_path / f"frame_000{k}.exr"), separate_channels=True) as file:
            place = np.stack([file.channels()[f"position.{axis}"].pixels for axis in "XYZ"], axis=-1)
        assert np.linalg.norm(place[8, 8]) == pytest.approx(0.6 / SCALE, abs=0.1), "on the ball, in the capture's units"


@pytest.mark.parametrize(
    ("arguments", "code", "remedy"),
    [
        (["--to", "ball.fbx"], 2, ".ply, .glb, .obj"),
        (["--to", "ball.obj", "--points"], 2, ".ply, .xyz"),
        (["--to", "ball.obj", "--splats"], 2, ".ply, .spz"),
        (["--to", "ball.ply", "--splats", "--points"], 2, "one"),
        (["--to", "ball.glb", "--splats", "--texture", "asset"], 2, "texture"),
        (["--to", "ball.ply", "--splats", "--set", "splats.sh_degree=4"], 2, "splats.sh_degree"),
        (["--to", "ball.ply", "--splats", "--memory", "100m"], 2, "Lower splats.count (280000)"),
        (["--to", "no/where/ball.ply"], 2, "no/where"),
        (["--to", "cameras.json"], 2, "cameras"),
        (["--to", "ball.ply", "--memory", "100m"], 2, "--memory"),
        (["--to", "ball.ply", "--points", "--set", "points.num_points=100000000", "--memory", "1g"], 2, "Lower points.num_points (100000000)"),
        (["--to", "ball.ply", "--set", "mesh.density_threshold=1e6"], 2, "ower mesh.density_threshold"),
        (["--to", "ball.glb", "--texture", "photographs"], 2, "--texture asset"),
        (["--to", "ball.stl", "--texture", "asset"], 2, "texture"),
        (["--to", "ball.ply", "--jpeg"], 2, "texture"),
        (["--to", "ball.glb", "--faces", "many"], 2, "20k"),
        (["--to", "ball.glb", "--texture-size", "100"], 2, "mesh.texture_size"),
        ([], 2, "--to"),
    ],
)
def test_exports_that_are_refused(
    enerf: Enerf, ball: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], code: int, remedy: str
) -> None:
    monkeypatch.chdir(tmp_path)
    result = enerf("export", ball, *arguments)
    assert (result.code, remedy in result.err) == (code, True), result.err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "remedy"),
    [
        (["--width", 8192, "--height", 8192, "--memory", "2g"], "--width"),
        (["--background", "pink"], "background"),
        (["--video", "ball.avi"], ".mp4"),
        (["--path", "captured"], "captured"),
        (["--path", "odd.json"], "odd.json"),
    ],
)
def test_renders_that_are_refused(enerf: Enerf, ball: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[object], remedy: str) -> None:
    monkeypatch.chdir(tmp_path)
    Path("odd.json").write_text('{"frames": []}', encoding="utf-8")
    result = enerf("render", ball, "--out", "frames", *arguments)
    assert (result.code, remedy in result.err) == (2, True), result.err
    assert [path.name for path in tmp_path.iterdir()] == ["odd.json"]


def test_a_turntable_with_its_video(enerf: Enerf, ball: Path, tmp_path: Path) -> None:
    out, video = tmp_path / "frames", tmp_path / "ball.mp4"
    result = enerf("render", ball, "--out", out, "--frames", 3, "--width", 32, "--height", 24, "--background", "#0000ff", "--video", video)
    assert result.code == 0, result.err
    assert sorted(path.name for path in out.glob("*.png")) == ["frame_0000.png", "frame_0001.png", "frame_0002.png"]
    pixels = np.asarray(Image.open(out / "frame_0001.png"))
    assert (pixels.shape, pixels[0, 0].tolist(), pixels[12, 16, 0] > 200) == ((24, 32, 3), [0, 0, 255], True)
    assert video.read_bytes()[4:8] == b"ftyp"


def test_a_camera_path(enerf: Enerf, ball: Path, tmp_path: Path) -> None:
    matrix = [1, 0, 0, 0, 0, 0, -1, -4, 0, 1, 0, 0, 0, 0, 0, 1]  # at y = -4 in the capture's frame, looking along +y
    path = tmp_path / "path.json"
    path.write_text(json.dumps({"render_width": 40, "render_height": 30, "fps": 10, "camera_path": [{"camera_to_world": matrix, "fov": 60}]}), encoding="utf-8")
    result = enerf("render", ball, "--out", tmp_path / "frames", "--path", path, "--json")
    assert result.code == 0, result.err
    assert result.objects[-1]["written"][0].endswith("frame_0000.png")
    assert np.asarray(Image.open(tmp_path / "frames/frame_0000.png")).shape == (30, 40, 3)


def test_describing_gaussians(enerf: Enerf, tmp_path: Path) -> None:
    """And a file of another kind by that name, and a damaged one."""
    for extension, kind in SPLAT_EXPORTERS.items():
        kind(scattered(20), tmp_path / f"a{extension}", Z_UP)
        found = enerf("inspect", tmp_path / f"a{extension}", "--json").object
        assert (found["what"], found["gaussians"], found["sh_degree"]) == ("splats", 20, 2)
    MESH_EXPORTERS[".glb"](block(), tmp_path / "mesh.glb", Z_UP)
    assert enerf("inspect", tmp_path / "mesh.glb", "--json").object["what"] == "mesh"
    (tmp_path / "a.spz").write_bytes((tmp_path / "a.spz").read_bytes()[:9])
    result = enerf("inspect", tmp_path / "a.spz")
    assert (result.code, "a.spz" in result.err) == (2, True)


def test_broken_assets(enerf: Enerf, ball: Path, tmp_path: Path) -> None:
    found = enerf("inspect", ball, "--json").object
    assert (found["what"], found["resolution"], found["sh_degree"]) == ("asset", [24, 24, 24], 0)
    content = ball.read_bytes()
    for damaged in (content[:-100], content[:-1] + b"x", b"no asset"):
        (tmp_path / "a.nerftree").write_bytes(damaged)
        result = enerf("render", tmp_path / "a.nerftree", "--out", tmp_path / "frames")
        assert (result.code, str(tmp_path / "a.nerftree") in result.err, len(result.err.splitlines()) <= 2) == (4, True, True)
    assert enerf("inspect", tmp_path / "a.nerftree").code == 4
    (tmp_path / "mesh.ply").write_text("ply\nbroken", encoding="utf-8")
    for name in ("mesh.ply", "nothing.nerftree"):
        assert enerf("inspect", tmp_path / name).code == 2
    assert enerf("render", tmp_path, "--out", tmp_path / "frames").code == 2


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two nested grids: a red ball about the origin and its foreground region, a blue ball outside of it, green surroundings, captured cameras on an arc."""
    trees = []
    for number, (shape, voxel, low) in enumerate(cascade_grids(np.array([[-1.0] * 3, [1.0] * 3]), 2 / 24, 3, 2)):
        at = low + (np.argwhere(np.ones(np.array(shape) * 3, bool)) + 0.5) * voxel
        inside = np.linalg.norm(at - ((0, 0, 0), (1.6, 0, 0))[number], axis=1) < (0.6, 0.3)[number]
        sh = np.tile(np.array([[[8.0, -8, -8]], [[-8.0, -8, 8]]], np.float32)[number], (int(inside.sum()), 1, 1))
        trees.append(tree_from_voxels(shape, voxel, low, np.argwhere(np.ones(np.array(shape) * 3, bool))[inside], np.full(inside.sum(), 150.0), sh, brick=3))
    cameras = [Camera("", 80, 60, "SIMPLE_PINHOLE", (80.0, 40, 30), pose_on_sphere((0, 0, 0), 4.0, azimuth, 20.0)) for azimuth in range(-120, -59, 6)]
    metadata = {"world_from_capture": {"scale": SCALE, "rotation": np.eye(3).tolist(), "translation": [0.0, 0.0, 0.0]}}
    metadata["captured_path"] = captured_metadata(cameras)
    around = Region(np.array([[-0.8] * 3, [0.8] * 3]), 0.2, 0.05)
    path = tmp_path_factory.mktemp("scene") / "scene.nerftree"
    format.save(replace(nested(trees, np.tile(np.float32([0, 1, 0]), (8, 16, 1))), region=around, metadata=metadata), path, "sparse")
    return path


def test_exports_take_the_foreground_unless_all_is_asked_for(enerf: Enerf, scene: Path, tmp_path: Path) -> None:
    """The blue ball is at 3.2 along x in the capture's frame, the red one's radius is 1.2."""
    both = ["--set", "mesh.region=all", "--region", "foreground"]
    for name, more, reach in (("a", [], 1.3), ("b", ["--region", "all"], 3.9), ("c", both[:2], 3.9), ("d", both, 1.3)):
        assert enerf("export", scene, "--to", tmp_path / f"{name}.ply", *more, "--set", "mesh.max_faces=3000").code == 0
        assert enerf("inspect", tmp_path / f"{name}.ply", "--json").object["bounds"][1][0] == pytest.approx(reach, abs=0.25)
    assert enerf("export", scene, "--points", "--to", tmp_path / "points.ply", "--region", "all", "--set", "points.num_points=500").code == 0
    assert enerf("inspect", tmp_path / "points.ply", "--json").object["bounds"][1][0] == pytest.approx(3.9, abs=0.45)
    assert "11 cameras" in enerf("inspect", scene).out
    assert len(enerf("inspect", scene, "--json").object["captured_path"]["poses"]) == 11


def test_a_crop_is_in_the_frame_of_the_capture_and_replaces_the_region(enerf: Enerf, scene: Path, tmp_path: Path) -> None:
    found = enerf("export", scene, "--to", tmp_path / "a.ply", "--crop", 4, 1, 1, 2, -1, -1, "--set", "mesh.max_faces=3000")
    assert found.code == 0, found.err
    low, high = enerf("inspect", tmp_path / "a.ply", "--json").object["bounds"]
    assert (low[0], high[0]) == (pytest.approx(2.6, abs=0.25), pytest.approx(3.9, abs=0.25))
    ours = (4, 1, 1, 2, -1, -1)
    for numbers, more in ((ours, ("--region", "foreground")), ((0, 0, 0, 1, 1, 0), ()), ((50, 50, 50, 51, 51, 51), ()), ((0, 0, 0, 1, 1, "nan"), ())):
        assert enerf("export", scene, "--to", tmp_path / "c.ply", "--crop", *numbers, *more).code == 2
    assert not (tmp_path / "c.ply").exists()


def frame(enerf: Enerf, scene: Path, folder: Path, *more: object) -> np.ndarray:
    result = enerf("render", scene, "--out", folder, "--frames", 4, "--width", 48, "--height", 36, *more)
    assert result.code == 0, result.err
    return np.asarray(Image.open(folder / "frame_0000.png")).astype(int)


def test_renders_show_all_with_its_surroundings_or_the_foreground(enerf: Enerf, scene: Path, tmp_path: Path) -> None:
    everything = frame(enerf, scene, tmp_path / "all", "--set", "turntable.fov=60")
    assert everything[0, 0].tolist() == [0, 255, 0]
    assert everything[18, 24, 0] > 200
    assert (everything[..., 2] > 200).any(), "the blue ball"
    on_black = frame(enerf, scene, tmp_path / "black", "--background", "black")
    assert on_black[0, 0].tolist() == [0, 0, 0], "the background that is asked for takes the surroundings' place"
    cropped = frame(enerf, scene, tmp_path / "crop", "--crop", 4, 1, 1, 2, -1, -1)
    assert cropped[18, 24, 2] > 200, "the crop is what is framed"
    assert (cropped[..., 0] > 200).sum() == (cropped.min(axis=2) > 200).sum(), "nothing red"
    ways = ("auto", "orbit", "sway", "captured")
    subject, orbit, sway, captured = (frame(enerf, scene, tmp_path / way, "--region", "foreground", "--path", way) for way in ways)
    assert (subject[0, 0].tolist(), subject[18, 24, 0] > 200) == ([255, 255, 255], True)
    assert not ((subject[..., 2] > 200) & (subject[..., 0] < 100)).any(), "the blue ball"
    assert np.array_equal(subject, sway), "cameras on an arc sway"
    assert not any(np.array_equal(each, orbit) for each in (subject, captured))
    assert np.array_equal(frame(enerf, scene, tmp_path / "set", "--set", "turntable.region=foreground"), subject)
