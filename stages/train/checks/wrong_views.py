"""Training views with wrong cameras: the checks between the steps, and what is written and shown of them."""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from efficientnerf.geometry.cameras import Camera
from efficientnerf.rendering.field_renderer import FieldRenderer
from efficientnerf.training.loop import Progress, Trainer, train
from efficientnerf.training.pixels import Pixels
from efficientnerf.training.sparse_depth import SparseDepthRays
from efficientnerf.training.view_checks.checks import Observations, ViewChecks, check, is_due
from pipeline.stage import Job
from pipeline.text import printable
from stages.artifacts import TrainOutputs
from stages.evaluate.views import ground_truth, stride_to, subsample_camera
from stages.figures.plots import to_uint8
from stages.io import refined_cameras
from stages.io.png import write_png
from stages.io.scene import Scene, View, read_points, views_of

SIDE = 300  # of a photograph in the picture, pixels
ROWS = 12  # of it: more views than that are in the report alone
WITNESSES = (
    (1, "another place explains it better"),
    (2, "its sparse points contradict it"),
    (4, "nothing of it is explained"),
    (8, "it observes few sparse points"),
)


def train_and_check(job: Job, t: Trainer, pixels: Pixels, s: Scene, sparse_depth: Callable[[Scene], SparseDepthRays | None]) -> Iterator[Progress]:
    """`loop.train`, with the checks of the training views between its steps.

    sparse_depth  rays to the sparse points of a scene, made again where its training views change
    """
    views = views_of(s, "train")
    known = observations(job.inputs["poses"], s) if t.checks is not None else None
    while t.step < t.schedule.iterations:
        for done in train(t, pixels, sparse_depth(scene_of(t.checks, s, views))):
            changed = False
            if t.checks is not None and is_due(t.checks, done.step, t.schedule.fraction(done.step)):
                before = t.checks.left_out.copy()
                changed = check(t.checks, t.model, pixels, known, done.step)
                _say(job, t.checks, before, views)
            yield done
            if changed:
                break  # and go on with other pixels and rays


def _say(job: Job, c: ViewChecks, before: np.ndarray, views: tuple[View, ...]) -> None:
    for which, what in ((c.left_out & ~before, "left out of training for now because their cameras seem wrong"), (before & ~c.left_out, "trained on again")):
        if which.any():
            names = ", ".join(printable(view.name, 60) for view, one in zip(views, which, strict=True) if one)
            job.say(f"{int(which.sum())} of {len(views)} views are {what}: {names}")


def scene_of(c: ViewChecks | None, s: Scene, views: tuple[View, ...]) -> Scene:
    """The scene as it is trained on: without the views that are left out, with the cameras that were replaced."""
    if c is None or not c.changed:
        return s
    return refined_cameras.as_trained(s, *_replaced_and_left_out(c, views))


def _replaced_and_left_out(c: ViewChecks, views: tuple[View, ...]) -> tuple[dict[str, Camera], list[str]]:
    replaced = {view.image: camera for view, camera, old in zip(views, c.cameras, c.given, strict=True) if camera is not old}
    return replaced, [view.image for view, out in zip(views, c.left_out, strict=True) if out]


def observations(folder: Path, s: Scene) -> Observations | None:
    """The sparse points as the training views observe them; None where it is not known which views do."""
    if not s.points:
        return None
    points = read_points(folder)
    counts = np.array([len(track) for track in points.tracks], np.int64)
    number = np.full(len(s.views), -1)
    training = [n for n, view in enumerate(s.views) if view.split == "train"]
    number[training] = np.arange(len(training))
    view = number[np.array([n for track in points.tracks for n in track], np.int64)]
    point = np.repeat(np.arange(len(counts)), counts)[view >= 0]
    return Observations(points.xyz[point], points.rgb[point] / 255, view[view >= 0]) if len(point) else None


def findings_of(t: Trainer, views: tuple[View, ...]) -> list[dict[str, Any]]:
    """The findings on each view that was left out at some time: errors are shares of the photograph's variance inside tiles."""
    if t.checks is None:
        return []
    found = []
    for n in np.flatnonzero(t.checks.evidence[:, 0]):
        step, error, usual, other, moved, bits = t.checks.evidence[n].tolist()
        outcome = "left out" if t.checks.left_out[n] else "pose replaced" if t.checks.replaced[n] else "trained on again"
        found.append({
            "image": views[n].name, "outcome": outcome, "step": int(step), "error": round(error, 3), "others": round(usual, 3),
            "error_elsewhere": round(other, 3), "moved_cells": round(moved, 2) if math.isfinite(moved) else None,
            "witnesses": ["the field explains it worse than its neighbours", *(text for bit, text in WITNESSES if int(bits) & bit)],
        })  # fmt: skip
    return found


def write_cameras(outputs: TrainOutputs, t: Trainer, views: tuple[View, ...], folder: Path, renderer: FieldRenderer) -> None:
    """The training cameras where some were replaced, the views that were left out, and pictures of both; `folder` is the scene's."""
    if t.checks is None or not t.checks.changed:
        return
    refined_cameras.write(views, t.checks.cameras, outputs.cameras, _replaced_and_left_out(t.checks, views)[1])
    if not (t.checks.left_out | t.checks.replaced).any():
        return
    rows = []
    for n in np.flatnonzero(t.checks.left_out | t.checks.replaced)[:ROWS]:
        stride = stride_to(views[n].camera, SIDE)
        cameras = [t.checks.given[n], *([replace(t.checks.given[n], world_from_camera=t.checks.pose[n])] if t.checks.replaced[n] else [])]
        renders = [np.clip(renderer.colour(subsample_camera(camera, stride)), 0, 1) for camera in cameras]
        rows.append(np.concatenate([ground_truth(folder, views[n], t.model.background, stride).colour, *renders], axis=1))
    height, width = sum(len(row) for row in rows), max(row.shape[1] for row in rows)
    sheet, top = np.ones((height, width, 3)), 0
    for row in rows:
        sheet[top : top + len(row), : row.shape[1]] = row
        top += len(row)
    write_png(to_uint8(sheet), outputs.wrong_views)
