"""Hundreds of photographs of a textured room, with their true cameras: a set for structure from motion, rendered in a fraction of a second each.

    python -m benchmarks.scenes.photographs FOLDER [--count 300] [--width 1000] [--seed 0]

Boxes and balls on the floor of a room, all with textures of noise, shapes and letters; three walks round them at different heights. A lens with radial
distortion (SIMPLE_RADIAL, k1 -0.04), noise of 2 levels, exposures that differ by 4 %, JPEG of quality 93, no EXIF data. FOLDER/transforms.json has the true
cameras, as `benchmarks.poses --truth` takes them. The same arguments give the same photographs.
"""

import argparse
import json
from pathlib import Path

import cv2
import numba
import numpy as np

from efficientnerf.geometry.cameras import Camera, opengl_from_pose, rays
from tests.poses import looking_at

TEXTURES, SIDE = 64, 1024  # textures, texels
ROOM = 6.0  # m from the middle to the walls
TEXELS = 230.0  # a metre
FOCAL, RADIAL = 0.9, -0.04  # over the width; SIMPLE_RADIAL
NOISE, EXPOSURE, QUALITY = 2.0, 0.04, 93


def textures(rng: np.random.Generator) -> np.ndarray:
    """(T, SIDE, SIDE, 3) uint8: noise of several octaves in one hue, shapes and letters on it."""
    made = []
    for _ in range(TEXTURES):
        colour, value = rng.uniform(40, 200, 3), np.zeros((SIDE, SIDE, 3), np.float32)
        for octave in range(2, 10):
            grid = rng.normal(0, 1, (2**octave, 2**octave, 3 if octave < 5 else 1)).astype(np.float32)
            layer = cv2.resize(grid, (SIDE, SIDE), interpolation=cv2.INTER_CUBIC).reshape(SIDE, SIDE, -1)
            value += 34 * 0.86 ** (octave - 2) * layer
        picture = np.ascontiguousarray(np.clip(colour + value, 0, 255).astype(np.uint8))
        for _ in range(int(rng.integers(15, 60))):
            at, tint = rng.integers(0, SIDE, 2), tuple(int(v) for v in rng.integers(0, 256, 3))
            if rng.random() < 0.5:
                cv2.fillPoly(picture, [(at + rng.integers(-50, 50, (int(rng.integers(3, 7)), 2))).astype(np.int32)], tint, cv2.LINE_AA)
            else:
                word = "".join(chr(int(c)) for c in rng.integers(65, 91, int(rng.integers(1, 6))))
                cv2.putText(picture, word, (int(at[0]), int(at[1])), cv2.FONT_HERSHEY_SIMPLEX, float(rng.uniform(0.5, 2.0)), tint, 2, cv2.LINE_AA)
        made.append(picture)
    return np.stack(made)


def boxes_and_balls(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """boxes (M, 9): middle, half sides, cosine and sine of the yaw, number; balls (N, 5): middle, radius, number. The number chooses the textures."""
    boxes, balls = [], []
    for n in range(10):
        angle, distance, half, yaw = n * 2.4 + rng.uniform(-0.3, 0.3), 0.25 + 0.13 * n, rng.uniform(0.12, 0.34, 3), rng.uniform(0, np.pi)
        boxes.append([distance * np.cos(angle), distance * np.sin(angle), half[2], *half, np.cos(yaw), np.sin(yaw), n + 1])
    for n in range(5):
        angle, distance, radius = n * 2.4 + 1.2, 0.8 + 0.25 * n, rng.uniform(0.12, 0.25)
        balls.append([distance * np.cos(angle), distance * np.sin(angle), radius, radius, n + 20])
    return np.array(boxes, np.float64), np.array(balls, np.float64)


@numba.njit
def _crossed(o: float, d: float, half: float) -> tuple[float, float]:
    """Distances along a ray to the two planes at -half and half, the nearer first."""
    if abs(d) < 1e-12:
        return (-1e30, 1e30) if abs(o) <= half else (1e30, -1e30)
    a, b = (-half - o) / d, (half - o) / d
    return (a, b) if a < b else (b, a)


@numba.njit
def _box(ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, hx: float, hy: float, hz: float) -> tuple[float, int, float, int]:
    """Distances along a ray to where it enters an axis-aligned box round the origin and leaves it, each with the axis of the face."""
    near, far, first, last = -1e30, 1e30, 0, 0
    for axis in range(3):
        o, d, half = (ox, dx, hx) if axis == 0 else ((oy, dy, hy) if axis == 1 else (oz, dz, hz))
        a, b = _crossed(o, d, half)
        if a > near:
            near, first = a, axis
        if b < far:
            far, last = b, axis
    return near, first, far, last


@numba.njit
def _coloured(u: float, v: float, number: int, shade: float, texture: np.ndarray, out: np.ndarray) -> None:
    """The colour at a place of a face (metres), whose textures depend on its number and on the tile."""
    x, y = u * TEXELS, v * TEXELS
    i, j = int(np.floor(x)), int(np.floor(y))
    fx, fy = x - i, y - j
    picture = texture[(number * 7 + (i // SIDE) * 5 + (j // SIDE) * 11) % len(texture)]
    i, j = i % SIDE, j % SIDE
    right, below = min(i + 1, SIDE - 1), min(j + 1, SIDE - 1)
    for k in range(3):
        high = picture[j, i, k] * (1 - fx) + picture[j, right, k] * fx
        low = picture[below, i, k] * (1 - fx) + picture[below, right, k] * fx
        out[k] = shade * (high * (1 - fy) + low * fy)


@numba.njit
def _render(pose: np.ndarray, directions: np.ndarray, boxes: np.ndarray, balls: np.ndarray, texture: np.ndarray, out: np.ndarray) -> None:
    """Colours (R, 3) of rays: pose (4, 4) of the camera in the world, directions (R, 3) unit vectors in its frame."""
    light = (0.40, 0.28, 0.87)
    ox, oy, oz = pose[0, 3], pose[1, 3], pose[2, 3]
    for r in range(len(directions)):
        x, y, z = directions[r]
        dx = pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z
        dy = pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z
        dz = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z
        _, _, best, axis = _box(ox, oy, oz - ROOM, dx, dy, dz, ROOM, ROOM, ROOM)
        x, y, z = ox + best * dx, oy + best * dy, oz + best * dz
        u, v = (y, z) if axis == 0 else ((z, x) if axis == 1 else (x, y))
        d = dx if axis == 0 else (dy if axis == 1 else dz)
        u, v, number, shade = u + 2 * ROOM, v + 2 * ROOM, 2 * axis + (1 if d > 0 else 0), 0.9
        for m in range(len(boxes)):
            b = boxes[m]
            px, py, pz, c, s = ox - b[0], oy - b[1], oz - b[2], b[6], b[7]
            along = px * dx + py * dy + pz * dz
            if along > 0 or px * px + py * py + pz * pz - along * along > b[3] * b[3] + b[4] * b[4] + b[5] * b[5]:
                continue  # the camera is outside of its ball
            px, py, qx, qy = c * px + s * py, c * py - s * px, c * dx + s * dy, c * dy - s * dx
            t, met, far, _ = _box(px, py, pz, qx, qy, dz, b[3], b[4], b[5])
            if t < far and 1e-6 < t < best:
                best = t
                hx, hy, hz = px + t * qx, py + t * qy, pz + t * dz
                u, v = (hy, hz) if met == 0 else ((hz, hx) if met == 1 else (hx, hy))
                d = qx if met == 0 else (qy if met == 1 else dz)
                number = int(b[8]) * 6 + 2 * met + (1 if d > 0 else 0)
                u, v = u + 1.0 + 0.37 * (number % 5), v + 1.0 + 0.29 * (number % 7)
                towards = light[0] * c + light[1] * s if met == 0 else (light[1] * c - light[0] * s if met == 1 else light[2])
                shade = 0.55 + 0.45 * max(0.0, -towards if d > 0 else towards)
        for m in range(len(balls)):
            b = balls[m]
            px, py, pz = ox - b[0], oy - b[1], oz - b[2]
            half = px * dx + py * dy + pz * dz
            inner = half * half - (px * px + py * py + pz * pz - b[3] * b[3])
            if inner > 0 and 1e-6 < -half - np.sqrt(inner) < best:
                best = -half - np.sqrt(inner)
                hx, hy, hz = (px + best * dx) / b[3], (py + best * dy) / b[3], (pz + best * dz) / b[3]
                u, v, number = b[3] * (np.arctan2(hy, hx) + 4.0), b[3] * (np.arcsin(max(-1.0, min(1.0, hz))) + 4.0), int(b[4]) * 6
                shade = 0.55 + 0.45 * max(0.0, hx * light[0] + hy * light[1] + hz * light[2])
        _coloured(u, v, number, shade, texture, out[r])


def walk(count: int, width: int, rng: np.random.Generator) -> list[Camera]:
    """Cameras on three rounds at different heights, in the order of walking, that look about the middle."""
    cameras = []
    for n in range(count):
        along = 3 * n / count
        ring, angle = min(2, int(along)), 2 * np.pi * along
        radius, height = (3.0, 2.6, 2.2)[ring] + rng.normal(0, 0.08), (0.6, 1.2, 1.9)[ring] + rng.normal(0, 0.05)
        centre = np.array([radius * np.cos(angle), radius * np.sin(angle), height])
        target = np.array([*rng.normal(0, 0.15, 2), 0.3 + rng.normal(0, 0.05)])
        pose = looking_at(centre, target, [rng.normal(0, 0.02), rng.normal(0, 0.02), 1.0])
        lens = (FOCAL * width, width / 2, 3 * width / 8, RADIAL)
        cameras.append(Camera(f"photo_{n:04d}.jpg", width, 3 * width // 4, "SIMPLE_RADIAL", lens, pose))
    return cameras


def write_photographs(folder: Path, count: int, width: int, seed: int, supersample: int = 2) -> None:
    """The photographs and transforms.json."""
    folder.mkdir(parents=True, exist_ok=True)
    scene = np.random.default_rng(seed)
    texture, (boxes, balls), cameras = textures(scene), boxes_and_balls(scene), walk(count, width, scene)
    y, x = (np.mgrid[: cameras[0].height * supersample, : width * supersample] + 0.5) / supersample
    at_rest = Camera("", width, cameras[0].height, cameras[0].model, cameras[0].params, np.eye(4))
    directions = rays(at_rest, np.stack([x, y], -1).reshape(-1, 2))[1]  # (R, 3)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    colours = np.empty_like(directions)
    for number, camera in enumerate(cameras):
        if (folder / camera.name).exists():
            continue
        rng = np.random.default_rng([seed, number])
        _render(camera.world_from_camera, directions, boxes, balls, texture, colours)
        picture = colours.reshape(camera.height, supersample, width, supersample, 3).mean((1, 3))  # (h, w, 3)
        picture = picture * rng.uniform(1 - EXPOSURE, 1 + EXPOSURE) + rng.normal(0, NOISE, picture.shape)
        cv2.imwrite(str(folder / camera.name), np.clip(picture + 0.5, 0, 255).astype(np.uint8)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    frames = [{"file_path": camera.name, "transform_matrix": opengl_from_pose(camera.world_from_camera).tolist()} for camera in cameras]
    (folder / "transforms.json").write_text(json.dumps({"frames": frames}, indent=1) + "\n", encoding="utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--count", type=int, default=300)
    parser.add_argument("--width", type=int, default=1000, help="pixels; three quarters as high")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    write_photographs(given.folder, given.count, given.width, given.seed)


if __name__ == "__main__":
    main()
