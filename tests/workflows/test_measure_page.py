"""Measuring in the page of a run, in a real browser: places lie on the surface, and lengths are those of the command that it gives."""

import shlex
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from efficientnerf.asset import format
from efficientnerf.asset.camera_paths import pose_on_sphere
from efficientnerf.asset.rendering import render
from efficientnerf.asset.tree import tree_from_voxels
from efficientnerf.geometry.cameras import Camera, Similarity, rays
from efficientnerf.geometry.orbit import Orbit
from efficientnerf.splats import rendering
from efficientnerf.splats.gaussians import Gaussians
from pipeline.run import Run
from stages.artifacts import BakeOutputs, PosesOutputs, SplatsOutputs
from stages.formats.exporters import SPLAT_EXPORTERS
from stages.formats.exporters.glb import gltf_from_capture
from stages.formats.exporters.splats.frames import moved
from stages.formats.exporters.writing import SourceFrame
from stages.framing.restriction import restricted
from stages.framing.true_frame import AS_CAPTURED, Ground, save_frame
from stages.io.scene import Scene, View, save, similarity_to_json
from tests.efficientnerf.capture.rings import cameras_round
from tests.stages.balls import SIMILARITY
from tests.stages.formats.gaussians import read_spz, scattered
from tests.stages.viewer import browser
from tests.stages.viewer.browser import VIEW, WIDE
from tests.stages.viewer.scenes import ORBIT
from tests.workflows.command import Enerf
from workflows.report.viewer import write_viewer_of

pytestmark = pytest.mark.skipif(browser.missing() is not None, reason=str(browser.missing()))

HOME: dict[str, Any] = {**ORBIT, "centre": (0.0, 0.0, 0.0)}
BOX = "-0.1 -0.2 -0.3 0.2 0.2 0.2"
CORNERS = np.array([[0.35, 0.3], [0.6, 0.45], [0.45, 0.7], [0.4, 0.5]])  # shares of the canvas


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A run that made a solid block, and Gaussians round it."""
    path = tmp_path / "a run"
    Run.create(path, Path("/photographs"))
    for outputs in (PosesOutputs.of_run(path), BakeOutputs.of_run(path)):
        outputs.folder.mkdir()
    views = [View(f"images/{c.name}", None, "train", SIMILARITY.camera(c), c, 1.0, 5.0) for c in cameras_round(4, np.random.default_rng(0))]
    bounds = np.array([[-1.0] * 3, [1.0] * 3])
    save(Scene("photographs", tuple(views), bounds, None, SIMILARITY, Orbit(**HOME), metric=True), PosesOutputs.of_run(path).folder)
    metadata = {"world_from_capture": similarity_to_json(SIMILARITY), "metric": True, "orbit": HOME}
    index = np.argwhere(np.ones((16, 16, 16), bool))
    tree = tree_from_voxels((4, 4, 4), 0.1, np.full(3, -0.8), index, np.full(4096, 100.0), np.zeros((4096, 1, 3), np.float32), brick=4, metadata=metadata)
    format.save(tree, BakeOutputs.of_run(path).asset, "compact")
    SplatsOutputs.of_run(path).folder.mkdir()
    SPLAT_EXPORTERS[".spz"](moved(shell(), SIMILARITY.inverse()), SplatsOutputs.of_run(path).spz, SourceFrame(SIMILARITY))
    return path


def shell(count: int = 1500) -> Gaussians:
    """Gaussians near a sphere, of all shapes and opacities, all larger than a pixel."""
    given, rng = scattered(count, 0), np.random.default_rng(1)
    means = given.means / np.linalg.norm(given.means, axis=1, keepdims=True) * rng.uniform(0.7, 1.0, (count, 1))
    return replace(given, means=means.astype(np.float32), scales=np.exp(rng.uniform(np.log(0.03), np.log(0.2), (count, 3))).astype(np.float32))


def shown_by(kind: str, run: Path) -> Path:
    return BakeOutputs.of_run(run).asset if kind == "asset" else SplatsOutputs.of_run(run).spz


def depth_of_asset(run: Path, camera: Camera, at: np.ndarray) -> list[float]:
    depth = render(format.load(BakeOutputs.of_run(run).asset), camera, background=(0, 0, 0)).depth
    return [depth[y, x] for x, y in at]


def depth_of_gaussians(run: Path, camera: Camera, at: np.ndarray) -> list[float]:
    """Where the Gaussian is densest along a pixel's ray before which, of Gaussians in the order of depth, the CPU renders less than half of the opacity."""
    up = SourceFrame(SIMILARITY).up
    found = moved(moved(read_spz(SplatsOutputs.of_run(run).spz)[1], Similarity(1.0, gltf_from_capture(up).T, np.zeros(3))), SIMILARITY)
    order = np.argsort((found.means - camera.centre) @ camera.forward)
    out = []
    for (x, y), ray in zip(at, rays(camera, at + 0.5)[1], strict=True):
        first, last = 0, len(order)  # of the first `first` the opacity is below half
        while last - first > 1:
            middle = (first + last) // 2
            light = rendering.render(Gaussians(*(part[order[:middle]] for part in parts_of(found))), camera).opacity[y, x]
            first, last = (middle, last) if light < 0.5 else (first, middle)
        mean, (w, i, j, k) = found.means[order[first]] - camera.centre, found.rotations[order[first]].astype(np.float64)
        turn = Rotation.from_quat([i, j, k, w]).as_matrix()
        inverse = turn @ np.diag(found.scales[order[first]].astype(np.float64) ** -2) @ turn.T
        out.append(float(ray @ inverse @ mean / (ray @ inverse @ ray) * (ray @ camera.forward)))
    return out


def parts_of(gaussians: Gaussians) -> tuple[np.ndarray, ...]:
    return gaussians.means, gaussians.scales, gaussians.rotations, gaussians.opacities, gaussians.harmonics


CAMERA = Camera("eye", 160, 120, "PINHOLE", (120.0, 120.0, 80.0, 60.0), pose_on_sphere((0.0, 0.0, 0.0), 4.0, 30.0, 25.0))
FRAMES = {"as captured": AS_CAPTURED, "set": AS_CAPTURED.with_lengths(2.0, 0.01, ()).with_ground(Ground((0.48, 0.6, 0.64), 0.3, []))}


@pytest.mark.parametrize("kind", ["asset", "Gaussians"])
@pytest.mark.parametrize("frame", FRAMES)
def test_lengths_in_the_page_are_those_of_the_command(chromium: Any, enerf: Enerf, run: Path, tmp_path: Path, kind: str, frame: str) -> None:
    file, true = tmp_path / "page.html", FRAMES[frame].from_capture
    if frame == "set":
        save_frame(FRAMES[frame], run)
    write_viewer_of(run, shown_by(kind, run), file)
    with browser.opened(chromium, file, **WIDE) as page:
        page.ready()
        page.page.click("#measure")
        page.shown()
        view, width, height = page.page.evaluate(VIEW)
        places = np.round(CORNERS * [width, height]).astype(int)
        for x, y in places:
            page.page.locator("#scene").click(position={"x": int(x), "y": int(y)})
        lines = page.page.input_value("#lengths").splitlines()
        page.page.fill("#box", BOX)
        page.page.click("#crop")
        page.shown()
        page.page.select_option("#units", "100")
        boxed = page.page.input_value("#lengths").splitlines()
        page.page.click("#crop")
        page.page.click("#undo")
        assert "3 to 4" not in page.page.input_value("#lengths")
        page.page.click("#copy")
        page.page.click("#clear")
        page.page.keyboard.press("m")
        assert page.page.is_hidden("#measured")
        assert page.console == []
    assert boxed[-3] == "box: 30 cm × 40 cm × 50 cm"
    assert boxed[-2] == f"enerf export 'a run' --crop {BOX} --to box.glb"
    program, verb, name, *given = shlex.split(lines[-1])
    assert (program, verb, name) == ("enerf", "measure", "a run")
    found = enerf("measure", run, *given, "--json")
    assert found.code == 0, found.err
    shown = [float(line.split(": ")[1].removesuffix(" m")) for line in lines[:4]]
    measured = [*(each["length"] for each in found.object["lengths"]), found.object["total"]]
    np.testing.assert_allclose(shown, measured, rtol=1e-3)

    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = view["rotation"], view["eye"]
    lens = np.add(view["lens"], [0, 0, 0.5, 0.5])  # centres of pixels are where it was clicked
    camera = Camera("eye", width, height, "PINHOLE", tuple(lens), pose)
    origins, directions = rays(camera, places + 0.5)
    depth = np.array((depth_of_asset if kind == "asset" else depth_of_gaussians)(run, camera, places))
    on_surface = true.points(SIMILARITY.inverse().points(origins + (depth / (directions @ camera.forward))[:, None] * directions))
    picked = np.array([place["position"] for place in found.object["places"]])
    assert np.linalg.norm(picked - on_surface, axis=1).max() < 0.01 * depth.min() * true.scale / SIMILARITY.scale
    normal = np.cross(picked[1] - picked[0], picked[2] - picked[0])
    assert shlex.split(lines[8]) == ["enerf", "orient", "a run", *given[:3]]
    over_plane = float(lines[7].removeprefix("over the plane of 1, 2 and 3: 4: ").removesuffix(" m"))
    up = true.rotation @ SIMILARITY.rotation.T @ [0, 0, 1] if frame == "as captured" else np.array([0, 0, 1])
    expected = (picked[3] - picked[0]) @ normal / np.linalg.norm(normal) * np.sign(normal @ up)
    np.testing.assert_allclose(over_plane, expected, rtol=1e-3, atol=1e-4)
    if frame == "set":  # z is up, in the picture too
        heights = float(lines[4].split(": ")[1].removesuffix(" m")), float(lines[5].rpartition("×")[2].removesuffix(" m"))
        np.testing.assert_allclose(heights, [picked[-1, 2] - picked[0, 2], np.ptp(picked[:, 2])], rtol=1e-3)
        over_ground = [float(each.split(": ")[1].removesuffix(" m")) for each in lines[6].removeprefix("over the ground: ").split(", ")]
        np.testing.assert_allclose(over_ground, picked[:, 2], rtol=1e-3, atol=1e-4)
        right = true.rotation @ SIMILARITY.rotation.T @ pose[:3, 0]
        assert abs(right[2]) < 1e-6


@pytest.mark.parametrize("kind", ["asset", "Gaussians"])
def test_where_there_is_no_surface_nothing_is_measured(chromium: Any, run: Path, tmp_path: Path, kind: str) -> None:
    file = tmp_path / "page.html"
    write_viewer_of(run, shown_by(kind, run), file)
    with browser.opened(chromium, file, **WIDE) as page:
        page.ready()
        page.page.click("#measure")
        page.shown()
        page.page.locator("#scene").click(position={"x": 3, "y": 3})
        assert "no surface" in page.page.input_value("#lengths")
        assert page.console == []


@pytest.mark.parametrize("kind", ["asset", "Gaussians"])
@pytest.mark.parametrize("frame", FRAMES)
def test_a_box_shows_what_its_command_exports(chromium: Any, run: Path, tmp_path: Path, kind: str, frame: str) -> None:
    file, true = tmp_path / "page.html", FRAMES[frame]
    if frame == "set":
        save_frame(true, run)
    write_viewer_of(run, shown_by(kind, run), file)
    middle, unit = true.from_capture.points(SIMILARITY.inverse().points(np.zeros((1, 3)))), true.from_capture.scale / SIMILARITY.scale
    corners = middle + unit * np.array([[-0.25, -0.9, -0.4], [0.6, 0.5, 0.9]])
    if kind == "asset":
        tree = format.load(BakeOutputs.of_run(run).asset)
        tree = tree.with_metadata(**true.metadata(tree.metadata))
        expected = render(restricted(tree, "all", corners.ravel().tolist()), CAMERA, background=(1, 1, 1)).colour
    else:
        up = SourceFrame(SIMILARITY).up
        captured = moved(read_spz(SplatsOutputs.of_run(run).spz)[1], Similarity(1.0, gltf_from_capture(up).T, np.zeros(3)))
        at = true.from_capture.points(captured.means.astype(np.float64))
        inside = ((at >= corners[0]) & (at <= corners[1])).all(axis=1)
        expected = rendering.render(Gaussians(*(part[inside] for part in parts_of(moved(captured, SIMILARITY)))), CAMERA, background=(1, 1, 1)).colour
    with browser.opened(chromium, file, **WIDE) as page:
        page.ready()
        page.page.click("#measure")
        page.page.fill("#box", " ".join(f"{x:.9g}" for x in corners.ravel()))
        page.page.click("#crop")
        page.page.wait_for_function("enerf.ready.then(({viewer}) => viewer.region !== null)")
        page.shown()
        cut = page.rendered(CAMERA, background=[1, 1, 1], surroundings=False)
        page.page.click("#crop")
        page.page.wait_for_function("enerf.ready.then(({viewer}) => viewer.region === null)")
        page.shown()
        assert page.console == []
        whole = page.rendered(CAMERA, background=[1, 1, 1], surroundings=False)
    shown = np.rint(255 * np.clip(expected, 0, 1))
    assert (np.abs(cut - shown).max(axis=2) > 8).mean() < 0.01
    assert (np.abs(whole - shown).max(axis=2) > 8).mean() > 0.05
