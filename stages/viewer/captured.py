"""The captured cameras of a run as the viewer takes them, and small photographs of them without distortion."""

import io
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from efficientnerf.geometry.cameras import Camera, project, rays, resized
from stages.io.refined_cameras import LEFT_OUT, load_scene
from stages.io.scene import View, read_image

CAMERAS = 240  # at most: more frusta hide one another
PHOTOGRAPHS = 32  # at most: a second's work, a megabyte
SIDE = 400  # of a photograph, pixels
QUALITY = 80  # of its WebP: 37 % smaller than a JPEG of this quality, and 0.6 dB nearer


def captured_views(poses: Path, train: Path) -> tuple[list[Camera], dict[str, bytes]]:
    """Cameras, training frame, and WebP files of some by the cameras' names, of the artifacts of these stages.

    Raises CorruptArtifact, and BadInput where there is no scene.
    """
    scene = load_scene(poses, train)
    known = [view for view in scene.views if view.split != LEFT_OUT]
    views = [known[n] for n in _spread(len(known), CAMERAS)]
    behind = scene.background or (1.0, 1.0, 1.0)
    shown = [views[n] for n in _spread(len(views), PHOTOGRAPHS)]
    return [_pinhole(view.camera) for view in views], {view.camera.name: photograph(poses, view, behind) for view in shown}


def _spread(count: int, most: int) -> list[int]:
    """At most so many of `count` places, evenly spaced."""
    return sorted({round(n) for n in np.linspace(0, count - 1, min(count, most)).tolist()}) if count else []


def _pinhole(camera: Camera) -> Camera:
    """The camera without its distortion."""
    lens = camera.intrinsics
    return replace(camera, model="PINHOLE", params=tuple(float(lens[key]) for key in ("fx", "fy", "cx", "cy")))


def photograph(folder: Path, view: View, background: tuple[float, float, float]) -> bytes:
    """WebP of a view, small, as its camera without distortion takes it; black where that sees past the image's border."""
    pixels = read_image(folder, view)
    size = min(1.0, SIDE / max(view.camera.width, view.camera.height))
    width, height = max(1, round(view.camera.width * size)), max(1, round(view.camera.height * size))
    if pixels.shape[2] == 4:
        alpha = pixels[..., 3:].astype(np.float32) / 255
        pixels = np.rint(pixels[..., :3] * alpha + 255 * np.asarray(background, np.float32) * (1 - alpha)).astype(np.uint8)
    small = np.asarray(cv2.resize(np.ascontiguousarray(pixels), (width, height), interpolation=cv2.INTER_AREA), np.uint8)
    camera = resized(view.camera, width, height)
    if camera.model not in ("PINHOLE", "SIMPLE_PINHOLE"):
        origins, directions = rays(_pinhole(camera))
        at = np.nan_to_num(project(camera, origins + directions)[0], nan=-1e6).astype(np.float32).reshape(height, width, 2) - np.float32(0.5)
        small = np.asarray(cv2.remap(small, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT), np.uint8)
    out = io.BytesIO()
    Image.fromarray(small).save(out, "WEBP", quality=QUALITY, method=6)
    return out.getvalue()
