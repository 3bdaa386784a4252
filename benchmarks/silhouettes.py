"""Data sets with masks of the two kinds, from the still life and its true mesh: silhouettes of its objects, and masks over a moving thing.

    python -m benchmarks.silhouettes FOLDER

    FOLDER/photographs_masks   photographs, masks/ beside them: the objects without table and cloth (cameras by structure from motion)
    FOLDER/photographs_rgba    the same as PNG with alpha, whose colours are left below what is transparent
    FOLDER/photographs_cutouts the same, black there
    FOLDER/llff_masks          poses_bounds.npy, images/, masks/; undistorted, for LLFF knows no distortion
    FOLDER/json_masks          transforms.json with mask_path
    FOLDER/json_rgba           transforms.json, PNG with alpha
    FOLDER/json_moving         transforms.json with mask_path: a thing that is elsewhere in each photograph is left out
    FOLDER/photographs_moving  photographs, masks/ over the moving thing

Edges are soft: each pixel's mask is the share of it that objects cover.
"""

from __future__ import annotations

import argparse
import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import trimesh
from PIL import Image

from efficientnerf.geometry.cameras import Camera, pose_from_opengl, project
from stages.io.pictures import opened
from tests.still_life import true_mesh

ROOT = Path(__file__).resolve().parents[1]
PHOTOGRAPHS = ROOT / "examples" / "still_life"
SUPERSAMPLES = 8  # a pixel's side
SHIFT = 4  # binary digits of a subpixel that OpenCV draws with
SUPPORTS = 0.5  # half side from which a part is table or cloth


def cameras() -> dict[str, Camera]:
    """The true cameras of the photographs, by name."""
    data = json.loads((ROOT / "tests/data/still_life_cameras.json").read_text())
    params = (data["fl_x"], data["cx"], data["cy"], data["k1"])
    return {
        frame["file_path"]: Camera(frame["file_path"], data["w"], data["h"], "SIMPLE_RADIAL", params, pose_from_opengl(np.array(frame["transform_matrix"])))
        for frame in data["frames"]
    }


def objects() -> trimesh.Trimesh:
    """The true mesh without the table and the cloth, its two widest parts."""
    parts = true_mesh().split(only_watertight=False)
    return trimesh.util.concatenate([part for part in parts if part.extents[:2].max() < 2 * SUPPORTS])


def silhouette(mesh: trimesh.Trimesh, camera: Camera) -> np.ndarray:
    """(H, W) uint8, the share of each pixel that the mesh covers; nothing stands before it."""
    pixels, depth = project(camera, np.asarray(mesh.vertices, np.float64))
    corners = np.rint((pixels * SUPERSAMPLES - 0.5) * 2**SHIFT).astype(np.int32)[mesh.faces]  # (F, 3, 2)
    canvas = np.zeros((camera.height * SUPERSAMPLES, camera.width * SUPERSAMPLES), np.uint8)
    for triangle in corners[(depth[mesh.faces] > 0).all(1)]:
        cv2.fillConvexPoly(canvas, triangle, 255, shift=SHIFT)
    return np.asarray(cv2.resize(canvas, (camera.width, camera.height), interpolation=cv2.INTER_AREA))


def undistorted(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    """The image that a camera without distortion takes."""
    pinhole = Camera(camera.name, camera.width, camera.height, "SIMPLE_PINHOLE", camera.params[:3], np.eye(4))
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    f, cx, cy = pinhole.params
    points = np.stack([(x - cx) / f, (y - cy) / f, np.ones_like(x)], -1).reshape(-1, 3)
    straight = Camera(camera.name, camera.width, camera.height, camera.model, camera.params, np.eye(4))
    source = project(straight, points)[0].reshape(camera.height, camera.width, 2).astype(np.float32) - 0.5
    return np.asarray(cv2.remap(pixels, source[..., 0], source[..., 1], cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REPLICATE))


def with_moving_thing(pixels: np.ndarray, index: int) -> tuple[np.ndarray, np.ndarray]:
    """The photograph with a striped balloon that goes across the sequence, and a mask that is black over it."""
    height, width = pixels.shape[:2]
    centre = ((0.15 + 0.7 * (index * 0.381966 % 1)) * width, (0.35 + 0.3 * (index * 0.618034 % 1)) * height)
    y, x = np.mgrid[:height, :width]
    radius = np.hypot((x - centre[0]) / (0.11 * width), (y - centre[1]) / (0.19 * height))
    stripes = np.where(((x + y + 7 * index) // 6 % 2)[..., None] == 0, (230, 40, 60), (250, 220, 80))
    thing = np.where((radius < 1)[..., None], stripes * (1 - 0.4 * radius[..., None] ** 2), pixels)
    return np.clip(np.rint(thing), 0, 255).astype(np.uint8), np.where(radius < 1.08, np.uint8(0), np.uint8(255))


def write_json(folder: Path, poses: dict[str, Camera], suffix: str, *, masks: bool) -> None:
    """transforms.json in nerfstudio's dialect."""
    data = json.loads((ROOT / "tests/data/still_life_cameras.json").read_text())
    for frame in data["frames"]:
        name = Path(frame["file_path"]).stem
        frame["file_path"] = f"images/{name}{suffix}"
        if masks:
            frame["mask_path"] = f"masks/{name}.png"
    (folder / "transforms.json").write_text(json.dumps(data))


def write_poses_bounds(folder: Path, poses: dict[str, Camera]) -> None:
    """poses_bounds.npy: camera columns down, right, back; height, width, focal length; near and far."""
    rows = []
    for _, camera in sorted(poses.items()):
        right, down, forward, position = camera.world_from_camera[:3].T
        matrix = np.stack([down, right, -forward, position, (camera.height, camera.width, camera.params[0])], -1)
        distance = float(np.linalg.norm(position))
        rows.append([*matrix.ravel(), max(0.1, distance - 1.2), distance + 1.2])
    np.save(folder / "poses_bounds.npy", np.array(rows))


def save(pixels: np.ndarray, path: Path, **options: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path, **options)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    folder: Path = parser.parse_args().folder
    poses, mesh = cameras(), objects()
    for index, (name, camera) in enumerate(sorted(poses.items())):
        stem = Path(name).stem
        with opened(PHOTOGRAPHS / name) as image:
            pixels, exif = np.asarray(image.convert("RGB")), image.info["exif"]
        mask = silhouette(mesh, camera)
        cutout = np.dstack([np.where(mask[..., None] > 0, pixels, 0).astype(np.uint8), mask])
        moving, used = with_moving_thing(pixels, index)
        for place in ("photographs_masks", "json_masks/images"):
            (folder / place).mkdir(parents=True, exist_ok=True)
            shutil.copyfile(PHOTOGRAPHS / name, folder / place / name)
        for place in ("photographs_masks/masks", "json_masks/masks"):
            save(mask, folder / place / f"{stem}.png")
        save(np.dstack([pixels, mask]), folder / "photographs_rgba" / f"{stem}.png", exif=exif)
        for place in ("photographs_cutouts", "json_rgba/images"):
            save(cutout, folder / place / f"{stem}.png", exif=exif)
        for place in ("photographs_moving", "json_moving/images"):
            save(moving, folder / place / f"{stem}.jpg", quality=95, exif=exif)
        for place in ("photographs_moving/masks", "json_moving/masks"):
            save(used, folder / place / f"{stem}.png")
        save(undistorted(camera, pixels), folder / "llff_masks/images" / f"{stem}.png")
        save(undistorted(camera, mask), folder / "llff_masks/masks" / f"{stem}.png")
    for place, suffix, masks in (("json_masks", ".jpg", True), ("json_rgba", ".png", False), ("json_moving", ".jpg", True)):
        write_json(folder / place, poses, suffix, masks=masks)
    write_poses_bounds(folder / "llff_masks", poses)
    print(f"{len(poses)} photographs in each folder of {folder}")


if __name__ == "__main__":
    main()
