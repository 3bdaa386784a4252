"""Depth that phone apps export: which of it becomes points, and what they are used for."""

import contextlib
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from efficientnerf.geometry.cameras import Camera, project
from stages.formats import importers
from stages.formats.importers import depth
from stages.io.pictures import UnreadableImage
from tests.stages import captures, exports
from tests.stages.captures import Settings
from tests.stages.exports import read


def write_exr(path: Path, **channels: np.ndarray) -> None:
    OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, channels).write(str(path))


def sharp(folder: Path) -> tuple[Path, list[Camera]]:
    """Polycam's export whose depth maps show the plane z = 0, with as many pixels as the images."""
    folder, _ = exports.polycam(folder)
    made = [photo.camera for photo in read(folder).photos]
    for index, camera in enumerate(made):
        exports.write_depth(folder / f"keyframes/depth/img_{index}.png", exports.plane_depth(camera, 64, 48))
    return folder, made


def test_polycams_depth_becomes_points_that_images_agree_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, made = sharp(tmp_path / "a")
    capture = read(folder)
    assert len(capture.points.xyz) > 500
    assert np.abs(capture.points.xyz[:, 2]).max() < 0.01, "they lie on the plane"
    assert min(map(len, capture.points.tracks)) >= 3
    for point, track in list(zip(capture.points.xyz, capture.points.tracks, strict=True))[::97]:
        for index in track:
            pixel, distance = project(made[index], point[None])
            assert distance[0] > 0
            assert (pixel > 0).all()
            assert (pixel < (32, 24)).all()
    assert {folder / f"keyframes/depth/img_{index}.png" for index in range(6)} < set(importers.files(folder, Settings()))
    monkeypatch.setattr("stages.formats.importers.depth.MAX_TRACK", 3)
    again = read(folder)
    np.testing.assert_array_equal(again.points.xyz, capture.points.xyz)
    assert {len(track) for track in again.points.tracks} == {3}
    assert all(set(few) <= set(many) for few, many in zip(again.points.tracks, capture.points.tracks, strict=True))


def test_depth_that_no_other_image_confirms_is_left_out_with_a_word(tmp_path: Path) -> None:
    folder, _ = sharp(tmp_path / "a")
    random = np.random.default_rng(0)
    for index in range(6):
        exports.write_depth(folder / f"keyframes/depth/img_{index}.png", np.full((48, 64), 0.2 + 0.6 * index))
    (folder / "keyframes/depth/img_5.png").write_bytes(b"nothing")
    captures.write_picture(folder / "keyframes/depth/img_4.png", random.integers(0, 255, (48, 64, 3), np.uint8))
    capture = read(folder)
    assert capture.points is None
    assert capture.facts["depth_points"] == 0
    assert any("disagree everywhere" in warning for warning in capture.warnings)
    assert any("2 of 6 depth maps are not used" in warning for warning in capture.warnings)


@pytest.mark.parametrize(("key", "unit", "more"), [("depth_file_path", 0.001, {}), ("depth_path", 0.0005, {"integer_depth_scale": 0.0005})])
def test_depth_of_transforms(key: str, unit: float, more: dict[str, float], tmp_path: Path) -> None:
    made = captures.cameras()
    frames = captures.frames(made)
    for index, camera in enumerate(made):
        frames[index][key] = f"depth/img_{index}.png"
        exports.write_depth(tmp_path / f"depth/img_{index}.png", exports.plane_depth(camera, 64, 48), unit)
    captures.nerfstudio(tmp_path, frames=frames, **more)
    capture = read(tmp_path)
    assert np.abs(capture.points.xyz[:, 2]).max() < 0.01
    assert capture.metric == (key == "depth_file_path")
    assert tmp_path / "depth/img_3.png" in importers.files(tmp_path, Settings())
    captures.nerfstudio(tmp_path, frames=frames, **more, applied_scale=0.5)
    if key == "depth_file_path":
        assert read(tmp_path).points is None, "depth in other units than the poses"


def test_record3ds_depth(tmp_path: Path) -> None:
    folder, _ = exports.record3d(tmp_path / "a")
    place = folder / "EXR_RGBD/depth"
    place.mkdir()
    for photo in read(folder).photos:
        values = np.ascontiguousarray(exports.plane_depth(photo.camera, 64, 48), np.float32)
        values[:5] = np.nan
        write_exr(place / f"{photo.image.stem}.exr", R=values)
    capture = read(folder)
    assert np.abs(capture.points.xyz[:, 2]).max() < 0.01
    assert place / "3.exr" in importers.files(folder, Settings())
    (place / "3.exr").write_bytes(b"nothing")
    found = read(folder)
    assert all(3 not in track for track in found.points.tracks)
    assert any("1 of 6 depth maps are not used, e.g. 3.exr: unreadable" in warning for warning in found.warnings)


@pytest.mark.parametrize(("channels", "side"), [(60, 40), (12, 3000), (1, 5000)])
def test_an_exr_of_many_pixels_is_refused_before_they_are_decoded(channels: int, side: int, tmp_path: Path) -> None:
    """60 channels of nothing were 550 kB, 570 MB of memory and five seconds."""
    empty = np.zeros((side, side), np.float16)
    write_exr(tmp_path / "a.exr", **{f"c{number:02}": empty for number in range(channels)})
    with pytest.raises(UnreadableImage, match="pixels"):
        depth._exr(tmp_path / "a.exr")


def test_an_exr_that_is_cut_short_prints_nothing(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """The library prints to standard output, where --json has objects alone."""
    path = tmp_path / "a.exr"
    write_exr(path, R=np.random.default_rng(0).random((64, 64), np.float32))
    data = path.read_bytes()
    for end in range(300, len(data), len(data) // 7):
        path.write_bytes(data[:end])
        with contextlib.suppress(UnreadableImage):
            depth._exr(path)
    assert not capfd.readouterr().out
