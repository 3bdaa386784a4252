"""A first quick training of all that photographs show; the subject is found in it.

It is small and always on the CPU: a scene has the same bytes whatever its later stages compute on.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from efficientnerf.geometry.cameras import Camera, resized
from efficientnerf.geometry.spaces import space_from
from efficientnerf.model import Model, model
from efficientnerf.training import loop
from efficientnerf.training.pixels import Pixels
from efficientnerf.training.settings import TrainSettings
from pipeline.stage import Job
from stages.cores import use_all_cores
from stages.framing.training_frame import find_training_frame
from stages.io.capture import Capture
from stages.io.field_file import space_of
from stages.io.scene import Scene, View, save_points
from stages.memory.need import Need
from stages.train.data import sparse_depth_of
from stages.train.memory import needed
from stages.train.priors import filled_points, mask_cells_by

# docs/experiments/silhouettes.md
SIDE = 320  # px, longest side of the photographs that it is trained on
RAYS = 2**18  # of theirs, in which the subject is looked for
FIELD_SAMPLES = 300  # bytes of such a ray
FIRST = TrainSettings(iterations=1200, log2_hashmap_size=17, finest_resolution=1024, num_coarse_samples=128, occupancy_resolution=192)


@dataclass(frozen=True, eq=False)
class FirstField:
    """A trained field of a whole scene."""

    model: Model
    # near, far: of all views, along their axes
    near: float
    far: float
    cameras: tuple[Camera, ...]  # of the photographs, in the training frame, at the size that was trained on
    pixels: Pixels  # that it was trained on


def first_training_needed(count: int) -> Need:
    """Memory of a first training of so many photographs."""
    space = space_from(np.array([[-1.0] * 3, [1.0] * 3]), contracted=True)
    camera = Camera("", SIDE, SIDE, "SIMPLE_PINHOLE", (SIDE, SIDE / 2, SIDE / 2), np.eye(4))
    view = View("", None, "train", camera, camera, 0.1, 1.0)
    need = needed(FIRST, [view] * count, 3, space)
    return Need({**need.terms, "samples of the field": FIELD_SAMPLES * RAYS})


def first_field(job: Job, capture: Capture, images: Sequence[np.ndarray]) -> FirstField:
    """The field of a capture, without regard to masks. An interrupted training starts again: it is short.

    images  (H, W, 3) uint8 of the photographs, upright
    """
    use_all_cores()
    folder = job.work / "first_training"
    folder.mkdir(exist_ok=True)
    scene = _scene(capture, [(image.shape[1], image.shape[0]) for image in images], folder)
    cameras = [view.camera for view in scene.views]
    near, far = np.array([(view.near, view.far) for view in scene.views]).T
    pixels = Pixels(cameras, images, [None] * len(images), near, far, 3)
    m = model(space_of(scene), FIRST, None, "cpu", (float(near.min()), float(far.max())))
    mask_cells_by(m, cameras, near.tolist(), None, filled_points(folder, len(cameras)))
    for done in loop.train(loop.trainer(m), pixels, sparse_depth_of(folder, scene, FIRST.seed)):
        job.reached(done.step, FIRST.iterations, "a first training, to find the foreground")
    return FirstField(m, float(near.min()), float(far.max()), tuple(cameras), pixels)


def _scene(capture: Capture, sizes: list[tuple[int, int]], folder: Path) -> Scene:
    """The scene of a capture with photographs of these sizes (width, height), all of them for training; its points are written to the folder."""
    framed = find_training_frame(capture, space="contracted")
    world = framed.world_from_capture
    views = []
    for photo, size, (near, far) in zip(capture.photos, sizes, framed.near_far_planes, strict=True):
        camera = world.camera(resized(photo.camera, *size))
        views.append(View(photo.camera.name, None, "train", camera, photo.camera, float(near), float(far)))
    if capture.points is not None:
        save_points(replace(capture.points, xyz=world.points(capture.points.xyz)), folder)
    return Scene(capture.kind, tuple(views), framed.bounds, None, world, framed.orbit, points=capture.points is not None, space="contracted")
