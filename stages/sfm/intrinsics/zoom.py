"""Whether photographs of one camera were zoomed or cropped, each by itself; and cameras for those that were cropped. docs/experiments/sfm.md"""

from collections.abc import Iterator
from copy import deepcopy
from typing import Any

import numpy as np

from pipeline.files import SafePoint
from stages.sfm.colmap import quiet_pycolmap
from stages.sfm.mapping import bundle_adjust

OBSERVATIONS = 30, 400  # of a photograph: fewer say nothing of its lens, of more some are taken
ITERATIONS, CONVERGED = 200, 1e-9  # principal points move slowly, and the cost changes little meanwhile
TOLERANCE = 1.0  # px of a reprojection error, beyond which an observation counts less


def _observations(model: Any) -> Iterator[tuple[Any, np.ndarray, np.ndarray]]:
    """(image, (N, 2) pixels, (N, 3) points) of each registered photograph, in order."""
    least, most = OBSERVATIONS
    for image_id in sorted(model.reg_image_ids()):
        image = model.images[image_id]
        seen = image.get_observation_points2D()
        if len(seen) >= least:
            seen = seen[:: -(-len(seen) // most)]
            yield image, np.array([point.xy for point in seen]), np.array([model.points3D[point.point3D_id].xyz for point in seen])


def focal_length_spread(model: Any) -> float:
    """How far the focal lengths differ that single photographs have by themselves, the points staying where they are: the largest ratio of one of them, in
    units of that of its camera, to their median. About 1 where the zoom did not change."""
    own = []
    with quiet_pycolmap() as pycolmap:
        options = pycolmap.AbsolutePoseRefinementOptions()
        options.refine_focal_length = True
        for image, at, points in _observations(model):
            camera = deepcopy(model.cameras[image.camera_id])
            before = camera.mean_focal_length()
            if pycolmap.refine_absolute_pose(image.cam_from_world(), at, points, np.ones(len(at), bool), camera, options) is not None:
                own.append(camera.mean_focal_length() / before)
    return float(np.exp(np.abs(np.log(own) - np.log(np.median(own))).max())) if own and min(own) > 0 else 1.0


def principal_point_spread(model: Any) -> float:
    """How far the principal points differ that single photographs have by themselves, the points staying where they are: root of the mean squared distance
    from their mean, over the longest side. About 0 where none was cropped, or all alike."""
    shifts = []
    with quiet_pycolmap():
        for image, at, points in _observations(model):
            camera = model.cameras[image.camera_id]
            pose = image.cam_from_world().matrix()
            seen = points @ pose[:, :3].T + pose[:, 3]  # (N, 3)
            shown = [camera.img_from_cam(each) if each[2] > 0 else None for each in seen]  # none of what is behind, or beyond the lens's distortion
            off = at - np.array([(np.nan, np.nan) if xy is None else xy for xy in shown])  # (N, 2)
            usable = np.isfinite(off).all(1)
            if usable.sum() >= OBSERVATIONS[0]:
                shift = _principal_point_shift(seen[usable], off[usable], camera.mean_focal_length())
                shifts.append(shift / max(camera.width, camera.height))
    return float(np.sqrt(((np.array(shifts) - np.mean(shifts, 0)) ** 2).sum(1).mean())) if shifts else 0.0


def _principal_point_shift(seen: np.ndarray, off: np.ndarray, focal: float) -> np.ndarray:
    """(2,) pixels: one step of least squares for pose and principal point.

    seen  (N, 3) points in the camera's frame
    off   (N, 2) pixels, what was observed minus what is projected
    """
    u, v, near = seen[:, 0] / seen[:, 2], seen[:, 1] / seen[:, 2], focal / seen[:, 2]
    none, one = np.zeros_like(u), np.ones_like(u)
    # Columns: rotation about x, y, z; translation along x, y, z; principal point. Lens distortion changes these little.
    across = np.stack([-focal * u * v, focal * (1 + u * u), -focal * v, near, none, -u * near, one, none], -1)  # (N, 8)
    down = np.stack([-focal * (1 + v * v), focal * u * v, focal * u, none, near, -v * near, none, one], -1)
    weight = 1 / np.sqrt(1 + (off / TOLERANCE) ** 2).T.ravel()  # (2N,)
    return np.asarray(np.linalg.lstsq(np.concatenate([across, down]) * weight[:, None], off.T.ravel() * weight, rcond=None)[0][6:])


def with_principal_points(model: Any, safe_point: SafePoint) -> Any:
    """The model adjusted so that each of its cameras, SIMPLE_RADIAL and of one photograph each, has a principal point of its own, but all the same focal
    length and distortion, as of one lens: a photograph by itself does not determine them all.

    The distortion found before assumes uncropped photographs, and is a wrong start.
    """
    adjusted = deepcopy(model)
    used = sorted({adjusted.images[image_id].camera_id for image_id in adjusted.reg_image_ids()})
    for shared, refined in (({3: 0.0}, ("focal_length",)), ({0: None}, ("extra_params",)), ({3: None}, ())):
        safe_point()
        values = np.array([adjusted.cameras[camera_id].params for camera_id in used])  # (C, 4): focal length, principal point, distortion
        for column, value in shared.items():
            values[:, column] = np.median(values[:, column]) if value is None else value
        for camera_id, params in zip(used, values, strict=True):
            adjusted.cameras[camera_id].params = params
        changes = {"refine_principal_point": True, **{f"refine_{name}": name in refined for name in ("focal_length", "extra_params")}}
        with quiet_pycolmap() as pycolmap:
            bundle_adjust(pycolmap, adjusted, set(), changes, ITERATIONS, CONVERGED)
    return adjusted
