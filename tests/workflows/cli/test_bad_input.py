"""Bad input at the command line: a clear error or a warning, the right exit code, no traceback, and what a run held before stays."""

import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from efficientnerf.asset.captured import MetadataError
from pipeline.run import Run
from tests.workflows.command import Enerf
from workflows.cli.failures import report_failure
from workflows.cli.main import main

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


# What is wrong; options; exit code; what the message names. Each rule of each format has its test in tests/stages/formats.
CASES = {
    "an empty folder": (empty, [], 2, ["source"]),
    "no images of a known type": (only_text, [], 2, ["source"]),
    "a truncated image": (truncate("r_2.png", 200), [], 0, ["warning", "r_2.png"]),
    "a truncated image, strict": (truncate("r_2.png", 200), ["--strict"], 2, ["r_2.png", "--strict"]),
    "too many truncated images": (lambda folder: [truncate(f"r_{k}.png", 200)(folder) for k in range(4)], [], 2, ["r_0.png", "at least 3"]),
    "frames missing on disk": (missing(1, 3), [], 0, ["warning", "2 of 6", "r_1.png", "r_3.png"]),
    "frames missing on disk, strict": (missing(1, 3), ["--strict"], 2, ["2 of 6", "r_1.png"]),
    "too few frames on disk": (missing(0, 1, 2, 3), [], 2, ["4 of 6", "r_0.png"]),
    "JSON that is cut short": (truncate("transforms.json", 100), [], 2, ["transforms.json"]),
    "a size that agrees in aspect": (edit(lambda document: document.update(w=96, h=72)), [], 0, ["warning", "r_0.png"]),
    "a path that leaves the folder": (outside, [], 2, ["outside.png", "--allow-outside"]),
    "a path that leaves the folder, allowed": (outside, ["--allow-outside"], 0, []),
    "a mask of another aspect": (mask_of((20, 36)), [], 2, ["mask.png", "20x36", "48x36"]),
    "an unknown format": (lambda folder: None, ["--as", "blendr"], 2, ["blender"]),
}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A source and a run of its cameras."""
    folder = tmp_path_factory.mktemp("made")
    blender(folder / "source")
    assert main(["run", str(folder / "source"), "--out", str(folder / "run"), "--until", "poses", "--quiet"]) == 0
    return folder


@pytest.fixture
def source(made: Path, tmp_path: Path) -> Path:
    """A copy of the source."""
    return Path(shutil.copytree(made / "source", tmp_path / "source"))


@pytest.mark.parametrize("name", CASES)
def test_bad_sources(enerf: Enerf, made: Path, source: Path, tmp_path: Path, name: str) -> None:
    damage, options, code, names = CASES[name]
    run = Path(shutil.copytree(made / "run", tmp_path / "run"))
    Run.open(run).update(source=source)
    before = (run / "poses/manifest.json").read_bytes()
    damage(source)  # type: ignore[operator]
    for folder in (tmp_path / "new", run):
        if name == "an empty folder" and folder == run:
            continue  # taken for a source that is gone; the run stands as it is
        result = enerf("run", source, "--out", folder, "--until", "poses", *options)
        assert result.code == code, result
        assert "Traceback" not in result.err + result.out
        assert all(each in result.err for each in names)
        assert len([line for line in result.err.splitlines()[-2:] if line.startswith("enerf: ")]) == bool(code)
    if code:
        assert (run / "poses/manifest.json").read_bytes() == before
        assert enerf("verify", run, "--quiet").code == 0


@pytest.mark.parametrize(
    ("arguments", "remedy"),
    [
        (["run", "nowhere", "--out", "new"], "nowhere"),
        (["run", "source/transforms.json", "--out", "new"], "transforms.json"),
        (["run", "--out", "new"], "enerf run SOURCE --out"),
        (["run", "source", "--out", "new", "--set", "train.log2_hashmap_size=3"], "at least 8, at most 24, or auto"),
        (["run", "source", "--out", "folder"], "not a run"),
        (["status", "folder"], "not a run"),
    ],
)
def test_what_is_no_source_or_run(enerf: Enerf, source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], remedy: str) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "thesis.tex").write_text("mine", encoding="utf-8")
    result = enerf(*arguments)
    assert (result.code, remedy in result.err) == (2, True), result.err
    assert not (tmp_path / "new").exists()
    assert [path.name for path in (tmp_path / "folder").iterdir()] == ["thesis.tex"]


@pytest.mark.parametrize("setting", ["bake.resolution=1", "bake.resolution=7", "train.discretise=1", "bake.max_mib=0.0001"])
def test_an_asset_too_small_to_have_a_surface_is_refused_before_the_poses(enerf: Enerf, source: Path, tmp_path: Path, setting: str) -> None:
    """Not by the stage points, after all others."""
    result = enerf("run", source, "--out", tmp_path / "run", "--set", setting)
    assert (result.code, "at least" in result.err) == (2, True), result.err
    assert not (tmp_path / "run").exists()


def test_recovered_cameras_go_on(enerf: Enerf, made: Path, source: Path) -> None:
    """The cameras of a run, exported and read again, are the same."""
    assert enerf("export", made / "run", "--to", source / "transforms.json", "--force").code == 0
    found, again = enerf("inspect", made / "run/poses", "--json").object, enerf("inspect", source, "--json").object
    assert (again["what"], again["count"]) == ("source", 6)
    for one, other in zip(*(sorted(each["cameras"], key=lambda camera: camera["name"]) for each in (found, again)), strict=True):
        assert one["name"] == other["name"]
        np.testing.assert_allclose(one["capture_from_camera"], other["capture_from_camera"], atol=1e-12)
        assert (one["width"], one["height"], one["split"]) == (other["width"], other["height"], other["split"])
    assert enerf("inspect", source.parent / "nowhere").code == 2


def test_an_asset_with_odd_metadata_is_bad_input(capsys: pytest.CaptureFixture[str]) -> None:
    assert report_failure(MetadataError("asset: its orbit is odd. Bake it again."), as_json=False, debug=False) == 2
    assert capsys.readouterr().err == "enerf: asset: its orbit is odd. Bake it again.\n"
