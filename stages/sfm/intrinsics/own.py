"""Intrinsics of its own for each photograph, where they explain observations that they were not fitted to.

A lens that focuses nearer has another focal length ("focus breathing"), and stabilisation moves the lens or crops the frame. Both change from photograph to
photograph by a few per cent, which one camera for all cannot follow. More parameters always fit better, so a fifth of the observations is left out as a
test of the fit to the others. docs/experiments/sfm.md
"""

from collections.abc import Sequence
from copy import deepcopy
from typing import Any, NamedTuple

import numpy as np

from stages.sfm.colmap import quiet_pycolmap
from stages.sfm.database import WorkImage
from stages.sfm.images import SafePoint
from stages.sfm.mapping import bundle_adjust, cameras_with_fixed_focal, thinned

# Richer from left to right: what each photograph has of its own, and what is refined then. Distortion stays that of the lens.
FOCAL_LENGTH, PRINCIPAL_POINT = "focal lengths", "focal lengths and principal points"
REFINED = {
    FOCAL_LENGTH: {"refine_extra_params": False},
    PRINCIPAL_POINT: {"refine_extra_params": False, "refine_principal_point": True},
}
CHOICES = tuple(REFINED)
# Times the error of the observations that were left out, to which a richer choice must lower it. A principal point is nearly a rotation: it fits what is no
# matter of the lens, and costs accuracy of the centres.
MAX_ERROR_RATIO = {FOCAL_LENGTH: 0.97, PRINCIPAL_POINT: 0.9}
LEFT_OUT_EVERY, MIN_TRACK = 5, 4  # every 5th observation, of points that have so many
SAMPLED_OBSERVATIONS = 40_000  # observations, of about which it is decided
MIN_OBSERVATIONS = 60  # observations of a photograph, with fewer of which it has the intrinsics of all
MAX_MISS = 4.0  # pixels, beyond which an error counts no more: a wrong match


class Observation(NamedTuple):
    image: int
    point: int
    xy: np.ndarray  # (2,) pixels


def with_own_intrinsics(images: Sequence[WorkImage], model: Any, safe_point: SafePoint) -> tuple[Any, str | None]:
    """The model whose photographs have intrinsics of their own, and which; or the model as it is, and None.

    Image and point ids stay; each photograph gets a camera whose id is that of the image, and keeps the keypoints alone that observe a point.
    """
    if cameras_with_fixed_focal(images, model):
        return model, None
    with quiet_pycolmap() as pycolmap:
        chosen = _choice(pycolmap, thinned(model, SAMPLED_OBSERVATIONS) or model, safe_point)
        if chosen is None:
            return model, None
        own = _with_own_cameras(pycolmap, model)
        for choice in CHOICES[: CHOICES.index(chosen) + 1]:
            safe_point()
            bundle_adjust(pycolmap, own, _poorly_observed(own), REFINED[choice])
    return own, chosen


def _choice(pycolmap: Any, model: Any, safe_point: SafePoint) -> str | None:
    """The richest of the choices that explains what was left out better than the one before it; None: intrinsics that all photographs share."""
    model, observations = _without_some(_with_own_cameras(pycolmap, model))
    if not observations:
        return None
    shared = deepcopy(model)
    bundle_adjust(pycolmap, shared, {*shared.cameras})
    chosen, least = None, _error(shared, observations)
    for choice in CHOICES:
        safe_point()
        bundle_adjust(pycolmap, model, _poorly_observed(model), REFINED[choice])
        error = _error(model, observations)
        if error < MAX_ERROR_RATIO[choice] * least:
            chosen, least = choice, error
    return chosen


def _with_own_cameras(pycolmap: Any, model: Any) -> Any:
    """A copy of a model, with a camera for each photograph, of the parameters that it had."""
    own = pycolmap.Reconstruction()
    place: dict[int, dict[int, int]] = {}  # of an image: number of a keypoint -> its number among those that are kept
    for image_id in sorted(model.reg_image_ids()):
        image = model.images[image_id]
        camera = deepcopy(model.cameras[image.camera_id])
        camera.camera_id = image_id
        own.add_camera_with_trivial_rig(camera)
        observed = [number for number, point in enumerate(image.points2D) if point.has_point3D()]
        place[image_id] = {number: at for at, number in enumerate(observed)}
        points = [pycolmap.Point2D(image.points2D[number].xy) for number in observed]
        own.add_image_with_trivial_frame(pycolmap.Image(name=image.name, camera_id=image_id, image_id=image_id, points2D=points), image.cam_from_world())
    for point_id, point in sorted(model.points3D.items()):
        track = pycolmap.Track()
        for element in point.track.elements:
            track.add_element(element.image_id, place[element.image_id][element.point2D_idx])
        own.add_point3D_with_id(point_id, pycolmap.Point3D(xyz=point.xyz, color=point.color, error=point.error, track=track))
    return own


def _without_some(model: Any) -> tuple[Any, list[Observation]]:
    """The model without every fifth observation of points that have several, and these."""
    left_out: list[Observation] = []
    number = 0
    for point_id in sorted(model.point3D_ids()):
        elements = sorted((element.image_id, element.point2D_idx) for element in model.points3D[point_id].track.elements)
        for image_id, index in elements if len(elements) >= MIN_TRACK else ():
            number += 1
            if number % LEFT_OUT_EVERY == 0:
                left_out.append(Observation(image_id, point_id, np.array(model.images[image_id].points2D[index].xy)))
                model.delete_observation(image_id, index)
    return model, left_out


def _poorly_observed(model: Any) -> set[int]:
    """Cameras, one for each photograph, of those that observe few points."""
    return {image.camera_id for image in model.images.values() if image.num_points3D < MIN_OBSERVATIONS}


def _error(model: Any, observations: Sequence[Observation]) -> float:
    """Mean distance in pixels between observations and the projections of their points, MAX_MISS at most."""
    by_image: dict[int, list[Observation]] = {}
    for one in observations:
        if one.point in model.points3D:
            by_image.setdefault(one.image, []).append(one)
    errors = []
    for image_id, ones in sorted(by_image.items()):
        image = model.images[image_id]
        pose, camera = image.cam_from_world().matrix(), model.cameras[image.camera_id]
        seen = np.array([model.points3D[one.point].xyz for one in ones]) @ pose[:, :3].T + pose[:, 3]  # (N, 3)
        for one, at in zip(ones, seen, strict=True):
            shown = camera.img_from_cam(at) if at[2] > 0 else None
            errors.append(MAX_MISS if shown is None else min(MAX_MISS, float(np.linalg.norm(shown - one.xy))))
    return float(np.mean(errors)) if errors else 0.0
