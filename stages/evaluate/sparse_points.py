"""Whether an asset is where structure from motion found points: its depth at the pixels of sparse points against theirs.

A sparse point that three photographs see shows what a picture cannot: there is a surface, and nothing before it. Where the asset is nearer, it has
a floater; where it is farther, a surface is missing, however right its colours are.

nearer, agreeing, farther  shares of the points; subject_farther: the same of those in the scene bounds. A point agrees where the asset's depth is within
                           TOLERANCE of its own in a pixel or in one next to it: points are found at edges
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from efficientnerf.geometry.cameras import Camera, project
from stages.figures.drawing import matplotlib
from stages.figures.plots import to_uint8
from stages.framing.near_planes import reliable_points
from stages.io.scene import Scene, read_points

TOLERANCE = 0.05  # of a point's depth; docs/experiments/verdict.md
FEW = 30  # points of all views together, below which nothing is reported
NEARER, AGREES, FARTHER = -1, 0, 1
COUNTS = ("points", "nearer", "farther", "subject_points", "subject_farther")  # of a view
COLOURS = {NEARER: (220, 40, 40), AGREES: (40, 170, 70), FARTHER: (40, 90, 230)}
DOT = 2  # px, radius of a point in the picture


@dataclass(frozen=True, eq=False)
class ReliablePoints:
    """Reliable points (`stages.framing.near_planes.reliable_points`), and who sees them."""

    xyz: np.ndarray  # (P, 3) training frame
    counts: np.ndarray  # (P,) how many views see each
    observers: np.ndarray  # (O,) these views' places in the scene, point by point
    subject: np.ndarray  # (P,) bool, whether they lie in the scene bounds

    def seen_by(self, view: int) -> np.ndarray:
        """(P,) bool: which of them the view sees."""
        rows = np.repeat(np.arange(len(self.counts)), self.counts)
        found = np.zeros(len(self.counts), bool)
        found[rows[self.observers == view]] = True
        return found


def observed_points(folder: Path, scene: Scene, reach: np.ndarray | None) -> ReliablePoints | None:
    """Those of a scene; None where there are none, or their observers are unknown.

    reach  (2, 3) beyond which the asset has no density; None: the scene bounds, or of a forward-facing scene nothing
    """
    points = read_points(folder) if scene.points else None
    if points is None or not any(points.tracks):
        return None
    inside = ((points.xyz >= scene.bounds[0]) & (points.xyz <= scene.bounds[1])).all(1)
    reached = np.ones(len(inside), bool) if scene.forward is not None else inside
    if reach is not None and scene.forward is None:
        reached = ((points.xyz >= reach[0]) & (points.xyz <= reach[1])).all(1)
    kept = np.flatnonzero(reliable_points(points, len(scene.views)) & reached)
    if not len(kept):
        return None
    tracks = [sorted(set(points.tracks[n])) for n in kept]
    observers = np.array([view for track in tracks for view in track], np.int64)
    return ReliablePoints(points.xyz[kept], np.array([len(track) for track in tracks], np.int64), observers, inside[kept])


def judged(points: ReliablePoints, view: int, camera: Camera, depth: np.ndarray, used: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The points that a view sees in pixels that count: (N, 2) their pixels, (N,) NEARER, AGREES or FARTHER, (N,) bool whether they are of the subject.

    view   its place in the scene
    depth  (H, W) of the asset along the view axis; not finite where nothing is hit
    used   (H, W) bool, pixels that count
    """
    chosen = np.flatnonzero(points.seen_by(view))
    pixels, own = project(camera, points.xyz[chosen])
    x, y = (np.nan_to_num(pixels[:, axis], nan=-1.0).astype(np.int64) for axis in (0, 1))  # a pixel's centre is at +0.5
    whole = (x >= 1) & (y >= 1) & (x < camera.width - 1) & (y < camera.height - 1)
    chosen, x, y, own = chosen[whole], x[whole], y[whole], own[whole]
    kept = used[y, x]
    chosen, x, y, own = chosen[kept], x[kept], y[kept], own[kept]
    around = np.stack([depth[y + j, x + i] for j in (-1, 0, 1) for i in (-1, 0, 1)], axis=1)  # (N, 9)
    away = np.where(np.isfinite(around), around, np.inf) / own[:, None] - 1.0
    nearest = np.take_along_axis(away, np.abs(away).argmin(1)[:, None], axis=1)[:, 0] if len(own) else np.zeros(0)
    kinds = np.where(np.abs(nearest) <= TOLERANCE, AGREES, np.where(nearest < 0, NEARER, FARTHER))
    return np.stack([x, y], axis=1), kinds, points.subject[chosen]


def counts_of(kinds: np.ndarray, subject: np.ndarray) -> dict[str, int]:
    """COUNTS of a view, of what `judged` returns."""
    farther = kinds == FARTHER
    found = (len(kinds), (kinds == NEARER).sum(), farther.sum(), subject.sum(), (farther & subject).sum())
    return {name: int(value) for name, value in zip(COUNTS, found, strict=True)}


def agreement(views: Sequence[Mapping[str, Any] | None]) -> dict[str, float | int] | None:
    """The number of points of all views together, and their shares; None of fewer than FEW. The subject's share is None of fewer than FEW."""
    total = {name: sum(view[name] for view in views if view is not None) for name in COUNTS}
    if total["points"] < FEW:
        return None
    nearer, farther = total["nearer"] / total["points"], total["farther"] / total["points"]
    subject = total["subject_farther"] / total["subject_points"] if total["subject_points"] >= FEW else None
    return {"points": total["points"], "agreeing": max(0.0, 1.0 - nearer - farther), "nearer": nearer, "farther": farther, "subject_farther": subject}


def picture(photograph: np.ndarray, depth: np.ndarray, pixels: np.ndarray, kinds: np.ndarray) -> np.ndarray:
    """(H, 2 W, 3) uint8: the photograph in grey with each point, green where the asset is, red where it is nearer, blue where it is farther; the asset's depth.

    photograph  (H, W, 3) float, 0 to 1
    """
    paper = to_uint8(np.repeat(0.3 + 0.6 * photograph.mean(-1, keepdims=True), 3, axis=-1))
    for kind in (AGREES, FARTHER, NEARER):
        for x, y in pixels[kinds == kind]:
            paper[max(0, y - DOT) : y + DOT + 1, max(0, x - DOT) : x + DOT + 1] = COLOURS[kind]
    hit = np.isfinite(depth)
    low, high = np.quantile(depth[hit], [0.02, 0.98]) if hit.any() else (0.0, 1.0)
    shown = 1.0 - np.clip((np.where(hit, depth, high) - low) / max(high - low, 1e-9), 0.0, 1.0)
    colours = to_uint8(matplotlib().colormaps["viridis"](shown)[:, :, :3])
    colours[~hit] = 255
    return np.concatenate([paper, colours], axis=1)
