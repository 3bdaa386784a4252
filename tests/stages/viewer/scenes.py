"""Scenes for the tests of the viewer's page, and what they are looked at from."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from efficientnerf.asset.format import contents, save, serialize
from efficientnerf.asset.tree import NerfTree, Region
from efficientnerf.geometry.cameras import Camera
from efficientnerf.geometry.ndc import Ndc
from stages.formats.exporters import SPLAT_EXPORTERS
from stages.formats.exporters.writing import source_frame
from stages.viewer.page import splats_page, viewer_page
from tests.efficientnerf.trees import looking, random_cascades, random_tree
from tests.stages.formats.gaussians import scattered

SIDE = 64
ORBIT = {"centre": [0.0, 1.0, -0.4], "radius": 3.0, "elevation": 20.0, "heading": 40.0, "forward_facing": False}
REGION = Region(np.array([[-0.55, 0.35, -0.95], [0.1, 0.9, 0.2]]), 0.3, 0.15)


def forward_facing() -> NerfTree:
    ndc = Ndc(np.eye(4), 60.0, 64.0, 64.0, 1.0)
    return replace(random_tree(7, shape=(6, 6, 6), brick=4, degree=2, sigma=20.0, ndc=ndc), bounds_min=np.full(3, -1.0), voxel=2 / 24)


TREES = {
    "bounded": lambda: random_tree(1, degree=2, step_size=1.0, background=(1.0, 1.0, 1.0)),
    "nearest": lambda: random_tree(2, degree=0, lookup="nearest", background=(1.0, 1.0, 1.0)),
    "degree 4": lambda: random_tree(5, degree=4, brick=2, background=(1.0, 1.0, 1.0)),
    "whole": lambda: random_cascades(3, degree=1, region=REGION),
    "forward facing": forward_facing,
}


def cameras_at(tree: NerfTree) -> list[Camera]:
    """Five, around the tree or before it."""
    if tree.ndc is not None:
        poses = [np.eye(4) for _ in range(5)]
        for n, pose in enumerate(poses):
            pose[:3, 3] = 0.1 * np.sin([n, 2 * n, 3 * n])
        return [Camera(str(n), SIDE, SIDE, "SIMPLE_PINHOLE", (60.0, 32.0, 32.0), pose) for n, pose in enumerate(poses)]
    first = looking(tree)
    centre = (tree.bounds_min + tree.bounds_max) / 2
    out = []
    for n in range(5):
        angle = 1.3 * n
        turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
        pose = first.world_from_camera.copy()
        pose[:3, :3], pose[:3, 3] = turn @ pose[:3, :3], centre + turn @ (pose[:3, 3] - centre) * (1 - 0.15 * n)
        out.append(Camera(str(n), SIDE, SIDE, "PINHOLE", (80.0, 84.0, 30.0, 33.0), pose))
    return out


def decibels(found: np.ndarray, expected: np.ndarray) -> float:
    error = np.mean((found.astype(np.float64) / 255 - np.clip(expected, 0, 1)) ** 2)
    return float(-10 * np.log10(max(error, 1e-12)))


def written(folder: Path, asset: bytes, **options: Any) -> Path:
    path = folder / "viewer.html"
    path.write_bytes(viewer_page(asset, **options))
    return path


def page_of(kind: str, folder: Path, tree: NerfTree, **options: Any) -> Path:
    """The page of an asset, or of Gaussians that were scattered in its frame."""
    if kind == "asset":
        return written(folder, serialize(tree, "compact"), **options)
    save(tree, folder / "a.nerftree", "sparse")
    SPLAT_EXPORTERS[".spz"](scattered(60), folder / "a.spz", source_frame(tree.metadata))
    path = folder / "viewer.html"
    path.write_bytes(splats_page((folder / "a.spz").read_bytes(), contents(folder / "a.nerftree")[0], **options))
    return path
