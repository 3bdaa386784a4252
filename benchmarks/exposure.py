"""Photographs exposed differently: is the scene learned as well as from photographs exposed alike?

    python -m benchmarks.exposure FOLDER [--views 36] [--size 200] [--steps 800] [--seeds 0,1] [--asset]

The scene `court` three times, by the same cameras and pixels:

alike    one exposure, no vignetting
varied   -1 to +1 stops and drifting white balance in linear light, corners 0.9 stops darker than the middle
phone    the same through a tone curve that is darker in shadows and softer in lights than sRGB's

The test views are exposed as the training views are on average, without vignetting: figures are against them as they are, and with colours fitted to them.
FOLDER/exposure.json has all figures. `--asset`: of the asset, too.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.scenes.catalogue import cameras, recipes
from benchmarks.scenes.rendering import image, nearest
from efficientnerf.geometry.cameras import Camera, project, rays
from efficientnerf.rendering.colour import linear_from_srgb, srgb_from_linear

KINDS = ("alike", "varied", "phone")
POINTS = 3000
SPLITS = ("train", "test")


def toned(linear: np.ndarray) -> np.ndarray:
    """Light through a tone curve with a toe and a shoulder; 0 and 1 stay."""
    return np.asarray(linear * (1.6 * linear + 0.05) / (linear**2 + 0.6 * linear + 0.05))


def exposures(count: int, seed: int) -> np.ndarray:
    """(C, 3) logarithms of gains, of mean zero: -1 to 1 stops in no order, and a white balance that drifts."""
    rng, along = np.random.default_rng([33, seed]), np.linspace(0, 2 * np.pi, count)
    stops = rng.permutation(np.linspace(-1, 1, count))[:, None] * np.log(2)
    return np.asarray(stops + np.stack([0.18 * np.sin(along), np.zeros(count), -0.22 * np.sin(along)], axis=1))


def photographed(picture: np.ndarray, gain: np.ndarray | None, kind: str) -> np.ndarray:
    """A picture (H, W, 3) uint8 with the logarithms of its gains (3,) and vignetting; None: exposed as all are on average, and evenly."""
    if kind == "alike":
        return picture
    height, width = picture.shape[:2]
    y, x = np.mgrid[:height, :width]
    falloff = -2 * np.log(1 + 0.37 * ((2 * x + 1 - width) ** 2 + (2 * y + 1 - height) ** 2) / (width**2 + height**2))[..., None]
    light = linear_from_srgb(picture / 255.0) * np.exp(falloff.mean() if gain is None else gain + falloff)
    return np.rint(255 * srgb_from_linear((toned(light) if kind == "phone" else light).clip(0, 1))).astype(np.uint8)


def observed_points(recipe: Any, views: list[Camera], seed: int) -> tuple[np.ndarray, list[tuple[int, ...]]]:
    """Points (N, 3) on what the views show, and which of them see each."""
    rng = np.random.default_rng([34, seed])
    found = []
    for camera in views:
        pixels = rng.random((-(-POINTS // len(views)), 2)) * [camera.width, camera.height]
        origins, directions = rays(camera, pixels)
        distance = nearest(recipe.shapes, origins, directions).distance
        found.append((origins + distance[:, None] * directions)[distance < 60])
    points = np.concatenate(found)
    seen = np.zeros((len(points), len(views)), bool)
    for n, camera in enumerate(views):
        pixels, depth = project(camera, points)
        inside = (depth > 0) & ((pixels > 1) & (pixels < [camera.width - 1, camera.height - 1])).all(axis=1)
        away = points[inside] - camera.centre
        distance = np.linalg.norm(away, axis=1)
        first = nearest(recipe.shapes, np.broadcast_to(camera.centre, away.shape), away / distance[:, None]).distance
        seen[inside, n] = np.abs(first - distance) < 1e-3 * distance
    return points, [tuple(np.flatnonzero(row).tolist()) for row in seen]


def write_scene(folder: Path, kind: str, counts: dict[str, int], size: int, seed: int, pictures: dict[str, np.ndarray]) -> None:
    """What the stage poses would have written; pictures by name, filled where they are missing."""
    from stages.framing.training_frame import find_training_frame
    from stages.io.capture import Capture, Photo, SparsePoints
    from stages.io.png import write_png
    from stages.io.scene import Scene, View, save, save_points

    recipe, gains = recipes()["court"], exposures(counts["train"], seed)
    views = {split: cameras(recipe, split, counts[split], size) for split in SPLITS}
    every = [(split, n, camera) for split in SPLITS for n, camera in enumerate(views[split])]
    (folder / "images").mkdir(parents=True, exist_ok=True)
    for split, n, camera in every:
        if camera.name not in pictures:
            pictures[camera.name] = image(recipe.shapes, camera, supersample=3, alpha=False)
        write_png(photographed(pictures[camera.name], gains[n] if split == "train" else None, kind), folder / camera.name)
    xyz, tracks = observed_points(recipe, views["train"], seed)
    points = SparsePoints(xyz, np.full((len(xyz), 3), 128, np.uint8), np.full(len(xyz), 0.5), tuple(tracks))
    photos = tuple(Photo(camera, folder / camera.name, split=split) for split, _, camera in every)
    capture = Capture("transforms", photos, None, points=points)
    framed = find_training_frame(capture, space="contracted")
    world = framed.world_from_capture
    made = tuple(
        View(camera.name, None, split, world.camera(camera), camera, float(near), float(far))
        for (split, _, camera), (near, far) in zip(every, framed.near_far_planes, strict=True)
    )
    save_points(replace(points, xyz=world.points(xyz)), folder)
    save(Scene("transforms", made, framed.bounds, None, world, framed.orbit, points=True, space="contracted"), folder)


def figures(render: Any, poses: Path) -> dict[str, float]:
    """Mean PSNR over the test views, as they are, and with fitted colours."""
    from efficientnerf.evaluation.metrics import colour_fitted, psnr
    from stages.evaluate.views import ground_truth
    from stages.io import scene

    found = []
    for view in scene.views_of(scene.load(poses), "test"):
        truth, seen = ground_truth(poses, view, None).colour, np.clip(render(view.camera), 0, 1)
        found.append((psnr(seen, truth), psnr(colour_fitted(seen, truth), truth)))
    plain, fitted = np.mean(found, axis=0)
    return {"psnr": round(float(plain), 3), "psnr_colour_fitted": round(float(fitted), 3)}


def trained(poses: Path, out: Path, choice: str, seed: int, steps: int, *, asset: bool) -> dict[str, Any]:
    """Figures of a field, and of its asset."""
    from efficientnerf.asset import format
    from efficientnerf.asset.rendering import render
    from efficientnerf.training.settings import TrainSettings
    from pipeline.stage import Job
    from stages.artifacts import BakeOutputs
    from stages.bake import run as bake
    from stages.io.field_file import load_renderer
    from stages.train import run as train

    settings = TrainSettings(iterations=steps, exposure=choice, seed=seed, preview_every="off")  # type: ignore[arg-type]
    job = Job(settings=settings, inputs={"poses": poses}, out=out / "train", work=out / "train_work")
    if not (job.out / "report.json").exists():
        job.out.mkdir(parents=True, exist_ok=True)
        job.work.mkdir(parents=True, exist_ok=True)
        train.run(job)
    field = load_renderer(job.out)
    report = json.loads((job.out / "report.json").read_text())
    row: dict[str, Any] = {"field": figures(lambda camera: field.render(camera).colour, poses), "learned": report["exposure"]}
    if asset:
        made = Job(settings=bake.BakeSettings(max_mib=4.0, seed=seed), inputs={"poses": poses, "train": job.out}, out=out / "bake", work=out / "bake_work")
        made.out.mkdir(parents=True, exist_ok=True)
        made.work.mkdir(parents=True, exist_ok=True)
        bake.run(made)
        tree = format.load(BakeOutputs(made.out).asset)
        row["asset"] = figures(lambda camera: render(tree, camera, normals=False).colour, poses)
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--kinds", default=",".join(KINDS))
    parser.add_argument("--choices", default="off,auto")
    parser.add_argument("--seeds", default="0,1")
    parser.add_argument("--views", type=int, default=36)
    parser.add_argument("--size", type=int, default=200)
    parser.add_argument("--steps", type=int, default=800)
    parser.add_argument("--asset", action="store_true")
    given = parser.parse_args()
    pictures: dict[str, np.ndarray] = {}
    rows = []
    for seed in map(int, given.seeds.split(",")):
        for kind in given.kinds.split(","):
            poses = given.folder / f"{kind}_{seed}" / "poses"
            if not (poses / "scene.json").exists():
                write_scene(poses, kind, {"train": given.views, "test": 8}, given.size, seed, pictures)
            for choice in given.choices.split(","):
                out = given.folder / f"{kind}_{seed}" / f"{choice}_{given.steps}"
                rows.append({"kind": kind, "exposure": choice, "seed": seed, **trained(poses, out, choice, seed, given.steps, asset=given.asset)})
                print(json.dumps(rows[-1]), flush=True)
    (given.folder / "exposure.json").write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
