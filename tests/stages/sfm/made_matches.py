"""Features and verified matches of made cameras, for what is tested without detecting and comparing any."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from benchmarks.poses import aligned_errors
from efficientnerf.geometry.cameras import Camera, project
from stages.sfm.colmap import import_pycolmap, quiet_pycolmap
from stages.sfm.database import WorkImage, database_path, open_database
from tests.poses import looking_at

SIZE = 480, 360
COUNT, POINTS = 9, 250


def cameras(focal: tuple[float, ...] = (400.0,) * COUNT, cut: Sequence[tuple[int, int]] = ((0, 0),) * COUNT) -> list[Camera]:
    """Along a third of a circle, at different heights, looking at its middle.

    cut  pixels that are cut off at the left and at the top
    """
    made = []
    for k in range(COUNT):
        angle = 2.0 * k / COUNT
        centre = np.array([2 * np.cos(angle), 2 * np.sin(angle), 0.5 + 0.5 * np.sin(1.7 * k)])
        pose = looking_at(centre)
        made.append(Camera(f"{k}.png", *SIZE, "SIMPLE_RADIAL", (focal[k], SIZE[0] / 2 - cut[k][0], SIZE[1] / 2 - cut[k][1], -0.04), pose))
    return made


def clouds(count: int = COUNT, elsewhere: int = 0) -> list[np.ndarray]:
    """Points (POINTS, 3) as each camera finds them: the same for all, but the last few are a ball that is elsewhere for each."""
    rng = np.random.default_rng(0)
    still = rng.normal(0, 0.35, (POINTS, 3))
    ball = np.random.default_rng(1).normal(0, 1, (elsewhere, 3))
    ball *= 0.15 / np.maximum(np.linalg.norm(ball, axis=1, keepdims=True), 1e-9)
    places = [0.5 * np.array([np.sin(2.4 * k), np.cos(1.7 * k), 0.6 * np.sin(1.1 * k)]) for k in range(count)]
    return [np.concatenate([still[: POINTS - elsewhere], ball + place]) for place in places]


def matched(work: Path, taken: list[Camera], elsewhere: int = 0) -> list[WorkImage]:
    """Grey pictures, and a database of features where points of a cloud are seen, 0.4 px off, and of verified matches, of which 5 % were wrong before.

    elsewhere  points that moved between the pictures
    """
    rng = np.random.default_rng(0)
    rng.normal(0, 0.35, (POINTS, 3))  # the cloud
    (work / "images").mkdir(parents=True)
    images = [WorkImage(camera.name, f"{k:05d}.png", *SIZE, *SIZE, None, "one") for k, camera in enumerate(taken)]
    for image in images:
        Image.new("RGB", SIZE, (90, 90, 90)).save(work / "images" / image.file)
    open_database(work, images, print)
    seen = [project(camera, cloud)[0] + rng.normal(0, 0.4, (POINTS, 2)) for camera, cloud in zip(taken, clouds(len(taken), elsewhere), strict=True)]
    inside = [((xy > 0) & (xy < SIZE)).all(1) for xy in seen]
    with quiet_pycolmap() as pycolmap, pycolmap.Database.open(database_path(work)) as database:
        camera = database.read_all_cameras()[0]
        options = pycolmap.TwoViewGeometryOptions()
        options.ransac.random_seed = 0
        for k, xy in enumerate(seen):
            database.write_keypoints(k + 1, np.clip(xy, 0, None).astype(np.float32))
            database.write_descriptors(k + 1, pycolmap.FeatureDescriptors(data=np.zeros((POINTS, 128), np.uint8), type=pycolmap.FeatureExtractorType.SIFT))
        for i in range(COUNT):
            for j in range(i + 1, COUNT):
                both = np.flatnonzero(inside[i] & inside[j] & (rng.random(POINTS) < 0.9 ** (j - i)))
                pairs = np.stack([both, both], 1).astype(np.uint32)
                wrong = rng.random(len(both)) < 0.05
                pairs[wrong, 1] = rng.permutation(pairs[wrong, 1])
                database.write_matches(i + 1, j + 1, pairs)
                geometry = pycolmap.estimate_two_view_geometry(camera, seen[i], camera, seen[j], pairs, options)
                database.write_two_view_geometry(i + 1, j + 1, geometry)
    return images


def synthesized(count: int, points: int, params: Sequence[float]) -> tuple[Any, list[WorkImage]]:
    """A model of so many cameras, SIMPLE_RADIAL of 1024 x 768 px, round points that all of them see."""
    pycolmap = import_pycolmap()
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig, options.num_points3D = 1, 1, count, points
    options.camera_model_id, options.camera_params = pycolmap.CameraModelId.SIMPLE_RADIAL, [*params]
    model = pycolmap.synthesize_dataset(options)
    return model, [WorkImage(image.name, image.name, 1024, 768, 1024, 768, None, "") for image in model.images.values()]


def centres_of(model: Any) -> np.ndarray:
    return np.array([model.images[i].projection_center() for i in sorted(model.reg_image_ids())])


def registered(model: Any) -> list[Any]:
    return sorted((image for image in model.images.values() if image.has_pose), key=lambda image: image.name)


def off(model: Any, taken: list[Camera]) -> float:
    """Root mean square of the distances of the centres from the true ones."""
    centres = np.array([image.projection_center() for image in registered(model)])
    return float(np.sqrt((aligned_errors(centres, np.array([camera.centre for camera in taken])) ** 2).mean()))
