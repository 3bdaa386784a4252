"""One small capture, written in each format that can be read: six cameras round the origin, images of 32 x 24."""

import json
import os
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from efficientnerf.geometry.cameras import MODELS, Camera, opengl_from_pose, project, rays
from pipeline.stage import Job
from stages.io.capture import Capture
from stages.poses.settings import PosesSettings
from tests.poses import looking_at

WIDTH, HEIGHT, FOCAL = 32, 24, 40.0
SHARED = Path(__file__).parents[3] / "shared" / "data"


@dataclass(frozen=True)
class Settings:
    format: str = "auto"
    strict: bool = False
    allow_outside: bool = False
    llff_factor: int | str = "auto"


def poses_job(source: Path, folder: Path, report: Callable[[dict[str, Any]], object] = lambda event: None, **settings: Any) -> Job:
    """Of the poses stage for a source, which writes into a folder."""
    return Job(settings=PosesSettings(**settings), out=folder / "poses", work=folder / "work", source=source, stage="poses", report=report)


def cameras(count: int = 6, model: str = "SIMPLE_PINHOLE", params: tuple[float, ...] = (FOCAL, WIDTH / 2, HEIGHT / 2)) -> list[Camera]:
    """On a circle of radius 4, looking at the origin, z up."""
    made = []
    for index in range(count):
        angle = 2 * np.pi * index / count
        centre = np.array([4 * np.cos(angle), 4 * np.sin(angle), 1.5 + 0.1 * index])
        made.append(Camera(f"img_{index}.png", WIDTH, HEIGHT, model, params, looking_at(centre)))
    return made


def picture(seed: int = 0, width: int = WIDTH, height: int = HEIGHT, channels: int = 3) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, channels), np.uint8)


def write_picture(path: Path, pixels: np.ndarray, **options: Any) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path, **options)
    return path


def write_pictures(folder: Path, names: list[str], channels: int = 3) -> None:
    for seed, name in enumerate(names):
        write_picture(folder / name, picture(seed, channels=channels))


def frames(made: list[Camera], folder: str = "images", suffix: str = ".png") -> list[dict[str, Any]]:
    return [
        {"file_path": f"{folder}/{Path(camera.name).stem}{suffix}", "transform_matrix": opengl_from_pose(camera.world_from_camera).tolist()} for camera in made
    ]


def write_json(path: Path, document: Any) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(document))
    return path


def blender(folder: Path, made: list[Camera] | None = None, channels: int = 4) -> Path:
    made = made or cameras()
    angle = 2 * np.arctan(0.5 * WIDTH / FOCAL)
    for split, part in (("train", made[:4]), ("test", made[4:])):
        write_json(folder / f"transforms_{split}.json", {"camera_angle_x": angle, "frames": frames(part, f"./{split}", "")})
        write_pictures(folder / split, [camera.name for camera in part], channels)
    return folder


def nerfstudio(folder: Path, made: list[Camera] | None = None, **more: Any) -> Path:
    made = made or cameras()
    document = {"camera_model": "OPENCV", "w": WIDTH, "h": HEIGHT, "fl_x": FOCAL, "fl_y": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2}
    document |= {"k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0, "frames": frames(made)}
    write_json(folder / "transforms.json", document | more)
    write_pictures(folder / "images", [camera.name for camera in made])
    return folder


def instant_ngp(folder: Path, made: list[Camera] | None = None, **more: Any) -> Path:
    made = made or cameras()
    angles = {"camera_angle_x": 2 * np.arctan(0.5 * WIDTH / FOCAL), "camera_angle_y": 2 * np.arctan(0.5 * HEIGHT / FOCAL)}
    document = angles | {"w": WIDTH, "h": HEIGHT, "aabb_scale": 4, "scale": 0.25, "offset": [0.5, 0.5, 0.75], "frames": frames(made, "./images")}
    write_json(folder / "transforms.json", document | more)
    write_pictures(folder / "images", [camera.name for camera in made])
    return folder


def llff_rows(made: list[Camera], scale: int = 4) -> np.ndarray:
    rows = []
    for camera in made:
        right, down, forward = camera.world_from_camera[:3, :3].T
        size = np.array([HEIGHT, WIDTH, FOCAL]) * scale
        rows.append(np.concatenate([np.stack([down, right, -forward, camera.centre, size], -1).ravel(), [2.0, 7.0]]))
    return np.array(rows)


def llff(folder: Path, made: list[Camera] | None = None) -> Path:
    made = made or cameras()
    write_pictures(folder / "images_4", [camera.name for camera in made])
    np.save(folder / "poses_bounds.npy", llff_rows(made))
    return folder


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """w x y z: the eigenvector of Bar-Itzhack's matrix."""
    r = rotation
    matrix = np.array(
        [
            [r[0, 0] + r[1, 1] + r[2, 2], r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]],
            [r[2, 1] - r[1, 2], r[0, 0] - r[1, 1] - r[2, 2], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0]],
            [r[0, 2] - r[2, 0], r[0, 1] + r[1, 0], r[1, 1] - r[0, 0] - r[2, 2], r[1, 2] + r[2, 1]],
            [r[1, 0] - r[0, 1], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], r[2, 2] - r[0, 0] - r[1, 1]],
        ]
    )
    return np.linalg.eigh(matrix)[1][:, -1]


def colmap_pose(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    inverse = np.linalg.inv(camera.world_from_camera)
    return quaternion(inverse[:3, :3]), inverse[:3, 3]


def sparse_points(count: int = 60) -> np.ndarray:
    return np.random.default_rng(5).uniform(-0.8, 0.8, (count, 3))


_NUMBERS = {"SIMPLE_PINHOLE": 0, "PINHOLE": 1, "SIMPLE_RADIAL": 2, "RADIAL": 3, "OPENCV": 4, "OPENCV_FISHEYE": 5, "FULL_OPENCV": 6}


def colmap_bin(folder: Path, made: list[Camera] | None = None, place: str = "sparse/0") -> Path:
    made = made or cameras()
    model = folder / place
    model.mkdir(parents=True)
    lens, points = made[0], sparse_points()
    head = struct.pack("<QIiQQ", 1, 7, _NUMBERS[lens.model], lens.width, lens.height)
    (model / "cameras.bin").write_bytes(head + struct.pack(f"<{len(lens.params)}d", *lens.params))
    images = struct.pack("<Q", len(made))
    for number, camera in enumerate(made, 11):
        wxyz, translation = colmap_pose(camera)
        images += struct.pack("<I7dI", number, *wxyz, *translation, 7) + os.fsencode(camera.name) + b"\0"
        images += struct.pack("<Q", len(points))
        images += b"".join(struct.pack("<ddQ", *xy, index) for index, xy in enumerate(project(camera, points)[0]))
    (model / "images.bin").write_bytes(images)
    data = struct.pack("<Q", len(points))
    for index, xyz in enumerate(points):
        track = [number for camera in range(len(made)) for number in (camera + 11, index)]
        data += struct.pack("<Q3d3BdQ", index, *xyz, 200, 100, 50, 0.5, len(made)) + struct.pack(f"<{len(track)}I", *track)
    (model / "points3D.bin").write_bytes(data)
    write_pictures(folder / "images", [camera.name for camera in made])
    return folder


def colmap_txt(folder: Path, made: list[Camera] | None = None, place: str = "sparse/0") -> Path:
    made = made or cameras()
    model = folder / place
    model.mkdir(parents=True)
    lens, points = made[0], sparse_points()
    (model / "cameras.txt").write_text(f"# Number of cameras: 1\n7 {lens.model} {lens.width} {lens.height} {' '.join(map(repr, lens.params))}\n")
    lines = ["# Image list", f"# Number of images: {len(made)}, mean observations per image: 0"]
    for number, camera in enumerate(made, 11):
        wxyz, translation = colmap_pose(camera)
        lines.append(" ".join([str(number), *(repr(float(value)) for value in (*wxyz, *translation)), "7", camera.name]))
        lines.append("" if number % 2 else "1.5 2.5 -1")
    (model / "images.txt").write_bytes(os.fsencode("\n".join(lines) + "\n"))
    rows = [f"# Number of points: {len(points)}, mean track length: 6"]
    rows += [f"{i} {x!r} {y!r} {z!r} 200 100 50 0.5 " + " ".join(f"{c + 11} {i}" for c in range(len(made))) for i, (x, y, z) in enumerate(points.tolist())]
    (model / "points3D.txt").write_text("\n".join(rows) + "\n")
    write_pictures(folder / "images", [camera.name for camera in made])
    return folder


WRITERS: dict[str, tuple[str, Callable[..., Path]]] = {
    "blender": ("blender", blender),
    "nerfstudio": ("nerfstudio", nerfstudio),
    "instant-ngp": ("instant-ngp", instant_ngp),
    "llff": ("llff", llff),
    "colmap bin": ("colmap", colmap_bin),
    "colmap txt": ("colmap", colmap_txt),
}
assert set(_NUMBERS) == set(MODELS)


LENSES = {
    "PINHOLE": (40.0, 42.0, 15.0, 13.0),
    "SIMPLE_RADIAL": (40.0, 16.0, 12.0, -0.1),
    "RADIAL": (40.0, 16.0, 12.0, -0.1, 0.02),
    "OPENCV": (40.0, 41.0, 16.0, 12.0, -0.1, 0.02, 0.003, -0.002),
    "FULL_OPENCV": (40.0, 41.0, 16.0, 12.0, 0.1, 0.02, 0.003, -0.002, 0.01, 0.2, 0.01, 0.001),
    "OPENCV_FISHEYE": (30.0, 31.0, 16.0, 12.0, 0.05, -0.01, 0.001, 0.0),
}


def assert_same_rays(capture: Capture, truth: list[Camera]) -> None:
    by_name = {Path(photo.camera.name).name: photo for photo in capture.photos}
    assert set(by_name) == {camera.name for camera in truth}
    for camera in truth:
        photo = by_name[camera.name]
        assert (photo.camera.width, photo.camera.height) == (camera.width, camera.height)
        for found, expected in zip(rays(photo.camera), rays(camera), strict=True):
            np.testing.assert_allclose(found, expected, atol=1e-6)
