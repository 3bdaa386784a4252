"""Sources from anybody: nothing outside of them is read, their names do no harm, and runs inside of them are no part of them."""

import dataclasses
import io
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from pipeline.errors import BadInput
from pipeline.run import Run
from pipeline.stage import Job
from stages.formats import importers
from stages.formats.importers.description import describe_source
from stages.formats.importers.source import Source
from stages.io import scene
from stages.poses import run as poses
from stages.poses.settings import PosesSettings
from tests.stages import captures
from tests.stages.captures import Settings

# Bytes of no encoding, a line end, a terminal escape, a change of direction, and a tabulator; "plain.png" is what a name should be.
NAMES = ("img_\udcff\udcfe.png", "img_\nline.png", "img_\x1b[31mred.png", "img_\u202eodd.png", "img_ \t tab.png", "plain.png")
SHOWN = {r"img_\udcff\udcfe.png", r"img_\nline.png", r"img_\x1b[31mred.png", r"img_\u202eodd.png", r"img_ \t tab.png", "plain.png"}
RED = np.full((24, 32, 3), (255, 0, 0), np.uint8)


def run(source: Path, out: Path, **settings: Any) -> tuple[scene.Scene, list[str]]:
    """The scene, and the warnings."""
    events: list[dict[str, Any]] = []
    job = Job(settings=PosesSettings(**settings), out=out / "poses", work=out / "work", source=source, stage="poses", report=events.append)
    poses.run(job)
    return scene.load(out / "poses"), [event["text"] for event in events if event["event"] == "warning"]


def frames_of(folder: Path, change: Callable[[list[dict[str, Any]]], object]) -> None:
    document = json.loads((folder / "transforms.json").read_text())
    change(document["frames"])
    (folder / "transforms.json").write_text(json.dumps(document))


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Real paths of the files that Python opens."""
    paths: list[str] = []
    io_open, os_open = io.open, os.open

    def spy(original: Callable[..., Any]) -> Callable[..., Any]:
        def call(path: Any, *arguments: Any, **more: Any) -> Any:
            if isinstance(path, str | os.PathLike):
                paths.append(os.path.realpath(path))
            return original(path, *arguments, **more)

        return call

    monkeypatch.setattr(io, "open", spy(io_open))
    monkeypatch.setattr("builtins.open", spy(io_open))
    monkeypatch.setattr(os, "open", spy(os_open))
    return paths


# --- one gate


def test_a_picture_outside_of_the_source_does_not_reach_the_contact_sheet(tmp_path: Path, opened: list[str]) -> None:
    source = captures.nerfstudio(tmp_path / "source")
    secret = captures.write_picture(tmp_path / "secret/images/img_1.png", RED)
    frames_of(source, lambda frames: frames.append({**frames[1], "file_path": str(secret)}))
    opened.clear()
    made, warnings = run(source, tmp_path / "out")
    assert len(made.views) == 6
    assert any("name an image that an earlier frame has" in warning for warning in warnings)
    assert os.path.realpath(secret) not in opened
    with Image.open(tmp_path / "out/poses/contact_sheet.png") as sheet:
        assert not (np.asarray(sheet)[..., :3] == (255, 0, 0)).all(-1).any()


@pytest.mark.parametrize("how", captures.WRITERS)
@pytest.mark.parametrize("what", ["image", "mask", "list"])
def test_no_link_out_of_the_source_is_followed(tmp_path: Path, opened: list[str], how: str, what: str) -> None:
    source = captures.WRITERS[how][1](tmp_path / "source")
    images = sorted(path for path in source.rglob("img_2.png"))
    lists = [path for path in sorted(source.rglob("*")) if path.suffix in (".json", ".npy", ".bin", ".txt")]
    masks = captures.write_picture(source / "masks" / images[0].relative_to(source), RED)
    masked = how in ("llff", "colmap bin", "colmap txt")
    if what == "mask" and not masked:
        pytest.skip("this format names its masks")
    for path in {"image": images, "mask": [masks], "list": lists}[what]:
        elsewhere = tmp_path / "elsewhere" / path.name
        elsewhere.parent.mkdir(exist_ok=True)
        os.replace(path, elsewhere)
        path.symlink_to(elsewhere)
    settings = Settings()
    for attempt in (lambda: importers.files(source, settings), lambda: run(source, tmp_path / "out"), lambda: describe_source(source)):
        with pytest.raises(BadInput, match=r"leads out of the source folder .* pass --allow-outside"):
            attempt()
    assert not [path for path in opened if path.startswith(os.path.realpath(tmp_path / "elsewhere"))]
    assert len(run(source, tmp_path / "allowed", allow_outside=True)[0].views) == 6


def test_a_link_is_followed_once(tmp_path: Path) -> None:
    source = captures.nerfstudio(tmp_path / "source")
    image = source / "images/img_2.png"
    os.replace(image, source / "kept.png")
    image.symlink_to(source / "kept.png")
    capture = importers.IMPORTERS["nerfstudio"].read(source, Settings())
    image.unlink()
    image.symlink_to(captures.write_picture(tmp_path / "secret.png", RED))
    photo = next(photo for photo in capture.photos if photo.camera.name.endswith("img_2.png"))
    assert photo.image == source / "kept.png"


# --- names


@pytest.mark.parametrize("how", captures.WRITERS)
def test_hostile_names_are_shown_escaped(tmp_path: Path, how: str) -> None:
    made = [dataclasses.replace(camera, name=name) for camera, name in zip(captures.cameras(), NAMES, strict=True)]
    if how == "colmap txt":  # whose lines cannot hold a line end
        made[1] = dataclasses.replace(made[1], name="img_line.png")
    source = captures.WRITERS[how][1](tmp_path / "source", made)
    found, warnings = run(source, tmp_path / "out")
    shown = {view.name.rpartition("/")[2] for view in found.views}
    assert shown == (SHOWN if how != "colmap txt" else SHOWN - {r"img_\nline.png"} | {"img_line.png"})
    for text in [*warnings, (tmp_path / "out/poses/report.json").read_text(), *(str(path) for path in (tmp_path / "out").rglob("*"))]:
        assert all(character.isprintable() or character == "\n" for character in text)
    for view in found.views:
        np.testing.assert_array_equal(scene.read_image(tmp_path / "out/poses", view).shape[:2], (24, 32))


def test_messages_about_hostile_names_are_one_printable_line(tmp_path: Path) -> None:
    for number, name in enumerate(NAMES[:5]):
        source = tmp_path / str(number)
        captures.write_pictures(source, [name, "b.png", "c.png"])
        (source / name).write_bytes(b"nothing")
        described = describe_source(source)
        assert described["rejected"][0]["name"] in SHOWN
        os.unlink(source / name)
        (source / name).symlink_to("/etc/hostname")
        for attempt in (lambda source=source: importers.files(source, Settings()), lambda source=source: describe_source(source)):
            with pytest.raises(BadInput) as caught:
                attempt()
            assert str(caught.value).isprintable()
        with pytest.raises(BadInput) as caught:
            run(source, tmp_path / "out")
        assert str(caught.value).isprintable()


# --- runs inside of the source


def test_a_run_below_its_source_is_no_part_of_it(tmp_path: Path) -> None:
    source = tmp_path / "source"
    captures.write_pictures(source / "shots", ["a.png", "b.png", "c.png"])
    before = importers.files(source, Settings())
    mine = Run.create(source / "shots/run", source)
    captures.write_pictures(mine.path / "poses/images", ["a.png", "b.png", "c.png"])
    captures.write_pictures(source / ".hidden", ["h.png"])
    assert importers.files(source, Settings()) == before
    assert [path.name for path in Source(source).walk()] == ["a.png", "b.png", "c.png"]
    described = describe_source(source)
    assert described["count"] == 3
    assert "shots/run: a run inside the source folder; what was made there is not read." in described["warnings"]
