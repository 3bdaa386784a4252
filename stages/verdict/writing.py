"""The verdict of the poses stage: found, written with its pictures, and reported."""

import contextlib
from dataclasses import replace
from typing import Any

import numpy as np

from efficientnerf.capture.coverage import coverage
from efficientnerf.geometry.cameras import Camera, project, resized
from pipeline.errors import BadInput
from pipeline.files import write_json
from pipeline.stage import Job
from stages.artifacts import PosesOutputs
from stages.formats.importers.photographs import photographs
from stages.formats.importers.source import Source
from stages.io.capture import Capture
from stages.io.pictures import UnreadableImage, read_quality
from stages.io.scene import Scene
from stages.verdict import looks, pictures
from stages.verdict.verdict import verdict_on

GREY = np.array([0.299, 0.587, 0.114])
ALREADY_REPORTED = ("not registered", "folded", "parallax", "few")  # problems that the search for cameras has warned of, or that the user knows of


def judge(job: Job, capture: Capture, scene: Scene, renders: bool, warn: Any) -> None:
    """Write the verdict on the cameras of a scene whose working images are written, and its pictures; say it, and warn of what stands against it.

    renders  whether the images may be renders
    """
    outputs = PosesOutputs(job.out)
    files = {view.name: job.out / view.image for view in scene.views} | {name: capture.rejected_files[name] for name in sorted(capture.rejected_files)}
    sources = {photo.camera.name: photo.image for photo in capture.photos}
    observed = _observed_points(capture)
    seen: dict[str, looks.Look] = {}
    for done, (name, path) in enumerate(files.items()):
        job.safe_point()
        job.progress(done, len(files), "looking at images")
        with contextlib.suppress(UnreadableImage):
            grey = looks.grey_of(path)
            seen[name] = looks.look(grey, read_quality(sources.get(name, path)))
            if name in observed:
                camera, xyz, light = observed[name]
                at = np.nan_to_num(project(resized(camera, grey.shape[1], grey.shape[0]), xyz)[0], nan=-1.0, posinf=-1.0, neginf=-1.0)
                seen[name] = replace(seen[name], over_points=looks.over_points(grey, at, light))
    in_folder = None
    if capture.kind != "photographs" and not renders:
        assert job.source is not None
        with contextlib.suppress(BadInput):
            in_folder = len(photographs(Source(job.source, job.settings.allow_outside)))
    found = verdict_on(capture, seen, in_folder=in_folder)
    # Degrees of the sphere round the subject that the cameras stand on: round the upward axis, and of elevation in the middle and to either side of it.
    around = coverage(np.array([view.camera.centre for view in scene.views]), np.asarray(scene.orbit.centre))
    degrees = {name: round(getattr(around, name), 1) for name in ("arc", "elevation", "heights")}
    found = replace(found, figures={**found.figures, "coverage": degrees})
    write_json(outputs.verdict, found.document())
    job.safe_point()
    lost = [name for name, _ in capture.rejected]
    names, centres = [view.name for view in scene.views], np.array([view.camera.centre for view in scene.views])
    forward = np.array([view.camera.world_from_camera[:3, 2] for view in scene.views])
    points = np.zeros((0, 3)) if capture.points is None else scene.world_from_capture.points(capture.points.xyz)
    pictures.camera_plot(centres, forward, points, pictures.lost_places(names, centres, lost, capture.overlaps), found.summary(), outputs.cameras)
    if capture.overlaps:
        pictures.match_picture(sorted([*names, *lost]), lost, capture.overlaps, outputs.matches)
    job.safe_point()
    sharpness = {name: each.sharpness for name, each in seen.items()}
    pictures.sharpness_sheet(files, sharpness, looks.blurred(seen), outputs.sharpness)
    job.say(found.summary(), grade=found.grade)
    for problem in found.problems:
        if problem.grade != "good" and problem.what not in ALREADY_REPORTED:
            warn(f"{problem.sentence} {problem.remedy}")


def _observed_points(capture: Capture) -> dict[str, tuple[Camera, np.ndarray, np.ndarray]]:
    """Name of a photograph -> its camera, the sparse points (N, 3) that it observes, and how light they are on average (N,)."""
    points = capture.points
    if points is None or not len(points.rgb) or np.ptp(points.rgb) == 0:  # nobody knows their colours
        return {}
    light = ((points.rgb @ GREY) / 255.0) ** 2.2
    observed: list[list[int]] = [[] for _ in capture.photos]
    for point, track in enumerate(points.tracks):
        for view in track:
            observed[view].append(point)
    return {photo.camera.name: (photo.camera, points.xyz[at], light[at]) for photo, at in zip(capture.photos, observed, strict=True)}
