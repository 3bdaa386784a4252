"""Bad data sets get an error of one or two lines that names what is wrong and where; what can be got round is warned about."""

import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.errors import BadInput
from stages.formats import importers
from stages.formats.importers import llff, transforms
from stages.io.json_file import read_json
from tests.stages import captures
from tests.stages.captures import HEIGHT, WIDTH, Settings
from tests.stages.exports import read


def refusal(folder: Path, *named: str, **settings: Any) -> None:
    """That a source is refused with a message of at most two lines, which names all of `named`."""
    with pytest.raises(BadInput) as caught:
        read(folder, **settings)
    text = str(caught.value)
    assert text.count("\n") <= 1, text
    assert [name for name in named if name not in text] == [], text


def edit(folder: Path, change: Callable[[dict[str, Any]], Any], name: str = "transforms.json") -> Path:
    document = json.loads((folder / name).read_text())
    change(document)
    (folder / name).write_text(json.dumps(document))
    return folder


def test_folders_without_a_data_set(tmp_path: Path) -> None:
    refusal(tmp_path / "absent", "absent")
    refusal(tmp_path, "photographs")
    (tmp_path / "1.psd").write_bytes(b"x")
    refusal(tmp_path, "1 .psd")
    folder = captures.nerfstudio(tmp_path / "a")
    refusal(folder / "transforms.json", "transforms.json", "folder")
    for name in ("llff", "colmap"):
        with pytest.raises(BadInput, match="--as"):
            importers.IMPORTERS[name].read(folder, Settings())


# --- JSON


@pytest.mark.parametrize(
    ("text", "named"),
    [
        (b"{", ""),
        (b"[1, 2]", ""),
        (b'{"a": 1}', "`frames`"),
        (b'{"frames": []}', "frames"),
        (b'{"frames": [{"file_path": 7}]}', "frame 0"),
        (b'{"camera_angle_x": NaN, "frames": [{"file_path": "a"}]}', "NaN"),
        (b"[" * 100_000, "nested"),
        (b'{"frames": "\xff\xfe"}', ""),
    ],
)
def test_json_that_is_no_data_set(tmp_path: Path, text: bytes, named: str) -> None:
    (tmp_path / "transforms.json").write_bytes(text)
    refusal(tmp_path, named, "transforms.json")


def test_json_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = captures.nerfstudio(tmp_path / "a") / "transforms.json"
    monkeypatch.setattr(transforms, "MAX_FRAMES", 5)
    refusal(path.parent, "at most 5")
    with pytest.raises(BadInput, match="100 bytes"):
        read_json(path, "Repair it.", limit=100)


SHEAR = np.array([[1, 0.2, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
MATRICES: dict[str, Callable[[Any], Any]] = {
    "3x4": lambda m: m[:3],
    "ragged": lambda m: [m[0][:2], *m[1:]],
    "words": lambda m: [["a"] * 4] * 4,
    "huge": lambda m: [[1e999, 0, 0, 0], *m[1:]],
    "scaled": lambda m: (np.array(m) @ np.diag([2.5, 2.5, 2.5, 1])).tolist(),
    "sheared": lambda m: (np.array(m) @ SHEAR).tolist(),
    "stretched": lambda m: (np.array(m) @ np.diag([1, 1.01, 1, 1])).tolist(),
    "zero": lambda m: np.diag([0, 0, 0, 1]).tolist(),
    "left-handed": lambda m: (np.array(m) @ np.diag([1, 1, -1, 1])).tolist(),
    "transposed": lambda m: np.array(m).T.tolist(),
}


def test_matrices_are_rigid_motions_however_they_are_rounded(tmp_path: Path) -> None:
    for what, change in MATRICES.items():
        folder = captures.nerfstudio(tmp_path / what)
        refusal(edit(folder, lambda d, change=change: d["frames"][2].update(transform_matrix=change(d["frames"][2]["transform_matrix"]))), "transforms.json")
    refusal(edit(captures.nerfstudio(tmp_path / "none"), lambda d: d["frames"][1].pop("transform_matrix")), "frame 1", "`transform_matrix`")
    rounded = edit(captures.nerfstudio(tmp_path / "a"), lambda d: [f.update(transform_matrix=np.round(f["transform_matrix"], 3).tolist()) for f in d["frames"]])
    pose = read(rounded).photos[0].camera.world_from_camera
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"fl_x": 0}, "focal length 0"),
        ({"fl_y": -40.0}, "focal length -40"),
        ({"fl_x": "40"}, "fl_x"),
        ({"w": 32.5}, "32.5x24"),
        ({"w": 0}, "0x24"),
        ({"w": 64}, "64x24"),
        ({"camera_model": "EQUIRECTANGULAR"}, "EQUIRECTANGULAR"),
        ({"camera_model": "PINHOLE", "k1": 0.1}, "k1"),
        ({"k4": 0.1}, "k4"),
        ({"ftheta_p0": 0.1}, "ftheta_p0"),
        ({"train_filenames": "all"}, "train_filenames"),
    ],
)
def test_lenses(tmp_path: Path, change: dict[str, Any], named: str) -> None:
    refusal(captures.nerfstudio(tmp_path / "a", **({"camera_model": "OPENCV"} | change)), named)


def test_angles_of_view_and_no_focal_length(tmp_path: Path) -> None:
    for angle in (0.0, 3.2, -0.5):
        folder = captures.blender(tmp_path / str(angle))
        for name in ("transforms_train.json", "transforms_test.json"):
            edit(folder, lambda d, angle=angle: d.update(camera_angle_x=angle), name)
        refusal(folder, "camera_angle_x")
    refusal(edit(captures.nerfstudio(tmp_path / "a"), lambda d: [d.pop("fl_x"), d.pop("fl_y")]), "no focal length")
    assert WIDTH / HEIGHT == 4 / 3
    refusal(captures.nerfstudio(tmp_path / "aspect", w=400, h=225), "400x225", "32x24")
    assert read(captures.nerfstudio(tmp_path / "near", w=400, h=301)).photos[0].camera.width == 32


def test_files_missing_on_disk(tmp_path: Path) -> None:
    frames = captures.frames(captures.cameras())
    frames[0]["mask_path"] = "masks/absent.png"
    folder = captures.nerfstudio(tmp_path / "a", frames=frames, ply_file_path="cloud.ply")
    (folder / "images/img_1.png").unlink()
    (folder / "images/img_4.png").write_bytes(b"not an image")
    capture = read(folder)
    assert [photo.camera.name for photo in capture.photos] == [f"images/img_{i}.png" for i in (0, 2, 3, 5)]
    assert [name for name, _ in capture.rejected] == ["images/img_1.png", "images/img_4.png"]
    warnings = " ".join(capture.warnings)
    assert all(name in warnings for name in ("images/img_1.png", "img_4.png", "1 listed masks", "cloud.ply"))
    (folder / "cloud.ply").write_text("nothing")
    assert "not readable as a PLY" in " ".join(read(folder).warnings)
    refusal(folder, "1 of 6", "--strict", strict=True)
    for index in (0, 2):
        (folder / f"images/img_{index}.png").unlink()
    refusal(folder, "3 of 6")


# --- paths that lead outside


@pytest.mark.parametrize("listed", ["../outside/x.png", "images/../../outside/x.png", "{outside}/x.png"])
def test_paths_that_leave_the_source(tmp_path: Path, listed: str) -> None:
    captures.write_picture(tmp_path / "outside/x.png", captures.picture())
    folder = captures.nerfstudio(tmp_path / "a")
    edit(folder, lambda d: d["frames"][0].update(file_path=listed.format(outside=tmp_path / "outside")))
    refusal(folder, "--allow-outside")
    assert len(read(folder, allow_outside=True).photos) == 6
    with pytest.raises(BadInput):
        importers.files(folder, Settings())


# --- LLFF


def test_poses_bounds_that_are_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = captures.llff(tmp_path / "a")
    path = folder / "poses_bounds.npy"
    whole = path.read_bytes()
    rows = captures.llff_rows(captures.cameras())
    for array in (np.zeros((6, 14)), np.zeros(17), np.array([["a"] * 17] * 6), np.full((6, 17), np.nan), np.zeros((6, 17)), rows[:5]):
        np.save(path, array)
        refusal(folder, "images_4" if len(array) == 5 else "poses_bounds.npy")
    np.save(path, np.array([{"a": 1}] * 17, dtype=object), allow_pickle=True)
    refusal(folder, "poses_bounds.npy")
    for column, value, named in [(4, 95.5, "whole pixels"), (14, 0.0, "focal length 0"), (15, -1.0, "near"), (16, 1.0, "near")]:
        changed = rows.copy()
        changed[2, column] = value
        np.save(path, changed)
        refusal(folder, "row 2", named)
    for keep in (0, 5, 100, 500):
        path.write_bytes(whole[:keep])
        refusal(folder, "poses_bounds.npy")
    path.write_bytes(whole)
    monkeypatch.setattr(llff, "MAX_FRAMES", -30)  # the header alone has room for 30
    refusal(folder, "-30 poses")
    monkeypatch.undo()
    refusal(folder, "images_4", llff_factor=2)
    (folder / "images_4").rename(folder / "pictures")
    refusal(folder, "images")


# --- COLMAP


def test_colmap_names_absent_images(tmp_path: Path) -> None:
    folder = captures.colmap_bin(tmp_path / "a")
    (folder / "images/img_0.png").unlink()
    capture = read(folder)
    assert len(capture.photos) == 5
    assert any("1 of 6" in warning and "img_0.png" in warning for warning in capture.warnings)
    assert capture.points.tracks[0] == (0, 1, 2, 3, 4)
    refusal(folder, "--strict", strict=True)
    for path in (folder / "images").iterdir():
        path.unlink()
    refusal(folder, "6 of 6", "`images`")


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
def test_colmap_binary_truncated_anywhere(tmp_path: Path, name: str) -> None:
    folder = captures.colmap_bin(tmp_path / "a")
    path = folder / "sparse/0" / name
    whole = path.read_bytes()
    for keep in sorted({*range(0, min(len(whole), 120), 7), *range(120, len(whole), 1511), len(whole) - 1}):
        path.write_bytes(whole[:keep])
        refusal(folder, name)
    path.write_bytes(whole + b"more")
    refusal(folder, "4 bytes")
    path.write_bytes(struct.pack("<Q", 2**60) + whole[8:])
    refusal(folder, name)


@pytest.mark.parametrize(("at", "data", "file", "named"), [(12, struct.pack("<i", 99), "cameras.bin", "99"), (12, bytes(32), "images.bin", "img_0.png")])
def test_colmap_binary_with_impossible_content(tmp_path: Path, at: int, data: bytes, file: str, named: str) -> None:
    """A lens that is not supported; a quaternion of zeros."""
    folder = captures.colmap_bin(tmp_path / "a")
    path = folder / "sparse/0" / file
    whole = path.read_bytes()
    path.write_bytes(whole[:at] + data + whole[at + len(data) :])
    refusal(folder, named)


@pytest.mark.parametrize(
    ("name", "cut", "named"),
    [
        ("cameras.txt", " 12.0", "SIMPLE_PINHOLE"),
        ("images.txt", " 7 img_3.png", "line 9"),
        ("images.txt", " -1", "POINT3D_ID"),
        ("points3D.txt", " 16 59\n", None),
        ("points3D.txt", " 0.5 11 3 ", "POINT3D_ID"),
    ],
)
def test_colmap_text_truncated(tmp_path: Path, name: str, cut: str, named: str | None) -> None:
    folder = captures.colmap_txt(tmp_path / "a")
    path = folder / "sparse/0" / name
    text = path.read_text()
    path.write_text(text[: text.index(cut)])
    if named is None:
        assert read(folder).points is not None, "one observation fewer, and no way to tell"
    else:
        refusal(folder, named, name)
    lines = text.splitlines(keepends=True)
    path.write_text("".join(lines[: -2 if name == "images.txt" else -1]))
    refusal(folder, "truncated", name)


@pytest.mark.parametrize(
    ("name", "old", "new", "named"),
    [
        ("cameras.txt", "SIMPLE_PINHOLE", "FOV", "FOV"),
        ("cameras.txt", "40.0", "0.0", "focal length 0"),
        ("cameras.txt", "40.0", "nan", "finite"),
        ("cameras.txt", "40.0", "1e300", "beyond"),
        ("cameras.txt", "40.0", "-1.0", "focal length -1"),
        ("cameras.txt", "40.0", "forty", "line 2"),
        ("cameras.txt", "32 24", "32 -24", "32x-24"),
        ("cameras.txt", "32 24", "48 24", "48x24"),
        ("cameras.txt", "7 SIMPLE", "8 SIMPLE", "camera 7"),
        ("images.txt", "img_3.png", "../../../x.png", "--allow-outside"),
        ("images.txt", "11 ", "eleven ", "not a whole number"),
        ("images.txt", " 7 img_3.png", "e300 7 img_3.png", "beyond"),
    ],
)
def test_colmap_text_with_impossible_content(tmp_path: Path, name: str, old: str, new: str, named: str) -> None:
    folder = captures.colmap_txt(tmp_path / "a")
    path = folder / "sparse/0" / name
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    refusal(folder, named)
