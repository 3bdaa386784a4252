"""Cameras that a data set states: which of its files are believed, for which pixels, and through which lens."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from efficientnerf.geometry.cameras import Camera, rotated_clockwise
from stages.formats import importers
from stages.formats.importers import colmap_model
from tests.stages import captures
from tests.stages.captures import FOCAL, HEIGHT, WIDTH, Settings, assert_same_rays


def turned(folder: Path, names: list[str], orientations: list[int], width: int = WIDTH, height: int = HEIGHT) -> None:
    for index, (name, orientation) in enumerate(zip(names, orientations, strict=True)):
        exif = Image.Exif()
        exif[0x0112] = orientation
        captures.write_picture(folder / name, captures.picture(index, width, height), exif=exif)


def upright(cameras: list[Camera], orientations: list[int]) -> list[Camera]:
    found = []
    for camera, orientation in zip(cameras, orientations, strict=True):
        for _ in range({1: 0, 6: 1, 3: 2, 8: 3}[orientation]):
            camera = rotated_clockwise(camera)
        found.append(camera)
    return found


WRITERS = {"nerfstudio": captures.nerfstudio, "colmap": captures.colmap_bin, "llff": captures.llff}


@pytest.mark.parametrize("kind", WRITERS)
def test_one_photograph_on_its_side_tells_of_those_on_their_head(kind: str, tmp_path: Path) -> None:
    orientations = [1, 3, 6, 3, 1, 8]
    folder = WRITERS[kind](tmp_path)
    turned(folder / ("images_4" if kind == "llff" else "images"), [camera.name for camera in captures.cameras()], orientations)
    capture = importers.IMPORTERS[kind].read(folder, Settings())
    assert_same_rays(capture, upright(captures.cameras(), orientations))
    assert any("4 images (" in warning and "the cameras were rotated too" in warning for warning in capture.warnings)


def test_square_photographs_follow_the_others(tmp_path: Path) -> None:
    orientations = [6, 3, 6, 1, 8, 1]
    made = captures.cameras()
    folder = captures.nerfstudio(tmp_path, made)
    turned(folder / "images", [camera.name for camera in made], orientations)
    document: dict[str, Any] = {"camera_model": "OPENCV", "w": WIDTH, "h": HEIGHT, "fl_x": FOCAL, "frames": captures.frames(made)}
    square = Camera(made[0].name, HEIGHT, HEIGHT, "SIMPLE_PINHOLE", (FOCAL, HEIGHT / 2, HEIGHT / 2), made[0].world_from_camera)
    document["frames"][0] |= {"w": HEIGHT, "h": HEIGHT, "cx": HEIGHT / 2, "cy": HEIGHT / 2}
    captures.write_json(folder / "transforms.json", document)
    turned(folder / "images", [made[0].name], [6], HEIGHT, HEIGHT)
    capture = importers.IMPORTERS["nerfstudio"].read(folder, Settings())
    assert_same_rays(capture, upright([square, *made[1:]], orientations))


@pytest.mark.parametrize("orientations", [[1, 3, 1, 3, 1, 1], [3, 3, 3, 3, 3, 3]])
def test_without_proof_the_cameras_are_those_of_the_upright_images(orientations: list[int], tmp_path: Path) -> None:
    folder = captures.nerfstudio(tmp_path)
    turned(folder / "images", [camera.name for camera in captures.cameras()], orientations)
    capture = importers.IMPORTERS["nerfstudio"].read(folder, Settings())
    assert_same_rays(capture, captures.cameras())
    assert any("taken to be those of the rotated images" in warning for warning in capture.warnings)


# --- LLFF beside COLMAP


def both(folder: Path, made: list[Camera]) -> Path:
    captures.colmap_bin(folder, made)
    np.save(folder / "poses_bounds.npy", captures.llff_rows(made, scale=1))
    return folder


def test_a_model_beside_llff_is_read_where_the_capture_goes_round(tmp_path: Path) -> None:
    folder = both(tmp_path, captures.cameras(model="RADIAL", params=captures.LENSES["RADIAL"]))
    assert importers.candidates(folder)[:2] == ["colmap", "llff"]
    assert importers.candidates(folder, llff_factor=1)[:2] == ["llff", "colmap"]
    assert folder / "sparse/0/points3D.bin" in importers.files(folder, Settings())
    assert folder / "poses_bounds.npy" in importers.files(folder, Settings(llff_factor=1))


# --- lenses of COLMAP


def test_they_are_pycolmaps(tmp_path: Path) -> None:
    """That the mapping is what COLMAP means."""
    pycolmap = pytest.importorskip("pycolmap")
    points = np.random.default_rng(0).uniform((-1, -1, 0.5), (1, 1, 2), (50, 3))
    for model, params in {"SIMPLE_RADIAL_FISHEYE": (30.0, 16.0, 12.0, 0.05), "RADIAL_FISHEYE": (30.0, 16.0, 12.0, 0.05, -0.01)}.items():
        other, expanded = colmap_model.as_traced(model, params)
        pixels = [
            np.asarray(pycolmap.Camera(model=name, width=WIDTH, height=HEIGHT, params=values).img_from_cam(points))
            for name, values in ((model, params), (other, expanded))
        ]
        np.testing.assert_allclose(pixels[0], pixels[1], atol=1e-9)
