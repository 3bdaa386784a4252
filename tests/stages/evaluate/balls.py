"""Evaluations of a ball with a closed form: its photographs, jobs and figures."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image

from efficientnerf.asset.camera_paths import pose_on_sphere
from efficientnerf.geometry.cameras import Camera, Similarity
from efficientnerf.geometry.orbit import Orbit
from efficientnerf.surface.mesh import Mesh
from pipeline.stage import Job
from stages.evaluate.mesh import evaluated_mesh
from stages.evaluate.run import evaluate
from stages.evaluate.settings import EvaluateSettings
from stages.evaluate.splats import EvaluatedSplats
from stages.formats.exporters.frames import frame_from_rendering
from stages.io.png import write_png
from stages.io.scene import Scene, View, save
from tests.fakes import WHITE, BallTree

TREE = BallTree()
WIDTH, HEIGHT = 60, 44


def ball_mesh(tree: BallTree = TREE, subdivisions: int = 3) -> Mesh:
    """The surface of a ball, with the ball's colours at its vertices."""
    ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=tree.radius)
    vertices = np.asarray(ball.vertices) + tree.centre
    return Mesh(vertices, np.asarray(ball.faces), np.asarray(ball.vertices) / tree.radius, tree.colour(vertices))


BALL_MESH = evaluated_mesh(ball_mesh(), None)


def make_scene(folder: Path, splits: str, *, masked: bool = False) -> Path:
    """A poses artifact that photographs TREE, RGBA on white. One letter of splits per view."""
    (folder / "images").mkdir(parents=True)
    views = []
    for k, letter in enumerate(splits):
        pose = pose_on_sphere((0.0, 0.0, 0.0), 3.0, 30.0 * k, 20.0)
        camera = Camera(f"v{k}.png", WIDTH, HEIGHT, "SIMPLE_PINHOLE", (70.0, WIDTH / 2, HEIGHT / 2), pose)
        seen = TREE.render(camera)
        frame = frame_from_rendering(seen.colour, seen.opacity, None)
        mask = None
        if masked:
            # The photograph is spoilt where the mask says so.
            frame = frame.copy()
            frame[:10, :, :3] = 255 - frame[:10, :, :3]
            mask = f"images/mask{k}.png"
            used = np.full((HEIGHT, WIDTH), 255, np.uint8)
            used[:10] = 0
            Image.fromarray(used).save(folder / mask)
        write_png(frame, folder / "images" / f"v{k}.png")
        split = {"r": "train", "v": "val", "t": "test"}[letter]
        views.append(View(f"images/v{k}.png", mask, split, camera, camera, 1.0, 5.0))
    scene = Scene("ball", tuple(views), np.array([[-1.0] * 3, [1.0] * 3]), WHITE, Similarity.identity(), Orbit((0.0, 0.0, 0.0), 3.0, 20.0, False, 0.0))
    save(scene, folder)
    return folder


def settings(**more: Any) -> EvaluateSettings:
    return EvaluateSettings(**{"strips": "off", "captured_path_frames": "off", **more})


def job_in(folder: Path, poses: Path, chosen: EvaluateSettings | None = None, out: str = "out", **more: Any) -> Job:
    return Job(settings=chosen or settings(), out=folder / out, work=folder / "work", inputs={"poses": poses, "train": folder / "no refined cameras"}, **more)


def measure(tree: BallTree, load_field: Callable[[], Any], job: Job, splats: EvaluatedSplats | None = None) -> None:
    evaluate(tree.evaluated(), tree, load_field, job, BALL_MESH, splats)


def figures_of(job: Job) -> dict[str, Any]:
    return json.loads((job.out / "metrics.json").read_text())


def verdict_of(job: Job) -> dict[str, Any]:
    return json.loads((job.out / "verdict.json").read_text())


def problems_of(job: Job) -> set[str]:
    """What stands against a result."""
    return {each["what"] for each in verdict_of(job)["problems"]}
