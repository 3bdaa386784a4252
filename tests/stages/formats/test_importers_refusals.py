"""Bad data sets get an error of one or two lines that says what, where and what to do; what can be got round is warned about."""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.errors import BadInput
from stages.formats import importers
from stages.formats.importers import llff, transforms
from stages.io.capture import Capture
from stages.io.json_file import read_json
from tests.stages import captures
from tests.stages.captures import HEIGHT, WIDTH, Settings


def read(folder: Path, **settings: Any) -> Capture:
    return importers.IMPORTERS[importers.detect(folder)].read(folder, Settings(**settings))


def refusal(folder: Path, *words: str, **settings: Any) -> str:
    """The message with which a source is refused; it must hold every one of the words."""
    with pytest.raises(BadInput) as caught:
        read(folder, **settings)
    text = str(caught.value)
    assert caught.value.exit_code == 2
    assert text.count("\n") <= 1, text
    for word in words:
        assert re.search(word, text), f"{word!r} not in {text!r}"
    return text


def edit(folder: Path, change: Callable[[dict[str, Any]], None], name: str = "transforms.json") -> Path:
    document = json.loads((folder / name).read_text())
    change(document)
    (folder / name).write_text(json.dumps(document))
    return folder


# --- folders


def test_no_folder(tmp_path: Path) -> None:
    refusal(tmp_path / "absent", "no such folder", "absent")


def test_a_file_instead_of_a_folder(tmp_path: Path) -> None:
    folder = captures.nerfstudio(tmp_path / "a")
    refusal(folder / "transforms.json", "a file; expected a folder")


def test_an_empty_folder(tmp_path: Path) -> None:
    refusal(tmp_path, "empty", "photographs")


def test_no_images_of_a_known_type(tmp_path: Path) -> None:
    for index in range(3):
        (tmp_path / f"{index}.psd").write_bytes(b"x")
    refusal(tmp_path, "no images of a known type", "3 .psd", "Convert")


@pytest.mark.parametrize("name", ["nerfstudio", "llff", "colmap"])
def test_the_format_asked_for_is_not_there(tmp_path: Path, name: str) -> None:
    captures.write_pictures(tmp_path, ["1.png", "2.png", "3.png"])
    with pytest.raises(BadInput, match="--as"):
        importers.IMPORTERS[name].read(tmp_path, Settings())


# --- JSON


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("{", "not valid JSON"),
        ("[1, 2]", "no data set"),
        ('{"a": 1}', "no data set.*`frames`"),
        ('{"frames": {}}', "no data set"),
        ('{"frames": []}', "list of frames is empty"),
        ('{"frames": [1]}', "frame 0 has no `file_path`"),
        ('{"frames": [{"file_path": 7}]}', "frame 0 has no `file_path`"),
        ('{"camera_angle_x": NaN, "frames": [{"file_path": "a"}]}', "NaN"),
        ('{"camera_angle_x": -Infinity, "frames": [{"file_path": "a"}]}', "Infinity"),
        ("[" * 100_000, "not valid JSON.*nested"),
        (b'{"frames": "\xff\xfe"}', "not valid JSON"),
    ],
)
def test_json_that_is_no_data_set(tmp_path: Path, text: str | bytes, word: str) -> None:
    (tmp_path / "transforms.json").write_bytes(text if isinstance(text, bytes) else text.encode())
    refusal(tmp_path, word, "transforms.json")


def test_json_is_bounded(tmp_path: Path) -> None:
    path = captures.nerfstudio(tmp_path / "a") / "transforms.json"
    with pytest.raises(BadInput, match="6 frames; at most 5"):
        transforms.read_document(path, max_frames=5)
    with pytest.raises(BadInput, match="larger than 100 bytes"):
        read_json(path, "Repair it.", limit=100)


MATRICES = {
    "3x4": (lambda m: m[:3], "expected a 4x4 matrix.*found 3x4"),
    "ragged": (lambda m: [m[0][:2], *m[1:]], "expected a 4x4 matrix"),
    "words": (lambda m: [["a"] * 4] * 4, "expected a 4x4 matrix"),
    "huge": (lambda m: [[1e999, 0, 0, 0], *m[1:]], "not valid JSON|not finite"),
    "scaled": (lambda m: (np.array(m) @ np.diag([2.5, 2.5, 2.5, 1])).tolist(), r"scaled by 2\.5.*Divide"),
    "sheared": (lambda m: (np.array(m) @ np.array([[1, 0.2, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])).tolist(), "no rotation"),
    "stretched": (lambda m: (np.array(m) @ np.diag([1, 1.01, 1, 1])).tolist(), "no rotation"),
    "zero": (lambda m: np.diag([0, 0, 0, 1]).tolist(), "no rotation"),
    "left-handed": (lambda m: (np.array(m) @ np.diag([1, 1, -1, 1])).tolist(), "left-handed"),
    "transposed": (lambda m: np.array(m).T.tolist(), "last row"),
}


@pytest.mark.parametrize("what", MATRICES)
def test_matrices(tmp_path: Path, what: str) -> None:
    change, word = MATRICES[what]
    folder = captures.nerfstudio(tmp_path / "a")

    def break_it(document: dict[str, Any]) -> None:
        document["frames"][2]["transform_matrix"] = change(document["frames"][2]["transform_matrix"])

    refusal(edit(folder, break_it), word, "transforms.json")


def test_matrices_are_rounded(tmp_path: Path) -> None:
    folder = captures.nerfstudio(tmp_path / "a")

    def round_it(document: dict[str, Any]) -> None:
        for frame in document["frames"]:
            frame["transform_matrix"] = np.round(frame["transform_matrix"], 3).tolist()

    pose = read(edit(folder, round_it)).photos[0].camera.world_from_camera
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)


def test_no_matrix(tmp_path: Path) -> None:
    refusal(edit(captures.nerfstudio(tmp_path / "a"), lambda d: d["frames"][1].pop("transform_matrix")), "frame 1.*no `transform_matrix`")


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"fl_x": 0}, "focal length 0"),
        ({"fl_y": -40.0}, "focal length -40"),
        ({"fl_x": "40"}, "fl_x is '40'"),
        ({"w": 32.5}, "w, h are 32.5x24"),
        ({"w": 0}, "w, h are 0x24"),
        ({"w": 64}, "stated for 64x24, the image is 32x24"),
        ({"camera_model": "EQUIRECTANGULAR"}, "EQUIRECTANGULAR"),
        ({"camera_model": "PINHOLE", "k1": 0.1}, "PINHOLE with k1"),
        ({"k4": 0.1}, "k4 to k6"),
        ({"ftheta_p0": 0.1}, "ftheta_p0 is not supported"),
        ({"train_filenames": "all"}, "train_filenames is not a list"),
    ],
)
def test_lenses(tmp_path: Path, change: dict[str, Any], word: str) -> None:
    model = {} if "camera_model" in change else {"camera_model": "OPENCV"}
    refusal(captures.nerfstudio(tmp_path / "a", **(model | change)), word)


@pytest.mark.parametrize("angle", [0.0, 3.2, -0.5])
def test_angles_of_view(tmp_path: Path, angle: float) -> None:
    folder = captures.blender(tmp_path / "a")
    for name in ("transforms_train.json", "transforms_test.json"):
        edit(folder, lambda d: d.update(camera_angle_x=angle), name)
    refusal(folder, "camera_angle_x")


def test_no_focal_length(tmp_path: Path) -> None:
    folder = captures.nerfstudio(tmp_path / "a")

    def take_out(document: dict[str, Any]) -> None:
        document.pop("fl_x")
        document.pop("fl_y")

    refusal(edit(folder, take_out), "no focal length")


def test_frames_missing_on_disk(tmp_path: Path) -> None:
    folder = captures.nerfstudio(tmp_path / "a")
    for index in (1, 4):
        (folder / f"images/img_{index}.png").unlink()
    capture = read(folder)
    assert [photo.camera.name for photo in capture.photos] == [f"images/img_{i}.png" for i in (0, 2, 3, 5)]
    assert any("2 of 6 listed images are missing: images/img_1.png, images/img_4.png" in warning for warning in capture.warnings)
    assert ("images/img_1.png", "listed but missing on disk") in capture.rejected
    refusal(folder, "2 of 6", "--strict", strict=True)
    for index in (0, 2):
        (folder / f"images/img_{index}.png").unlink()
    refusal(folder, "4 of 6", "2 remain; at least 3")


def test_a_missing_mask_and_points_are_said(tmp_path: Path) -> None:
    frames = captures.frames(captures.cameras())
    frames[0]["mask_path"] = "masks/absent.png"
    folder = captures.nerfstudio(tmp_path / "a", frames=frames, ply_file_path="cloud.ply")
    warnings = " ".join(read(folder).warnings)
    assert "1 masks that are listed" in warnings
    assert "cloud.ply: missing" in warnings
    (folder / "cloud.ply").write_text("nothing")
    assert "not readable as a PLY" in " ".join(read(folder).warnings)


def test_an_unreadable_image_is_named(tmp_path: Path) -> None:
    folder = captures.nerfstudio(tmp_path / "a")
    (folder / "images/img_3.png").write_bytes(b"not an image")
    capture = read(folder)
    assert len(capture.photos) == 5
    assert capture.rejected[0][0] == "images/img_3.png"
    assert any("img_3.png" in warning for warning in capture.warnings)


# --- paths that lead outside


@pytest.mark.parametrize("listed", ["../outside/x.png", "images/../../outside/x.png", "{outside}/x.png"])
def test_paths_that_leave_the_source(tmp_path: Path, listed: str) -> None:
    captures.write_picture(tmp_path / "outside/x.png", captures.picture())
    folder = captures.nerfstudio(tmp_path / "a")
    edit(folder, lambda d: d["frames"][0].update(file_path=listed.format(outside=tmp_path / "outside")))
    refusal(folder, "outside|out of", "--allow-outside")
    assert len(read(folder, allow_outside=True).photos) == 6
    with pytest.raises(BadInput):
        importers.files(folder, Settings())


@pytest.mark.parametrize("what", ["image", "folder", "mask"])
def test_links_that_leave_the_source(tmp_path: Path, what: str) -> None:
    outside = captures.write_picture(tmp_path / "outside/img_0.png", captures.picture())
    captures.write_pictures(tmp_path / "outside", [camera.name for camera in captures.cameras()])
    frames = captures.frames(captures.cameras())
    if what == "mask":
        frames[0]["mask_path"] = "mask.png"
    folder = captures.nerfstudio(tmp_path / "a", frames=frames)
    if what == "image":
        (folder / "images/img_0.png").unlink()
        (folder / "images/img_0.png").symlink_to(outside)
    elif what == "mask":
        (folder / "mask.png").symlink_to(outside)
    else:
        for index in range(6):
            (folder / f"images/img_{index}.png").unlink()
        (folder / "images").rmdir()
        (folder / "images").symlink_to(tmp_path / "outside")
    refusal(folder, "leads out of the source folder", "--allow-outside")
    assert len(read(folder, allow_outside=True).photos) == 6


# --- LLFF


@pytest.mark.parametrize(
    ("array", "word"),
    [
        (np.zeros((6, 14)), r"expected numbers of shape \(N, 17\)"),
        (np.zeros(17), r"shape \(N, 17\)"),
        (np.array([["a"] * 17] * 6), r"shape \(N, 17\)"),
        (np.full((6, 17), np.nan), "not finite"),
        (np.zeros((6, 17)), "row 0.*no rotation"),
    ],
)
def test_poses_bounds_of_a_wrong_shape(tmp_path: Path, array: np.ndarray, word: str) -> None:
    folder = captures.llff(tmp_path / "a")
    np.save(folder / "poses_bounds.npy", array)
    refusal(folder, word, "poses_bounds.npy")


def test_poses_bounds_of_a_wrong_count(tmp_path: Path) -> None:
    folder = captures.llff(tmp_path / "a")
    np.save(folder / "poses_bounds.npy", captures.llff_rows(captures.cameras(5)))
    refusal(folder, "5 poses, but images_4 holds 6")


def test_poses_bounds_with_objects_is_not_unpickled(tmp_path: Path) -> None:
    folder = captures.llff(tmp_path / "a")
    np.save(folder / "poses_bounds.npy", np.array([{"a": 1}] * 17, dtype=object), allow_pickle=True)
    refusal(folder, "expected numbers of shape")


@pytest.mark.parametrize("keep", [0, 5, 100, 500])
def test_poses_bounds_truncated(tmp_path: Path, keep: int) -> None:
    path = captures.llff(tmp_path / "a") / "poses_bounds.npy"
    path.write_bytes(path.read_bytes()[:keep])
    refusal(path.parent, "poses_bounds.npy")


def test_poses_bounds_is_bounded(tmp_path: Path) -> None:
    folder = captures.llff(tmp_path / "a")
    with pytest.raises(BadInput, match="more than -30 poses are not read"):  # its header alone has room for 30
        llff.read_rows(folder / llff.POSES, max_frames=-30)


@pytest.mark.parametrize(("column", "value", "word"), [(4, 95.5, "whole pixels"), (14, 0.0, "focal length 0"), (15, -1.0, "near"), (16, 1.0, "near")])
def test_poses_bounds_with_impossible_numbers(tmp_path: Path, column: int, value: float, word: str) -> None:
    folder = captures.llff(tmp_path / "a")
    rows = captures.llff_rows(captures.cameras())
    rows[2, column] = value
    np.save(folder / "poses_bounds.npy", rows)
    refusal(folder, "row 2", word)


def test_llff_without_images_or_with_another_factor(tmp_path: Path) -> None:
    folder = captures.llff(tmp_path / "a")
    refusal(folder, "reduced by 2.*images_4", llff_factor=2)
    (folder / "images_4").rename(folder / "pictures")
    refusal(folder, "without images")


# --- COLMAP


def test_colmap_names_absent_images(tmp_path: Path) -> None:
    folder = captures.colmap_bin(tmp_path / "a")
    (folder / "images/img_0.png").unlink()
    capture = read(folder)
    assert len(capture.photos) == 5
    assert any("1 of 6 listed images are missing: img_0.png" in warning for warning in capture.warnings)
    assert capture.points is not None
    assert capture.points.tracks[0] == (0, 1, 2, 3, 4)
    refusal(folder, "--strict", strict=True)
    for path in (folder / "images").iterdir():
        path.unlink()
    refusal(folder, "6 of 6", "folder `images`")


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
def test_colmap_binary_truncated_anywhere(tmp_path: Path, name: str) -> None:
    folder = captures.colmap_bin(tmp_path / "a")
    path = folder / "sparse/0" / name
    whole = path.read_bytes()
    for keep in sorted({*range(min(len(whole), 120)), *range(120, len(whole), 211), len(whole) - 1}):
        path.write_bytes(whole[:keep])
        refusal(folder, "truncated", name)
    path.write_bytes(whole + b"more")
    refusal(folder, "4 bytes after its end")


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
def test_colmap_counts_are_not_believed(tmp_path: Path, name: str) -> None:
    folder = captures.colmap_bin(tmp_path / "a")
    path = folder / "sparse/0" / name
    path.write_bytes(struct.pack("<Q", 2**60) + path.read_bytes()[8:])
    refusal(folder, name, "truncated|at most")


@pytest.mark.parametrize(
    ("name", "cut", "word"),
    [
        ("cameras.txt", " 12.0", "SIMPLE_PINHOLE has 3 parameters, found 2"),
        ("images.txt", " 7 img_3.png", "line 9: 8 words, expected IMAGE_ID"),
        ("images.txt", " -1", "points come as X Y POINT3D_ID"),
        ("points3D.txt", " 16 59\n", None),
        ("points3D.txt", " 0.5 11 3 ", "expected POINT3D_ID"),
    ],
)
def test_colmap_text_truncated(tmp_path: Path, name: str, cut: str, word: str | None) -> None:
    folder = captures.colmap_txt(tmp_path / "a")
    path = folder / "sparse/0" / name
    text = path.read_text()
    path.write_text(text[: text.index(cut)])
    if word is None:
        assert read(folder).points is not None, "one observation fewer, and no way to tell"
    else:
        refusal(folder, word, name)


@pytest.mark.parametrize("name", ["cameras.txt", "images.txt", "points3D.txt"])
def test_colmap_text_that_ends_between_lines(tmp_path: Path, name: str) -> None:
    folder = captures.colmap_txt(tmp_path / "a")
    path = folder / "sparse/0" / name
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(lines[: -2 if name == "images.txt" else -1]))
    refusal(folder, "truncated: its first lines say", name)


@pytest.mark.parametrize(
    ("name", "old", "new", "word"),
    [
        ("cameras.txt", "SIMPLE_PINHOLE", "FOV", "FOV; supported are"),
        ("cameras.txt", "40.0", "0.0", "focal length 0"),
        ("cameras.txt", "40.0", "nan", "not all finite"),
        ("cameras.txt", "40.0", "forty", "line 2: could not convert"),
        ("cameras.txt", "32 24", "32 -24", "size 32x-24"),
        ("cameras.txt", "32 24", "48 24", "stated for 48x24, the image is 32x24"),
        ("cameras.txt", "7 SIMPLE", "8 SIMPLE", "refers to camera 7"),
        ("images.txt", "img_3.png", "../../../x.png", "leads out of the source folder"),
        ("images.txt", "11 ", "eleven ", "not a whole number"),
    ],
)
def test_colmap_with_impossible_content(tmp_path: Path, name: str, old: str, new: str, word: str) -> None:
    folder = captures.colmap_txt(tmp_path / "a")
    path = folder / "sparse/0" / name
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new, 1))
    refusal(folder, word)


def test_colmap_with_a_lens_that_is_not_supported(tmp_path: Path) -> None:
    folder = captures.colmap_bin(tmp_path / "a")
    path = folder / "sparse/0/cameras.bin"
    data = bytearray(path.read_bytes())
    data[12:16] = struct.pack("<i", 99)
    path.write_bytes(data)
    refusal(folder, "model number 99")


def test_a_quaternion_that_is_none(tmp_path: Path) -> None:
    folder = captures.colmap_bin(tmp_path / "a")
    path = folder / "sparse/0/images.bin"
    data = bytearray(path.read_bytes())
    data[12:44] = struct.pack("<4d", 0, 0, 0, 0)
    path.write_bytes(data)
    refusal(folder, "img_0.png: quaternion")


def test_sizes_of_another_aspect_are_refused_and_near_ones_taken(tmp_path: Path) -> None:
    assert WIDTH / HEIGHT == 4 / 3
    refusal(captures.nerfstudio(tmp_path / "a", w=400, h=225), "stated for 400x225, the image is 32x24, of another aspect")
    assert read(captures.nerfstudio(tmp_path / "b", w=400, h=301)).photos[0].camera.width == 32
