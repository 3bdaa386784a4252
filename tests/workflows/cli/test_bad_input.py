"""Bad input at the command line: a clear error or a warning, the right exit code, no traceback, and what a run held before stays."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.workflows.command import Result

Enerf = Callable[..., Result]
SIZE = (48, 36)


def pose(angle: float) -> list[list[float]]:
    """Camera to world, x right, y up, looking along -z at the origin from a circle of radius 4."""
    c, s = math.cos(angle), math.sin(angle)
    return [[-s, 0.0, c, 4 * c], [c, 0.0, s, 4 * s], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]


def picture(path: Path, seed: int, size: tuple[int, int] = SIZE) -> None:
    pixels = np.random.default_rng(seed).integers(0, 255, (size[1], size[0], 3), np.uint8)
    Image.fromarray(pixels).save(path)


def blender(folder: Path, count: int = 6) -> None:
    """A transforms.json with all that it may state."""
    folder.mkdir()
    frames = []
    for index in range(count):
        picture(folder / f"r_{index}.png", index)
        frames.append({"file_path": f"r_{index}.png", "transform_matrix": pose(index)})
    write(folder, {"fl_x": 50.0, "fl_y": 50.0, "cx": 24.0, "cy": 18.0, "w": 48, "h": 36, "frames": frames})


def write(folder: Path, document: Any) -> None:
    (folder / "transforms.json").write_text(json.dumps(document), encoding="utf-8")


def edit(change: Callable[[Any], object]) -> Callable[[Path], None]:
    """A change of the document in transforms.json."""

    def damage(folder: Path) -> None:
        document = json.loads((folder / "transforms.json").read_text(encoding="utf-8"))
        change(document)
        write(folder, document)

    return damage


def text(content: str) -> Callable[[Path], None]:
    return lambda folder: (folder / "transforms.json").write_text(content, encoding="utf-8") and None  # type: ignore[func-returns-value]


def truncate(name: str, count: int) -> Callable[[Path], None]:
    return lambda folder: (folder / name).write_bytes((folder / name).read_bytes()[:count]) and None  # type: ignore[func-returns-value]


def empty(folder: Path) -> None:
    shutil.rmtree(folder)
    folder.mkdir()


def only_text(folder: Path) -> None:
    empty(folder)
    (folder / "notes.md").write_text("nothing to see", encoding="utf-8")


def missing(*numbers: int) -> Callable[[Path], None]:
    return lambda folder: [(folder / f"r_{number}.png").unlink() for number in numbers] and None  # type: ignore[func-returns-value]


def outside(folder: Path) -> None:
    picture(folder.parent / "outside.png", 9)
    edit(lambda document: document["frames"][0].update(file_path="../outside.png"))(folder)


def mask_of(size: tuple[int, int]) -> Callable[[Path], None]:
    def damage(folder: Path) -> None:
        Image.new("L", size, 255).save(folder / "mask.png")
        edit(lambda document: document["frames"][0].update(mask_path="mask.png"))(folder)

    return damage


def llff(array: Any) -> Callable[[Path], None]:
    def damage(folder: Path) -> None:
        empty(folder)
        (folder / "images").mkdir()
        for index in range(4):
            picture(folder / "images" / f"{index}.png", index)
        np.save(folder / "poses_bounds.npy", array)

    return damage


def colmap(folder: Path, names: int = 5, points: str = "") -> None:
    """A COLMAP model in text with five images."""
    empty(folder)
    (folder / "images").mkdir()
    for index in range(5):
        picture(folder / "images" / f"{index}.png", index)
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    (model / "cameras.txt").write_text("1 PINHOLE 48 36 50 50 24 18\n", encoding="utf-8")
    lines = [f"{k + 1} {math.cos(0.1 * k)} 0 {math.sin(0.1 * k)} 0 {0.3 * k} 0 4 1 {k}.png\n\n" for k in range(names)]
    (model / "images.txt").write_text("".join(lines), encoding="utf-8")
    (model / "points3D.txt").write_text(points, encoding="utf-8")


def colmap_without(*numbers: int) -> Callable[[Path], None]:
    def damage(folder: Path) -> None:
        colmap(folder)
        for number in numbers:
            (folder / "images" / f"{number}.png").unlink()

    return damage


def colmap_truncated(folder: Path) -> None:
    colmap(folder)
    path = folder / "sparse/0/images.txt"
    path.write_text(path.read_text(encoding="utf-8")[:-20], encoding="utf-8")


def colmap_binary_truncated(folder: Path) -> None:
    colmap(folder)
    for name in ("cameras", "images", "points3D"):
        (folder / f"sparse/0/{name}.txt").unlink()
        (folder / f"sparse/0/{name}.bin").write_bytes((5).to_bytes(8, "little") + b"\1\0\0")


def set_matrix(matrix: Any) -> Callable[[Path], None]:
    return edit(lambda document: document["frames"][1].update(transform_matrix=matrix))


SKEWED = [[1.0, 0.5, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 2.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
NOT_FINITE = '{"fl_x": 50, "fl_y": 50, "frames": [{"file_path": "r_0.png", "transform_matrix": [[NaN, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}]}'

# what is wrong; options; exit code; words in the message
CASES = {
    "an empty folder": (empty, [], 2, ["empty", "expected"]),
    "no images of a known type": (only_text, [], 2, ["no image"]),
    "a truncated image": (truncate("r_2.png", 200), [], 0, ["warning", "r_2.png"]),
    "a truncated image, strict": (truncate("r_2.png", 200), ["--strict"], 2, ["r_2.png", "--strict"]),
    "too many truncated images": (lambda folder: [truncate(f"r_{k}.png", 200)(folder) for k in range(4)], [], 2, ["r_0.png", "at least 3"]),
    "frames missing on disk": (missing(1, 3), [], 0, ["warning", "2 of 6", "r_1.png", "r_3.png"]),
    "frames missing on disk, strict": (missing(1, 3), ["--strict"], 2, ["2 of 6", "r_1.png"]),
    "too few frames on disk": (missing(0, 1, 2, 3), [], 2, ["4 of 6", "r_0.png"]),
    "JSON that is cut short": (truncate("transforms.json", 100), [], 2, ["transforms.json", "not valid JSON"]),
    "JSON that is no data set": (text('{"hello": 1}'), [], 2, ["transforms.json", "frames"]),
    "JSON that is a list": (text("[1, 2]"), [], 2, ["transforms.json"]),
    "no frames": (edit(lambda document: document.update(frames=[])), [], 2, ["transforms.json", "frames"]),
    "a matrix that is not 4x4": (set_matrix([[1.0, 0.0], [0.0, 1.0]]), [], 2, ["transforms.json", "4x4"]),
    "a matrix that is not finite": (text(NOT_FINITE), [], 2, ["transforms.json", "NaN"]),
    "a matrix that is no rotation": (set_matrix(SKEWED), [], 2, ["transforms.json", "rotation"]),
    "a zero focal length": (edit(lambda document: document.update(fl_x=0.0, fl_y=0.0)), [], 2, ["transforms.json", "focal"]),
    "a size that agrees in aspect": (edit(lambda document: document.update(w=96, h=72)), [], 0, ["warning", "r_0.png", "scaled"]),
    "a size of another aspect": (edit(lambda document: document.update(w=96, h=36)), [], 2, ["96x36", "48x36"]),
    "poses_bounds of a wrong shape": (llff(np.zeros((4, 16))), [], 2, ["poses_bounds.npy", "17"]),
    "poses_bounds of a wrong count": (llff(np.ones((7, 17))), [], 2, ["poses_bounds.npy", "7", "4"]),
    "poses_bounds with objects": (llff(np.array([{}], dtype=object)), [], 2, ["poses_bounds.npy"]),
    "a model without some images": (colmap_without(1), [], 0, ["warning", "1 of 5", "1.png"]),
    "a model without its images": (colmap_without(0, 1, 2), [], 2, ["3 of 5", "0.png"]),
    "a truncated model in text": (colmap_truncated, [], 2, ["images.txt"]),
    "a truncated binary model": (colmap_binary_truncated, [], 2, [".bin"]),
    "a path that leaves the folder": (outside, [], 2, ["outside.png", "--allow-outside"]),
    "a path that leaves the folder, allowed": (outside, ["--allow-outside"], 0, []),
    "a mask of another aspect": (mask_of((20, 36)), [], 2, ["mask.png", "20x36", "48x36"]),
    "an unknown format": (lambda folder: None, ["--as", "blendr"], 2, ["blender"]),
}


@pytest.mark.parametrize("name", CASES)
def test_bad_sources(enerf: Enerf, tmp_path: Path, name: str) -> None:
    damage, options, code, words = CASES[name]
    source, run = tmp_path / "source", tmp_path / "run"
    blender(source)
    assert enerf("run", source, "--out", run, "--until", "poses", "--quiet").code == 0
    before = (run / "poses/manifest.json").read_bytes()
    damage(source)  # type: ignore[operator]
    for folder in (tmp_path / "new", run):
        if name == "an empty folder" and folder == run:
            continue  # taken for a source that is gone; the run stands as it is
        result = enerf("run", source, "--out", folder, "--until", "poses", *options)
        shown = result.err + result.out
        assert result.code == code, shown
        assert "Traceback" not in shown
        for word in words:
            assert word in result.err
        if code:
            errors = [line for line in result.err.splitlines() if line.startswith("enerf: ")]
            assert len(errors) == 1
            assert result.err.splitlines()[-2:].count(errors[0]) == 1
    if code:
        assert (run / "poses/manifest.json").read_bytes() == before
        assert enerf("verify", run, "--quiet").code == 0


def test_a_source_that_is_not_there(enerf: Enerf, tmp_path: Path) -> None:
    result = enerf("run", tmp_path / "nowhere", "--out", tmp_path / "run")
    assert (result.code, str(tmp_path / "nowhere") in result.err) == (2, True)
    assert not (tmp_path / "run").exists()
    blender(tmp_path / "source")
    result = enerf("run", tmp_path / "source/transforms.json", "--out", tmp_path / "run")
    assert (result.code, "is a file" in result.err) == (2, True)


@pytest.mark.parametrize(("name", "limits"), [("log2_hashmap_size", "at least 8, at most 24"), ("num_coarse_samples", "at least 8, at most 1024")])
def test_a_setting_too_small_for_training_is_refused_before_the_poses(enerf: Enerf, tmp_path: Path, name: str, limits: str) -> None:
    blender(tmp_path / "source")
    result = enerf("run", tmp_path / "source", "--out", tmp_path / "run", "--set", f"train.{name}=3")
    expected = f"enerf: --set train.{name}=3: train.{name}: found 3 (int), expected a whole number, {limits}, or auto."
    expected += " 'enerf presets train' says what it means."
    assert (result.code, result.err.strip()) == (2, expected)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    "options",
    [
        ("--set", "bake.resolution=1"), ("--set", "bake.resolution=7"), ("--set", "train.discretise=1"), ("--set", "bake.max_mib=0.0001"),
        ("--target-mib", "0.0001"),
    ],
)  # fmt: skip
def test_an_asset_too_small_to_have_a_surface_is_refused_before_the_poses(enerf: Enerf, tmp_path: Path, options: tuple[str, ...]) -> None:
    """Not by the stage points, after all others."""
    blender(tmp_path / "source")
    result = enerf("run", tmp_path / "source", "--out", tmp_path / "run", *options)
    assert (result.code, "at least" in result.err) == (2, True), result.err
    assert not (tmp_path / "run").exists()


def test_a_folder_that_is_no_run(enerf: Enerf, tmp_path: Path) -> None:
    blender(tmp_path / "source")
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "thesis.tex").write_text("mine", encoding="utf-8")
    for arguments in (["run", tmp_path / "source", "--out", tmp_path / "run"], ["run", "--out", tmp_path / "run"], ["status", tmp_path / "run"]):
        result = enerf(*arguments)
        assert result.code == 2
        assert "not a run" in result.err
    assert [path.name for path in (tmp_path / "run").iterdir()] == ["thesis.tex"]


def test_going_on_with_nothing(enerf: Enerf, tmp_path: Path) -> None:
    result = enerf("run", "--out", tmp_path / "run")
    assert result.code == 2
    assert "enerf run SOURCE --out" in result.err


@pytest.mark.parametrize(
    ("change", "code", "words"),
    [({"version": 99}, 2, "newer"), ({"format": "other"}, 2, "not of a run"), ({"settings": 3}, 4, "settings")],
)
def test_a_run_of_another_kind(enerf: Enerf, tmp_path: Path, change: dict[str, object], code: int, words: str) -> None:
    blender(tmp_path / "source")
    enerf("run", tmp_path / "source", "--out", tmp_path / "run", "--until", "poses", "--quiet")
    path = tmp_path / "run/run.json"
    path.write_text(json.dumps(json.loads(path.read_text(encoding="utf-8")) | change), encoding="utf-8")
    for arguments in (["run", "--out", tmp_path / "run"], ["status", tmp_path / "run"], ["verify", tmp_path / "run"]):
        result = enerf(*arguments)
        assert result.code == code
        assert words in result.err
        assert "Traceback" not in result.err


def test_the_source_may_vanish_and_the_run_move(enerf: Enerf, tmp_path: Path) -> None:
    blender(tmp_path / "source")
    assert enerf("run", tmp_path / "source", "--out", tmp_path / "run", "--until", "poses").code == 0
    shutil.rmtree(tmp_path / "source")
    (tmp_path / "run").rename(tmp_path / "moved")
    result = enerf("run", "--out", tmp_path / "moved", "--until", "poses")
    assert (result.code, "up to date" in result.out) == (0, True)
    assert enerf("inspect", tmp_path / "moved/poses", "--json").object["count"] == 6


def test_describing_a_source(enerf: Enerf, tmp_path: Path) -> None:
    blender(tmp_path / "source")
    found = enerf("inspect", tmp_path / "source", "--json").object
    assert (found["what"], found["count"]) == ("source", 6)
    assert [camera["name"] for camera in found["cameras"]] == [f"r_{k}.png" for k in range(6)]
    assert "PINHOLE" in enerf("inspect", tmp_path / "source").out
    assert enerf("inspect", tmp_path / "nowhere").code == 2


def test_recovered_cameras_go_on(enerf: Enerf, tmp_path: Path) -> None:
    """The cameras of a run, exported and read again, are the same."""
    blender(tmp_path / "source")
    enerf("run", tmp_path / "source", "--out", tmp_path / "run", "--until", "poses", "--quiet")
    assert enerf("export", tmp_path / "run", "--to", tmp_path / "source/transforms.json", "--force").code == 0
    found, again = enerf("inspect", tmp_path / "run/poses", "--json").object, enerf("inspect", tmp_path / "source", "--json").object
    for one, other in zip(*(sorted(each["cameras"], key=lambda camera: camera["name"]) for each in (found, again)), strict=True):
        assert one["name"] == other["name"]
        np.testing.assert_allclose(one["capture_from_camera"], other["capture_from_camera"], atol=1e-12)
        assert (one["width"], one["height"], one["split"]) == (other["width"], other["height"], other["split"])
