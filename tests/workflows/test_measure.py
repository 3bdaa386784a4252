"""`enerf measure`: lengths by places and pixels, metres by known lengths that exports follow; `enerf orient`: up by places; and one line for each mistake."""

import html
import json
import re
import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from efficientnerf.geometry.cameras import Camera, project
from pipeline.run import Run
from stages.artifacts import BakeOutputs, MeshOutputs, PosesOutputs, TurntableOutputs
from stages.formats.exporters import MESH_EXPORTERS
from stages.formats.exporters.writing import source_frame
from stages.framing.true_frame import NAME
from stages.io.capture import SparsePoints
from stages.io.scene import Scene, View, load, save, save_points, similarity_to_json
from tests.efficientnerf.capture.rings import cameras_round
from tests.stages.balls import ORBIT, SIMILARITY
from tests.stages.io.meshes import Z_UP, block
from tests.workflows.assets import write_block
from tests.workflows.command import Enerf
from workflows.loading import load_asset

A, B = np.array([0.3, -0.2, 0.1]), np.array([-0.25, 0.3, 0.2])
LENGTH = float(np.linalg.norm(B - A))


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """Six photographs of unknown unit, and an asset of them."""
    path = tmp_path / "run"
    Run.create(path, Path("/photographs"))
    PosesOutputs.of_run(path).folder.mkdir()
    views = [View(f"images/{c.name}", None, "train", SIMILARITY.camera(c), c, 1.0, 5.0) for c in cameras()]
    save(Scene("photographs", tuple(views), np.array([[-1.0] * 3, [1.0] * 3]), None, SIMILARITY, ORBIT), PosesOutputs.of_run(path).folder)
    write_block(BakeOutputs.of_run(path).asset, 0.001, {"world_from_capture": similarity_to_json(SIMILARITY), "metric": False})
    return path


def cameras() -> list[Camera]:
    return [replace(camera, name=f"side/{camera.name}") for camera in cameras_round(6, np.random.default_rng(0))]


def by_pixels(point: np.ndarray, *numbers: int) -> str:
    seen = [(cameras()[n], project(cameras()[n], point[None])[0][0]) for n in numbers]
    return "+".join(f"{camera.name}:{x:.4f},{y:.4f}" for camera, (x, y) in seen)


def by_numbers(point: np.ndarray) -> str:
    return ",".join(f"{x:.9g}" for x in point)


def test_pixels_and_places_of_the_same_points_have_one_length(enerf: Enerf, run: Path) -> None:
    found = [enerf("measure", run, a, b, "--json") for a, b in ((by_numbers(A), by_numbers(B)), (by_pixels(A, 0, 2, 4), by_pixels(B, 1, 5)))]
    assert [each.code for each in found] == [0, 0], found
    for each in found:
        assert each.object["unit"] == "unknown"
        (leg,) = each.object["lengths"]
        assert leg["length"] == pytest.approx(LENGTH, rel=1e-5)
        assert 0 < leg["error"] < 0.1
    text = enerf("measure", run, by_numbers(A), by_numbers(B), by_numbers(A)).out
    assert f"in all: {2 * LENGTH:.5g}" in text
    assert "--known-length" in text


def test_known_lengths_give_metres_to_exports_and_are_forgotten(enerf: Enerf, run: Path, tmp_path: Path) -> None:
    before = {path: path.read_bytes() for stage in ("poses", "bake") for path in (run / stage).iterdir()}
    known = ("--known-length", by_pixels(A, 0, 1, 2, 3, 4, 5), by_pixels(B, 0, 1, 2, 3, 4, 5))
    found = enerf("measure", run, *known, "30cm", by_pixels(A, 0, 3), by_pixels(B, 0, 3), "--json")
    assert found.code == 0, found.err
    factor = 0.3 / LENGTH
    assert found.object["unit"] == "metre"
    assert found.object["metres_per_unit_of_capture"] == pytest.approx(factor, rel=1e-5)
    assert found.object["lengths"][0]["length"] == pytest.approx(0.3, rel=1e-5)
    again = enerf("measure", run, by_numbers(factor * A), by_numbers(factor * B), "--json")  # places are in the frame of exports
    assert again.object["lengths"][0]["length"] == pytest.approx(0.3, rel=1e-5)

    metadata = load_asset(run).metadata
    assert metadata["metric"] is True
    assert metadata["world_from_capture"]["scale"] == pytest.approx(SIMILARITY.scale / factor, rel=1e-5)
    assert enerf("export", run, "--to", tmp_path / "cameras.json").code == 0
    first = np.array(json.loads((tmp_path / "cameras.json").read_text())["frames"][0]["transform_matrix"])
    assert json.loads((tmp_path / "cameras.json").read_text())["unit"] == "metre"
    np.testing.assert_allclose(first[:3, 3], factor * cameras()[0].centre, rtol=1e-5)
    assert {path: path.read_bytes() for path in before} == before

    half = enerf("measure", run, "--known-length", by_numbers(factor * A), by_numbers(factor * B), "15cm", "--json")  # replaces, does not multiply
    assert half.object["metres_per_unit_of_capture"] == pytest.approx(factor / 2, rel=1e-5)
    assert enerf("measure", run, "--forget").code == 0
    assert not (run / NAME).exists()
    assert load_asset(run).metadata["metric"] is False


def test_the_size_of_the_mesh_is_told_with_its_error_and_in_the_report(enerf: Enerf, run: Path) -> None:
    outputs, corners = MeshOutputs.of_run(run), block()
    outputs.folder.mkdir()
    turn = np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
    flat = (corners.vertices - corners.vertices.min(0)) / np.ptp(corners.vertices, axis=0)
    MESH_EXPORTERS[".ply"](replace(corners, vertices=flat * [2.0, 0.5, 1.5] @ turn.T), outputs.ply, Z_UP)
    outputs.report.write_text('{"faces": 12}', encoding="utf-8")
    found = enerf("measure", run, "--json")
    np.testing.assert_allclose(found.object["sides"], [2.0, 0.5, 1.5], rtol=1e-5)
    assert found.object["unit"] == "unknown"
    depth = float(np.median([(flat * [2.0, 0.5, 1.5] @ turn.T - camera.centre) @ camera.forward for camera in cameras()]))
    assert found.object["ground_sample_distance"] == pytest.approx(depth / 1500, rel=0.1)
    assert enerf("report", run).code == 0
    unsized = (run / "report.html").read_text(encoding="utf-8")
    assert "2.0000 by 0.5000, 1.5000 high" in unsized
    assert "For metres: enerf measure RUN --known-length" in unsized
    assert enerf("measure", run, "--known-length", by_numbers(A), by_numbers(B), f"{3 * LENGTH:.6f}m").code == 0
    np.testing.assert_allclose(enerf("measure", run, "--json").object["sides"], [6.0, 1.5, 4.5], rtol=1e-5)
    sized = (run / "report.html").read_text(encoding="utf-8")  # written again by the command
    assert re.search(r"6\.0+ m by 1\.50+ m, 4\.50+ m high, within 0\.\d+ m \(99 %\)", sized)
    assert "For metres" not in sized


def test_how_far_sparse_points_are_from_the_mesh_is_in_its_error(enerf: Enerf, run: Path) -> None:
    outputs, poses, rng = MeshOutputs.of_run(run), PosesOutputs.of_run(run).folder, np.random.default_rng(0)
    outputs.folder.mkdir()
    MESH_EXPORTERS[".ply"](block(), outputs.ply, Z_UP)
    exact = enerf("measure", run, "--json").object
    corners = np.repeat(block().vertices, 20, axis=0)
    points = SIMILARITY.points(corners + rng.normal(0, 0.3 * exact["surface_noise"], corners.shape))
    save(replace(load(poses), points=True), poses)
    sparse = SparsePoints(points, np.zeros(points.shape, np.uint8), np.zeros(len(points)), ((0,),) * len(points))
    save_points(sparse, poses)
    assert enerf("measure", run, "--json").object == exact  # less than half a voxel says nothing
    save_points(replace(sparse, xyz=SIMILARITY.points(corners + 2 * exact["surface_noise"] * rng.normal(0, 1, corners.shape))), poses)
    noisy = enerf("measure", run, "--json").object
    assert noisy["surface_noise"] > exact["surface_noise"]
    np.testing.assert_allclose(noisy["errors"], 2.58 * 2**0.5 * noisy["surface_noise"])


def test_how_sure_the_cameras_are_is_in_all_errors(enerf: Enerf, run: Path) -> None:
    outputs, poses, rng = MeshOutputs.of_run(run), PosesOutputs.of_run(run).folder, np.random.default_rng(0)
    outputs.folder.mkdir()
    MESH_EXPORTERS[".ply"](block(), outputs.ply, Z_UP)
    points = rng.uniform(-0.5, 0.5, (40, 3))
    save(replace(load(poses), points=True), poses)
    save_points(SparsePoints(SIMILARITY.points(points), np.zeros(points.shape, np.uint8), np.zeros(40), (tuple(range(len(cameras()))),) * 40), poses)
    leg = ("measure", run, by_numbers(A), by_numbers(B), "--json")
    exact, exact_leg = enerf("measure", run, "--json").object, enerf(*leg).object["lengths"][0]
    PosesOutputs.of_run(run).report.write_text('{"reprojection_error": 2.0}', encoding="utf-8")
    found, found_leg = enerf("measure", run, "--json").object, enerf(*leg).object["lengths"][0]
    assert exact["shape_spread"] == 0
    assert 1e-4 < found["shape_spread"] < 1e-2
    np.testing.assert_allclose(found["errors"], np.hypot(exact["errors"], 2.58 * found["shape_spread"] * np.array(found["sides"])))
    assert found_leg["error"] == pytest.approx(np.hypot(exact_leg["error"], 2.58 * found["shape_spread"] * LENGTH))


def test_lengths_that_do_not_agree_or_are_not_sure_are_refused(enerf: Enerf, run: Path) -> None:
    a, b, c = by_pixels(A, 0, 1, 2, 3, 4, 5), by_pixels(B, 0, 1, 2, 3, 4, 5), by_pixels(np.zeros(3), 0, 1, 2, 3, 4, 5)
    two = enerf("measure", run, "--known-length", a, b, "1m", "--known-length", a, c, "1m")
    assert two.code == 2
    assert "do not agree" in two.err
    near = enerf("measure", run, "--known-length", by_pixels(A, 0, 1), by_pixels(A + 0.003, 0, 1), "1m")
    assert near.code == 2
    assert "Give a longer one" in near.err
    assert not (run / NAME).exists()


def test_a_frame_of_other_cameras_is_not_applied(enerf: Enerf, run: Path) -> None:
    known = ("--known-length", by_pixels(A, 0, 1, 2, 3), by_pixels(B, 0, 1, 2, 3), "1m")
    assert enerf("measure", run, *known).code == 0
    scene = PosesOutputs.of_run(run).scene
    scene.write_bytes(scene.read_bytes() + b"\n")
    stale = enerf("measure", run, by_numbers(A), by_numbers(B))
    assert stale.code == 2
    assert "other cameras" in stale.err
    assert enerf("measure", run, *known).code == 0  # given again
    assert enerf("measure", run, by_numbers(A), by_numbers(B)).code == 0


@pytest.mark.parametrize(
    "change",
    [
        {"format": 2}, {"cameras": 3}, {"error": -1}, {"error": "x"}, {"error": None}, {"format": 2, "ground": {"up": [1, 0, 0], "height": 0, "places": []}},
        {"format": 2, "ground": {"up": [0, 0, 2], "height": 0, "places": []}}, {"ground": {"up": [0, 0, 1], "height": 0, "places": []}},
        {"lengths": [{"begin": "a"}]},
        {"frame_from_capture": {"scale": 0, "rotation": np.eye(3).tolist(), "translation": [0, 0, 0]}},
        {"frame_from_capture": {"scale": 1, "rotation": np.zeros((3, 3)).tolist(), "translation": [0, 0, 0]}},
    ],
)  # fmt: skip
def test_a_damaged_frame_is_told_and_forgotten(enerf: Enerf, run: Path, change: dict[str, object]) -> None:
    assert enerf("measure", run, "--known-length", by_pixels(A, 0, 1, 2, 3), by_pixels(B, 0, 1, 2, 3), "1m").code == 0
    document = json.loads((run / NAME).read_text(encoding="utf-8"))
    (run / NAME).write_text(json.dumps(document | change), encoding="utf-8")
    found = enerf("measure", run, by_numbers(A), by_numbers(B))
    assert (found.code, "frame.json" in found.err, len(found.err.splitlines())) == (4, True, 1), found.err
    assert enerf("measure", run, "--forget").code == 0
    assert enerf("measure", run, by_numbers(A), by_numbers(B)).code == 0


def test_a_frame_that_is_a_link_is_not_followed(enerf: Enerf, run: Path, tmp_path: Path) -> None:
    (tmp_path / "other.json").write_text("{}", encoding="utf-8")
    (run / NAME).symlink_to(tmp_path / "other.json")
    found = enerf("measure", run, by_numbers(A), by_numbers(B))
    assert (found.code, "frame.json" in found.err) == (4, True)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["1,2,3"], "two places"),
        (["1,2,3", "4,5"], "no place"),
        (["1,2,3", "side/7.png:1,2+side/0.png:3,4"], "no such photograph. Nearest: side/"),
        (["1,2,3", "side/1.png:1,2"], "two or more"),
        (["1,2,3", "1.png:1,2+0.png:9999,4"], "outside of side/0.png"),
        (["1,2,3", "1.png:10,20+0.png:1500,1100"], "the"),
        (["1,2,1e300", "1,2,3"], "too far"),
        (["--known-length", "1,2,3", "-4,5,6", "0m"], "--known-length 0m"),
        (["--known-length", "1,2,3", "1,2,3", "1m"], "one place"),
        (["--forget", "--known-length", "1,2,3", "-4,5,6", "1m"], "one of the two"),
    ],
)
def test_a_mistake_is_told_in_a_line_or_two(enerf: Enerf, run: Path, arguments: list[str], words: str) -> None:
    found = enerf("measure", run, *arguments)
    assert found.code == 2, found
    assert words in found.err
    assert "Traceback" not in found.err
    assert len(found.err.splitlines()) <= 2


def test_what_is_no_run_cannot_be_measured(enerf: Enerf, tmp_path: Path) -> None:
    found = enerf("measure", tmp_path, "1,2,3", "4,5,6")
    assert (found.code, "run" in found.err) == (2, True)


UP = np.array([0.2, -0.3, 0.93]) / np.linalg.norm([0.2, -0.3, 0.93])
ON_GROUND = -0.4 * UP + 0.5 * np.array([np.cross(UP, axis) for axis in ([1.0, 0, 0], [0, 1.0, 0], [-0.6, -0.8, 0])])


def degrees(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.degrees(np.arcsin(min(1.0, np.linalg.norm(np.cross(a, b))))) + (90 if a @ b < 0 else 0))


def camera_poses(enerf: Enerf, run: Path) -> tuple[np.ndarray, dict[str, object]]:
    """(C, 4, 4) poses as they are exported, and the document."""
    assert enerf("export", run, "--to", run.parent / "cameras.json", "--force").code == 0
    found = json.loads((run.parent / "cameras.json").read_text(encoding="utf-8"))
    return np.array([frame["transform_matrix"] for frame in found["frames"]]), found


@pytest.mark.parametrize("by", ["numbers", "pixels"])
def test_three_places_on_the_ground_make_exports_upright(enerf: Enerf, run: Path, by: str) -> None:
    kept = {path: path.read_bytes() for stage in ("poses", "bake") for path in (run / stage).iterdir()}
    before, _ = camera_poses(enerf, run)
    places = [by_numbers(place) if by == "numbers" else by_pixels(place, 0, 1, 2, 3, 4, 5) for place in ON_GROUND]
    found = enerf("orient", run, *places, "--json")
    assert found.code == 0, found.err
    assert degrees(np.array(found.object["up"]), UP) < 0.1
    assert found.object["degrees_from_run"] == pytest.approx(degrees(UP, SIMILARITY.rotation.T[:, 2]), abs=0.1)
    assert 0 < found.object["up_error"] < 1
    after, document = camera_poses(enerf, run)
    assert (document["up"], document["unit"]) == ([0, 0, 1], "unknown")
    turn = after[:, :3, :3] @ before[:, :3, :3].transpose(0, 2, 1)
    assert max(degrees(each @ UP, np.array([0.0, 0, 1])) for each in turn) < 0.1
    np.testing.assert_allclose(after[:, :3, 3], before[:, :3, 3] @ turn[0].T + [0, 0, 0.4], atol=1e-3)  # the ground at 0, cameras above it, the same scale
    seen = enerf("measure", run, *(by_pixels(place, 0, 1, 2, 3, 4, 5) for place in (A, B, *ON_GROUND)), "--json").object
    assert seen["lengths"][0]["length"] == pytest.approx(LENGTH, rel=1e-5)
    positions = [each["position"] for each in seen["places"][2:]]
    np.testing.assert_allclose(np.array(positions)[:, 2], 0, atol=1e-3)

    metadata = load_asset(run).metadata
    assert (metadata["up"], metadata["metric"]) == ([0, 0, 1], False)
    assert enerf("convert", run, run.parent / "upright.nerftree").code == 0
    assert source_frame(load_asset(run.parent / "upright.nerftree").metadata).up.tolist() == [0, 0, 1]
    again = enerf("orient", run, *map(by_numbers, np.array(positions)), "--json")  # the same places, told in the new frame
    np.testing.assert_allclose(camera_poses(enerf, run)[0], after, atol=1e-5)
    np.testing.assert_allclose(again.object["up"], found.object["up"], atol=1e-5)
    assert {path: path.read_bytes() for path in kept} == kept


def test_a_turntable_that_keeps_the_former_up_comes_with_the_command_for_another(enerf: Enerf, run: Path) -> None:
    video = TurntableOutputs.of_run(run).video
    video.parent.mkdir()
    video.write_bytes(b"")
    assert enerf("report", run).code == 0
    assert "enerf render" not in (run / "report.html").read_text(encoding="utf-8")
    found = enerf("orient", run, "--up", by_numbers(UP))
    command = f"enerf render {shlex.quote(str(run))} --out FRAMES --video upright.mp4"
    assert command in found.out
    assert html.escape(command) in (run / "report.html").read_text(encoding="utf-8")
    assert enerf("orient", run, "--forget").code == 0
    assert "enerf render" not in (run / "report.html").read_text(encoding="utf-8")


def test_up_and_lengths_are_forgotten_each_for_itself(enerf: Enerf, run: Path) -> None:
    known, places = ("--known-length", by_numbers(A), by_numbers(B), "30cm"), [by_numbers(place) for place in ON_GROUND]
    first, _ = camera_poses(enerf, run)
    assert enerf("measure", run, *known).code == 0
    metres, (sized, document) = (run / NAME).read_bytes(), camera_poses(enerf, run)
    scale = 0.3 / LENGTH
    assert enerf("orient", run, *(by_numbers(scale * place) for place in ON_GROUND)).code == 0
    turned, of_both = camera_poses(enerf, run)
    assert of_both["unit"] == "metre"
    np.testing.assert_allclose(np.diff(turned[:, 2, 3]), scale * np.diff(first[:, :3, 3] @ UP), atol=1e-6)
    assert enerf("orient", run, "--forget").code == 0
    assert (run / NAME).read_bytes() == metres
    again, same = camera_poses(enerf, run)
    assert (again.tolist(), same) == (sized.tolist(), document)

    assert enerf("measure", run, "--forget").code == 0
    assert enerf("orient", run, *places).code == 0
    upright, (poses, _) = (run / NAME).read_bytes(), camera_poses(enerf, run)
    assert enerf("measure", run, "--known-length", by_pixels(A, 0, 2, 4), by_pixels(B, 0, 2, 4), "30cm").code == 0
    np.testing.assert_allclose(camera_poses(enerf, run)[0][:, :3, 3], scale * poses[:, :3, 3], rtol=1e-4)
    assert enerf("measure", run, "--forget").code == 0
    assert (run / NAME).read_bytes() == upright
    assert enerf("orient", run, "--forget").code == 0
    assert not (run / NAME).exists()
    assert camera_poses(enerf, run)[0].tolist() == first.tolist()


def test_the_floor_that_sparse_points_show_makes_exports_upright(enerf: Enerf, run: Path) -> None:
    poses, rng = PosesOutputs.of_run(run).folder, np.random.default_rng(0)
    side = np.cross(UP, [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    floor = rng.uniform(-1, 1, (600, 2)) @ np.stack([side, np.cross(UP, side)]) - 0.4 * UP
    points = np.concatenate([floor, rng.normal(0, 0.2, (400, 3))])
    sparse = SparsePoints(SIMILARITY.points(points), np.zeros((1000, 3), np.uint8), np.zeros(1000), ((0,),) * 1000)
    assert "no floor or table" in enerf("orient", run, "--plane").err
    save(replace(load(poses), points=True), poses)
    save_points(sparse, poses)
    found = enerf("orient", run, "--plane", "--json")
    assert found.code == 0, found.err
    assert degrees(np.array(found.object["up"]), UP) < 0.5
    assert found.object["ground"] == pytest.approx(-0.4, abs=0.02)
    assert enerf("orient", run, "--forget").code == 0
    assert enerf("orient", run, "--up", by_numbers(UP), "--json").object["ground"] == pytest.approx(-0.4, abs=0.02)


@pytest.mark.parametrize("up", [[0, 0, 1], [0, 0, -1], [0, -1, 0], [1, 0, 0], [1e-5, 0, -1], [-0.3, 0.4, -0.5], [0.2, -0.3, 0.93]])
def test_a_direction_is_turned_up_and_back(enerf: Enerf, run: Path, up: list[float]) -> None:
    before, _ = camera_poses(enerf, run)
    assert enerf("orient", run, "--up", by_numbers(np.array(up))).code == 0
    after, _ = camera_poses(enerf, run)
    turn = after[0, :3, :3] @ before[0, :3, :3].T
    np.testing.assert_allclose(turn @ (up / np.linalg.norm(up)), [0, 0, 1], atol=1e-7)
    np.testing.assert_allclose(np.linalg.norm(after[:, :3, 3], axis=1), np.linalg.norm(before[:, :3, 3], axis=1), rtol=1e-9)
    assert enerf("orient", run, "--up", by_numbers(turn[:, 2])).code == 0  # the former z, told in the new frame
    np.testing.assert_allclose(camera_poses(enerf, run)[0], before, atol=1e-6)


def test_an_up_that_the_run_knows_otherwise_is_told_with_the_angle(enerf: Enerf, run: Path) -> None:
    angle = f"{degrees(UP, SIMILARITY.rotation.T[:, 2]):.1f} degrees"
    found = enerf("orient", run, "--up", by_numbers(UP))
    assert (found.err, angle in found.out) == ("", True)
    PosesOutputs.of_run(run).report.write_text('{"facts": {"up": {"by": "markers"}}}', encoding="utf-8")
    found = enerf("orient", run, "--up", "0,0,1", "--quiet")
    assert (found.code, found.out, found.err) == (0, "", f"warning: the new up is {angle} from the up that the run has, which is by markers.\n")
    PosesOutputs.of_run(run).report.write_text('{"facts": {"up": {"by": "GPS"}}}', encoding="utf-8")
    assert "by GPS" in enerf("orient", run, "--up", "1,0,0", "--quiet").err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "three places on the ground"),
        (["1,2,3", "4,5,6"], "three places on the ground"),
        (["1,2,3", "4,5,6", "1,1,1", "--forget"], "three places on the ground"),
        (["--up", "0,0,1", "--forget"], "three places on the ground"),
        (["0,0,0", "1,1,1", "-2,-2,-2.01"], "in one line"),
        (["0,0,0", "0,0,0", "1,0,0"], "in one line"),
        (["0,0,0", "0.001,0,0", "0,0.001,0"], "degrees only"),
        (["1,2,3", "4,5,6", "x.png:1,2"], "no such photograph"),
        (["--up", "0,0,0"], "--up 0,0,0: expected a direction"),
        (["--up", "z"], "--up z: expected a direction"),
        (["--up", "0,1e300,0"], "expected a direction"),
    ],
)
def test_what_gives_no_up_is_told_in_a_line_or_two(enerf: Enerf, run: Path, arguments: list[str], words: str) -> None:
    found = enerf("orient", run, *arguments)
    assert (found.code, words in found.err, len(found.err.splitlines()) <= 2) == (2, True, True), found
    assert not (run / NAME).exists()
