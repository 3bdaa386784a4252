"""The verdict of the poses stage: looked for, written with its pictures, and said."""

from __future__ import annotations

import contextlib
from dataclasses import replace
from typing import Any

import numpy as np

from pipeline.errors import BadInput
from pipeline.files import write_json
from pipeline.stage import Job
from stages.artifacts import PosesOutputs
from stages.framing.captured import coverage
from stages.io.capture import Capture
from stages.io.importers.photographs import photographs
from stages.io.importers.source import Source
from stages.io.scene import Scene
from stages.verdict import looks, pictures
from stages.verdict.verdict import Verdict, verdict_on

NOT_SAID = ("not registered", "folded", "parallax", "few")  # problems that the search for cameras has warned of, or that the user knows of


def judge(job: Job, capture: Capture, scene: Scene, renders: bool, warn: Any) -> Verdict:
    """Write the verdict on the cameras of a scene whose working images are written, and its pictures; say it, and warn of what stands against it.

    renders  whether the images may be renders
    """
    outputs = PosesOutputs(job.out)
    files = {view.name: job.out / view.image for view in scene.views} | {name: capture.rejected_files[name] for name in sorted(capture.rejected_files)}
    sources = {photo.camera.name: photo.image for photo in capture.photos}
    seen: dict[str, looks.Look] = {}
    for done, (name, path) in enumerate(files.items()):
        job.safe_point()
        job.progress(done, len(files), "looking at images")
        seen |= looks.look_at_all({name: path}, sources)
    found = verdict_on(capture, seen, in_folder=None if capture.kind == "photographs" or renders else _photographs_in_folder(job))
    found = replace(found, figures={**found.figures, "coverage": _coverage(scene)})
    write_json(outputs.verdict, found.document())
    job.safe_point()
    _draw(outputs, capture, scene, found)
    job.safe_point()
    sharpness = {name: each.sharpness for name, each in seen.items()}
    pictures.sharpness_sheet(files, sharpness, looks.blurred(seen), outputs.sharpness)
    job.say(found.summary(), grade=found.grade)
    for problem in found.problems:
        if problem.grade != "good" and problem.what not in NOT_SAID:
            warn(f"{problem.sentence} {problem.remedy}")
    return found


def _coverage(scene: Scene) -> dict[str, float]:
    """Degrees of the sphere round the subject that the cameras stand on: round the upward axis, and of elevation in the middle and to either side of it."""
    found = coverage(np.array([view.camera.centre for view in scene.views]), np.asarray(scene.orbit.centre))
    return {"arc": round(found.arc, 1), "elevation": round(found.elevation, 1), "heights": round(found.heights, 1)}


def _photographs_in_folder(job: Job) -> int | None:
    if job.source is None:
        return None
    with contextlib.suppress(BadInput):
        return len(photographs(Source(job.source, job.settings.allow_outside)))
    return None


def _draw(outputs: PosesOutputs, capture: Capture, scene: Scene, found: Verdict) -> None:
    lost = [name for name, _ in capture.rejected]
    names, centres = [view.name for view in scene.views], np.array([view.camera.centre for view in scene.views])
    forward = np.array([view.camera.world_from_camera[:3, 2] for view in scene.views])
    points = np.zeros((0, 3)) if capture.points is None else scene.world_from_capture.points(capture.points.xyz)
    pictures.camera_plot(centres, forward, points, pictures.lost_places(names, centres, lost, capture.overlaps), found.summary(), outputs.cameras)
    if capture.overlaps:
        pictures.match_picture(sorted([*names, *lost]), lost, capture.overlaps, outputs.matches)
