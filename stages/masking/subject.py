"""The subject of a trained scene, as a part of space, and how much of each pixel of a photograph it covers.

Cells of the foreground region are coarse; planes that support the subject are found anew here, from all points near them, so that the subject is cut off close
to them.

N points, M cells, R rays.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from scipy.spatial import cKDTree

from efficientnerf.capture.cells import CONNECTED, connected_parts
from efficientnerf.capture.foreground import MIN_PART, Foreground
from efficientnerf.capture.supports import Plane, along
from efficientnerf.geometry.cameras import Camera, project, rays
from efficientnerf.model import Model, render_rays
from efficientnerf.rendering.compositing import ray_of_sample

# docs/experiments/silhouettes.md
FINER, MIN_ENDS = 2, 3  # cells along a side of the foreground's; rays that end in one, at least
NEAR_CELLS = 1.5  # sides of a cell, up to which space belongs to the subject
THICKNESS = 3.0  # deviations of a support's points from its plane, up to which it reaches
LEAST_THICKNESS = 0.004  # of the subject's size
RAYS_PER_BLOCK = 8192
LEAST_WEIGHT = 1e-3  # of a sample


@dataclass(frozen=True, eq=False)
class Subject:
    """A part of space."""

    cells: np.ndarray  # (M, 3) centres of the cells that hold the subject
    reach: float  # how far from one of these it may be
    planes: tuple[tuple[Plane, float], ...]  # that support it, and how far above each it begins

    def holds(self, points: np.ndarray) -> np.ndarray:
        """(N,) bool."""
        found = np.ones(len(points), bool)
        for (normal, offset), above in self.planes:
            found &= along(points, normal) - offset > above
        at = np.flatnonzero(found)
        found[at] = np.isfinite(cKDTree(self.cells).query(points[at], distance_upper_bound=self.reach)[0])
        return found


def subject_of(found: Foreground, points: np.ndarray) -> Subject:
    """points  (N, 3) where rays of the photographs end"""
    size = float(np.ptp(found.subject, axis=0).max())
    points = points[np.isfinite(points).all(axis=1)]
    planes = tuple(_support(plane, found, points, LEAST_THICKNESS * size) for plane in found.planes)
    side = found.side / FINER
    return Subject(_grown(found, points, planes, side), NEAR_CELLS * side, planes)


def _grown(found: Foreground, points: np.ndarray, planes: Sequence[tuple[Plane, float]], side: float) -> np.ndarray:
    """(M, 3) centres of finer cells in which rays end, above the planes, connected with the subject: what is flat on a support was within its tolerance."""
    low, high = found.region.bounds
    above = ((points >= low) & (points <= high)).all(axis=1)
    for (normal, offset), least in planes:
        above &= along(points, normal) - offset > least
    cells, count = np.unique(np.floor(points[above] / side).astype(np.int64), axis=0, return_counts=True)
    centres = (cells[count >= MIN_ENDS] + 0.5) * side
    core = cKDTree(found.subject).query(centres)[0] <= found.side if len(centres) else np.zeros(0)
    if not core.any():
        return found.subject
    _, part = connected_parts(centres, CONNECTED * side)
    held = np.bincount(part, core)
    return np.asarray(centres[(held >= MIN_PART * held.sum())[part] & (held[part] > 0)])


def _support(plane: Plane, found: Foreground, points: np.ndarray, least: float) -> tuple[Plane, float]:
    """The plane of the points round the subject that lie near a plane, and how thick it is."""
    normal, offset = plane
    size = float(np.ptp(found.subject, axis=0).max())
    height = along(points, normal) - offset
    near = points[np.abs(height) <= 1.5 * found.side]
    feet = cKDTree(found.subject - (along(found.subject, normal) - offset)[:, None] * normal)
    beside = feet.query(near - (along(near, normal) - offset)[:, None] * normal)[0]
    near = near[(beside > 2 * found.side) & (beside < size)]
    if len(near) < 100:
        return plane, max(found.side / 2, least)
    spread = found.side
    for _ in range(6):
        height = along(near, normal) - offset
        inner = near[np.abs(height) <= max(3 * spread, 1e-9)]
        middle = inner.mean(axis=0)
        axis = np.linalg.eigh(np.einsum("ni,nj->ij", inner - middle, inner - middle))[1][:, 0]
        normal = axis if axis @ normal > 0 else -axis
        offset = float(normal @ middle)
        spread = 1.4826 * float(np.median(np.abs(along(inner, normal) - offset)))
    return (normal, offset), max(THICKNESS * spread, least)


def coverage(m: Model, subject: Subject, camera: Camera, near: float, far: float) -> np.ndarray:
    """(H, W) how much of the light of each pixel comes from the subject: what stands before it takes its share away.

    camera  in the training frame
    """
    found = np.zeros(camera.width * camera.height)
    chosen = np.flatnonzero(may_show(subject, camera))
    with torch.no_grad():
        for begin in range(0, len(chosen), RAYS_PER_BLOCK):
            index = chosen[begin : begin + RAYS_PER_BLOCK]
            o, d = rays(camera, np.stack([index % camera.width + 0.5, index // camera.width + 0.5], axis=-1))
            o, slant = np.broadcast_to(o, d.shape), np.maximum(d @ camera.forward, 1e-3)
            origins, directions, first, last = (torch.tensor(part, dtype=torch.float32) for part in (o, d, near / slant, far / slant))
            out = render_rays(m, origins, directions, first, last, torch.full_like(first, 0.5), m.behind(directions))
            ray = ray_of_sample(out.fine.first, len(out.fine.start)).numpy()
            weight, middle = out.fine_weight.double().numpy(), (out.fine.start + out.fine.extent / 2).double().numpy()
            heavy = np.flatnonzero(weight > LEAST_WEIGHT)
            ray, weight, middle = ray[heavy], weight[heavy], middle[heavy]
            found[index] = np.bincount(ray, weight * subject.holds(o[ray] + middle[:, None] * d[ray]), len(index))
    return found.reshape(camera.height, camera.width)


def may_show(subject: Subject, camera: Camera) -> np.ndarray:
    """(H, W) bool: the pixels near which a cell of the subject is projected."""
    place, depth = project(camera, subject.cells)
    found = np.zeros((camera.height, camera.width), np.uint8)
    if np.linalg.norm(subject.cells - camera.centre, axis=1).min() <= subject.reach:  # the camera is next to it
        return found == 0
    for (x, y), away in zip(place, depth, strict=True):
        if np.isfinite([x, y]).all() and max(abs(x), abs(y)) < 4 * max(found.shape):
            cv2.circle(found, (int(x), int(y)), int(np.ceil(subject.reach * camera.intrinsics["fx"] / away)) + 1, 1, -1)
    return found > 0
