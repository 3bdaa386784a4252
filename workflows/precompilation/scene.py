"""A patterned ball before patterned surroundings, as a COLMAP text model: the smallest scene that every stage makes something of."""

from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

VIEWS, SIZE, FOCAL = 8, 64, 80.0
RADIUS, DISTANCE, HEIGHT = 1.0, 4.0, 0.4
POINTS = 200


def write_scene(folder: Path) -> None:
    """Write its images and its model into an empty folder."""
    (folder / "images").mkdir(parents=True)
    on_ball = np.random.default_rng(0).normal(size=(POINTS, 3))
    on_ball *= RADIUS / np.linalg.norm(on_ball, axis=1, keepdims=True)
    images: list[str] = []
    tracks: list[list[str]] = [[] for _ in on_ball]
    for view in range(VIEWS):
        camera_from_world, position = _camera(2 * np.pi * view / VIEWS)
        Image.fromarray(_picture(camera_from_world, position)).save(folder / "images" / f"{view}.png")
        seen = np.flatnonzero(((position - on_ball) * on_ball).sum(1) > 0)  # points on the side that the camera sees
        at = (on_ball[seen] - position) @ camera_from_world.T
        pixels = FOCAL * at[:, :2] / at[:, 2:] + SIZE / 2
        for place, point in enumerate(seen):
            tracks[point].append(f"{view + 1} {place}")
        x, y, z, w = Rotation.from_matrix(camera_from_world).as_quat()
        numbers = (w, x, y, z, *(-camera_from_world @ position))
        images.append(f"{view + 1} {' '.join(f'{number:.9f}' for number in numbers)} 1 {view}.png")
        images.append(" ".join(f"{x:.3f} {y:.3f} {point + 1}" for (x, y), point in zip(pixels, seen, strict=True)))
    points = [f"{number + 1} {x:.6f} {y:.6f} {z:.6f} 128 128 128 0.5 {' '.join(tracks[number])}" for number, (x, y, z) in enumerate(on_ball)]
    (folder / "cameras.txt").write_text(f"1 PINHOLE {SIZE} {SIZE} {FOCAL} {FOCAL} {SIZE / 2} {SIZE / 2}\n", encoding="utf-8")
    (folder / "images.txt").write_text("\n".join(images) + "\n", encoding="utf-8")
    (folder / "points3D.txt").write_text("\n".join(points) + "\n", encoding="utf-8")


def _camera(angle: float) -> tuple[np.ndarray, np.ndarray]:
    """(camera_from_world (3, 3) with x right, y down, z forward; position (3,)) on a ring round the ball."""
    position = np.array([np.cos(angle), -HEIGHT, np.sin(angle)])
    position *= DISTANCE / np.linalg.norm(position)
    forward = -position / DISTANCE
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward]), position


def _picture(camera_from_world: np.ndarray, position: np.ndarray) -> np.ndarray:
    """(SIZE, SIZE, 3), 8 bits."""
    steps = (np.arange(SIZE) + 0.5 - SIZE / 2) / FOCAL
    x, y = np.meshgrid(steps, steps)
    rays = np.stack([x, y, np.ones_like(x)], -1) @ camera_from_world
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    along = -(rays @ position)
    inside = along**2 - position @ position + RADIUS**2
    surface = position + (along - np.sqrt(np.maximum(inside, 0)))[..., None] * rays
    colour = np.where(inside[..., None] > 0, 0.5 + 0.45 * np.sin(7 * surface), 0.5 + 0.3 * np.sin(5 * rays))
    return np.round(255 * colour).astype(np.uint8)
