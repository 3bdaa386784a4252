"""Every importer: the same cameras written in each format give the same rays; real data sets read right."""

import json
from pathlib import Path

import numpy as np
import pytest

from stages.formats import importers
from stages.formats.importers.description import describe_source
from tests.stages import captures
from tests.stages.captures import HEIGHT, LENSES, SHARED, WIDTH, WRITERS, Settings, assert_same_rays
from tests.stages.exports import read


@pytest.mark.parametrize("how", WRITERS)
def test_every_format_gives_the_same_rays(how: str, tmp_path: Path) -> None:
    name, write = WRITERS[how]
    folder = write(tmp_path / "source")
    assert importers.candidates(folder)[0] == name
    assert [other for other in importers.candidates(folder) if other != "photographs"] == [name]
    capture = read(folder)
    assert capture.kind == name
    assert not capture.warnings
    assert not capture.rejected
    assert_same_rays(capture, captures.cameras())
    assert all(photo.image.is_file() and photo.image == folder / photo.camera.name for photo in capture.photos)
    listed = importers.files(folder, Settings())
    assert {photo.image for photo in capture.photos} < set(listed)
    assert len(listed) - len(capture.photos) == {"blender": 2, "colmap": 3}.get(name, 1)
    described = describe_source(folder)
    json.dumps(described, allow_nan=False)
    assert described["count"] == 6
    assert described["format"] == name


@pytest.mark.parametrize("model", LENSES)
@pytest.mark.parametrize("write", [captures.colmap_bin, captures.colmap_txt])
def test_colmap_lenses(model: str, write: object, tmp_path: Path) -> None:
    made = captures.cameras(model=model, params=LENSES[model])
    capture = read(write(tmp_path / "a", made))  # type: ignore[operator]
    assert_same_rays(capture, made)
    assert capture.photos[0].camera.params == LENSES[model]
    assert capture.points.tracks[0] == tuple(range(6))
    assert capture.points.rgb[0].tolist() == [200, 100, 50]
    assert capture.reprojection_error == pytest.approx(0.5)


@pytest.mark.parametrize("model", LENSES)
def test_nerfstudio_lenses(model: str, tmp_path: Path) -> None:
    made = captures.cameras(model=model, params=LENSES[model])
    k = made[0].intrinsics
    intrinsics = {"fl_x": k["fx"], "fl_y": k["fy"]} | {name: k[name] for name in ("cx", "cy", "k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")}
    assert_same_rays(read(captures.nerfstudio(tmp_path / "top", made, camera_model=model, **intrinsics)), made)
    per_frame = [frame | intrinsics | {"camera_model": model} for frame in captures.frames(made)]
    assert_same_rays(read(captures.nerfstudio(tmp_path / "frames", made, fl_x=1.0, fl_y=1.0, frames=per_frame)), made)


def test_a_model_written_by_colmap_with_rigs_and_frames(tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    folder = captures.colmap_bin(tmp_path / "a")
    model = pycolmap.Reconstruction(folder / "sparse/0")
    for write, suffix in ((model.write_text, "txt"), (model.write_binary, "bin")):
        other = tmp_path / suffix
        (other / "sparse/0").mkdir(parents=True)
        (other / "images").symlink_to(folder / "images")
        write(other / "sparse/0")
        assert (other / "sparse/0" / f"frames.{suffix}").is_file()
        capture = read(other, allow_outside=True)
        assert_same_rays(capture, captures.cameras())
        np.testing.assert_allclose(np.sort(capture.points.xyz, 0), np.sort(captures.sparse_points(), 0))


def test_nerfstudio_extras(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    made = captures.cameras()
    frames = captures.frames(made)
    frames[0] |= {"mask_path": "masks/img_0.png", "depth_file_path": "depth/img_0.png"}
    folder = tmp_path / "a"
    applied = [[1, 0, 0, 5], [0, 0, 1, 0], [0, -1, 0, 0]]
    names = {"train_filenames": [f"./images/img_{i}.png" for i in range(4)], "val_filenames": ["images/img_4.png"], "test_filenames": ["images/img_5.png"]}
    captures.nerfstudio(folder, frames=frames, applied_transform=applied, ply_file_path="cloud.ply", **names)
    captures.write_picture(folder / "masks/img_0.png", np.zeros((HEIGHT, WIDTH), np.uint8))
    points = captures.sparse_points(20)
    trimesh.PointCloud(points, np.full((20, 4), 90, np.uint8)).export(folder / "cloud.ply")
    capture = read(folder)
    assert_same_rays(capture, made)  # the frame is that of the matrices as they stand
    assert capture.facts["applied_transform"] == applied
    assert capture.metric
    assert [photo.split for photo in capture.photos] == ["train"] * 4 + ["val", "test"]
    assert capture.photos[0].mask == folder / "masks/img_0.png"
    assert capture.photos[0].mask_ignore == "black"
    np.testing.assert_allclose(capture.points.xyz, points, atol=1e-6)
    assert {folder / "cloud.ply", folder / "masks/img_0.png"} < set(importers.files(folder, Settings()))


def test_instant_ngp_extras(tmp_path: Path) -> None:
    made = captures.cameras()
    frames = captures.frames(made)
    # The sensor is read while the camera turns: the middle counts.
    turn = np.array([[np.cos(0.1), -np.sin(0.1), 0, 0], [np.sin(0.1), np.cos(0.1), 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    matrix = np.array(frames[0].pop("transform_matrix"))
    frames[0] |= {"transform_matrix_start": (matrix @ turn).tolist(), "transform_matrix_end": (matrix @ turn.T).tolist()}
    folder = captures.instant_ngp(tmp_path / "a", frames=frames, k1=-0.1)
    captures.write_picture(folder / "images/dynamic_mask_img_1.png", np.zeros((HEIGHT, WIDTH), np.uint8))
    capture = read(folder)
    assert_same_rays(capture, captures.cameras(model="OPENCV", params=(40.0, 40.0, 16.0, 12.0, -0.1, 0, 0, 0)))
    assert capture.photos[1].mask == folder / "images/dynamic_mask_img_1.png"
    assert capture.photos[1].mask_ignore == "white"
    assert any("rolling shutter" in warning for warning in capture.warnings)
    # scale 0.25, offset (0.5, 0.5, 0.75): x -> 0.25 x + offset lies in the unit cube
    assert capture.bounds is not None
    np.testing.assert_allclose(capture.bounds, [[-2, -2, -3], [2, 2, 1]])


def test_llff_takes_the_largest_images_and_scales_the_focal_length(tmp_path: Path) -> None:
    folder = captures.llff(tmp_path / "a")
    names = [camera.name for camera in captures.cameras()]
    for seed, name in enumerate(names):
        captures.write_picture(folder / "images_2" / name, captures.picture(seed, 2 * WIDTH, 2 * HEIGHT))
    capture = read(folder)
    assert capture.facts["image_folder"] == "images_2"
    assert capture.photos[0].camera.params == (80.0, 32.0, 24.0)
    assert (capture.photos[0].near, capture.photos[0].far) == (2.0, 7.0)
    assert_same_rays(read(folder, llff_factor=4), captures.cameras())


def test_images_of_another_size_scale_the_intrinsics(tmp_path: Path) -> None:
    folder = captures.nerfstudio(tmp_path / "a", w=129, h=97, fl_x=161.25, fl_y=161.6666666667, cx=64.5, cy=48.5)  # 4 times, an odd pixel more
    capture = read(folder)
    assert_same_rays(capture, captures.cameras())
    assert any("not of the stated size" in warning for warning in capture.warnings)


def shared(name: str) -> Path:
    folder = SHARED / name
    if not folder.is_dir():
        pytest.skip(f"{folder} is not there")
    return folder


def test_fern() -> None:
    capture = read(shared("fern_8"))
    assert capture.kind == "llff"
    assert len(capture.photos) == 20
    camera = capture.photos[0].camera
    assert (camera.width, camera.height) == (504, 378)
    assert camera.params == pytest.approx((3260.52633 / 8, 252, 189))
    directions = np.array([photo.camera.forward for photo in capture.photos])
    assert (directions @ directions.mean(0)).min() > 0.95, "forward facing"
    assert (np.array([photo.camera.up for photo in capture.photos]) @ camera.up).min() > 0.95
