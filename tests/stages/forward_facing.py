"""Captures of cameras that all look the same way."""

import dataclasses
from pathlib import Path

import numpy as np

from efficientnerf.capture.forward_facing import detect_forward_facing
from efficientnerf.geometry.cameras import Camera, rays
from stages.io.png import write_png
from stages.io.scene import Scene, View, save
from tests.efficientnerf.balls import BOUNDS
from tests.stages.balls import ORBIT, SIMILARITY


def looking(centre: np.ndarray, target: np.ndarray, *, roll: float = 0.0, focal: float = 1.2, name: str = "a") -> Camera:
    """A camera of 100 x 75 pixels at `centre` that looks at `target`, level in a world with z up but for `roll` radians."""
    forward = (target - centre) / np.linalg.norm(target - centre)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    turned = np.cos(roll) * right + np.sin(roll) * down
    pose = np.eye(4)
    pose[:3] = np.stack([turned, np.cross(forward, turned), forward, centre], -1)
    return Camera(name, 100, 75, "SIMPLE_PINHOLE", (100 * focal, 50.0, 37.5), pose)


def some_rotation(seed: int) -> np.ndarray:
    q = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    return q * np.sign(np.linalg.det(q))


def forward_facing(side: int) -> Scene:
    """A capture of nine cameras in a plane, pictures of `side` pixels."""
    cameras = [_resized(camera, side) for camera in row()]
    found = detect_forward_facing(cameras, depths(cameras))
    assert not isinstance(found, str), found
    views = tuple(View(f"images/{c.name}", None, "train", c, c, 3.0, 40.0) for c in cameras)
    return Scene("llff", views, BOUNDS, None, SIMILARITY, ORBIT, metric=False, space="ndc", forward=found)


def painted_wall(folder: Path) -> Path:
    """The poses artifact of a painted wall before nine cameras, the first of them a test view."""
    cameras = [_resized(camera, 32) for camera in row()]
    found = detect_forward_facing(cameras, depths(cameras))
    assert not isinstance(found, str), found
    (folder / "images").mkdir(parents=True)
    for camera in cameras:
        origins, directions = rays(camera)
        at = origins + directions * ((6.0 - origins[:, 1]) / directions[:, 1])[:, None]
        colour = 0.5 + 0.4 * np.sin(at[:, [0, 2, 0]] * (1.0, 1.5, 2.0))
        write_png(np.round(255 * colour).astype(np.uint8).reshape(camera.height, camera.width, 3), folder / "images" / camera.name)
    views = tuple(View(f"images/{c.name}", None, "test" if k == 0 else "train", c, c, 3.0, 40.0) for k, c in enumerate(cameras))
    save(Scene("llff", views, BOUNDS, None, SIMILARITY, ORBIT, metric=False, space="ndc", forward=found), folder)
    return folder


def _resized(camera, side: int):  # type: ignore[no-untyped-def]
    scale = side / camera.width
    height = round(camera.height * scale)
    return dataclasses.replace(camera, width=side, height=height, params=tuple(p * scale for p in camera.params))


NEAR, FAR = 3.0, 40.0


def row(count: int = 9, *, spread: float = 1.0, tilt: float = 0.1, focal: float = 1.2) -> list[Camera]:
    """Cameras in a plane about the origin that look along +y, each a little elsewhere."""
    rng = np.random.default_rng(0)
    made = []
    for k in range(count):
        centre = rng.uniform(-1, 1, 3) * [spread, 0.05 * spread, 0.5 * spread]
        aim = centre + [0, 5, 0] + rng.uniform(-1, 1, 3) * 5 * tilt
        made.append(looking(centre, aim, focal=focal, name=f"{k:03d}.png"))
    return made


def depths(cameras: list[Camera], near: float = NEAR, far: float = FAR) -> np.ndarray:
    return np.array([[near, far]] * len(cameras))
