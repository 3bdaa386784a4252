"""Verified matches to cameras: COLMAP's incremental mapper, and a final robust bundle adjustment. `stages.sfm.reconstruction` says what is attempted when.

See docs/experiments/sfm.md.
"""

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from efficientnerf.capture.moving_parts import moving_parts
from efficientnerf.geometry.cameras import Camera, Similarity, epipolar_error, rays
from pipeline.files import SafePoint, remove
from stages.sfm.added.markers import tie_markers
from stages.sfm.colmap import every_image_read, quiet_pycolmap
from stages.sfm.database import WorkImage, database_path, images_of, inlier_counts, mapper_database
from stages.sfm.images import Progress

MIN_MODEL_SIZE = 3  # registered photographs
MIN_MATCHES = 30  # verified ones of a pair, from which it says something about cameras
MAX_EPIPOLAR_ERROR = 4.0  # px at working size, of the epipolar error of a match that agrees with the cameras
MANY_OBSERVATIONS = 150_000  # of points in images; of more, an even choice holds the cameras as well
MIN_REGISTERED_RATIO = 0.95  # of the photographs: later steps may bring back the others
# A focal length farther from its EXIF data than this (of its logarithm) has to lower the reprojection error by this many times as much, else that of the EXIF
# data is used: photographs straight down on flat ground, or a way straight ahead, do not determine it. docs/experiments/sfm.md
MAX_EXIF_DEVIATION, MIN_ERROR_GAIN = 0.1, 0.5
FEW_POINTS = 300  # points: a photograph with no more keeps all of them
# Global bundle adjustments: one each time photographs or points have grown by these ratios, over the points that hold the cameras, and loosely converged,
# for `bundle_adjusted` follows. COLMAP's own options take twice the time. docs/experiments/sfm.md
ADJUSTMENTS: Mapping[str, object] = {
    "ba_global_frames_ratio": 1.4,
    "ba_global_points_ratio": 1.4,
    "ba_global_max_refinements": 2,
    "ba_local_max_refinements": 1,
    "ba_global_function_tolerance": 1e-5,
    "ba_local_function_tolerance": 1e-5,
}
# Options of attempts. COLMAP's defaults want an initial pair with a triangulation angle of 16 degrees and 100 inliers. RELAXED is for little texture and
# little parallax. FORWARD also keeps two-view tracks and points with small triangulation angles, as of forward motion.
Options = Mapping[str, Mapping[str, object]]
DEFAULTS: Options = {}
RELAXED: Options = {"mapper": {"init_min_tri_angle": 4.0, "init_min_num_inliers": 40, "abs_pose_min_num_inliers": 15}}
FORWARD: Options = {
    "mapper": {**RELAXED["mapper"], "init_max_forward_motion": 1.0, "filter_min_tri_angle": 0.5},
    "triangulation": {"ignore_two_view_tracks": False, "min_angle": 0.5},
}


def sub_models(work: Path, images: Sequence[WorkImage], seed: int, options: Options, progress: Progress, safe_point: SafePoint) -> list[Any]:
    """The sub-models that are found from the matches, largest first.

    Where a focal length contradicts its EXIF data (forward motion does not determine it), those found with intrinsics fixed at the EXIF data, if they
    register nearly as many photographs with about the same reprojection error.
    """
    models = _incremental_mapping(work, len(images), seed, options, progress, safe_point)
    if not models or not any(contradicts_exif(camera.mean_focal_length(), prior) for camera, prior in _cameras_with_exif_focal(images, models[0])):
        return models
    fixed = _incremental_mapping(work, len(images), seed, options, progress, safe_point, refine_camera=False)
    enough = fixed and num_registered(fixed) >= MIN_REGISTERED_RATIO * num_registered(models)
    if enough and fixed[0].compute_mean_reprojection_error() < 1.15 * models[0].compute_mean_reprojection_error():
        return fixed
    return models


def continued(work: Path, images: Sequence[WorkImage], model: Any, seed: int, progress: Progress, safe_point: SafePoint) -> list[Any]:
    """A model with more photographs registered, as far as the matches of `work` let them, and other sub-models; largest first."""
    fixed = bool(cameras_with_fixed_focal(images, model))
    return _incremental_mapping(work, len(images), seed, RELAXED, progress, safe_point, refine_camera=not fixed, start=model)


def _cameras_with_exif_focal(images: Sequence[WorkImage], model: Any) -> list[tuple[Any, float | None]]:
    """Each camera of a model, at working size, and its focal length by EXIF data at that size, or None."""
    prior = {image.file: image.focal and image.focal * image.work_width / image.width for image in images}
    found = {image.camera_id: prior[image.name] for image in model.images.values() if image.has_pose}
    return [(model.cameras[camera_id], focal) for camera_id, focal in sorted(found.items())]


def cameras_with_fixed_focal(images: Sequence[WorkImage], model: Any) -> set[int]:
    """COLMAP's ids of the cameras whose intrinsics were fixed at their EXIF data."""
    return {camera.camera_id for camera, prior in _cameras_with_exif_focal(images, model) if camera.mean_focal_length() == prior}


def _with_exif_focal(pycolmap: Any, images: Sequence[WorkImage], model: Any) -> Any:
    """The model with the focal lengths of the EXIF data, where its own are far from them without explaining the observations much better."""
    priors = [(camera, prior) for camera, prior in _cameras_with_exif_focal(images, model) if prior]
    deviations = [abs(math.log(camera.mean_focal_length() / prior)) for camera, prior in priors]
    if not deviations or max(deviations) < MAX_EXIF_DEVIATION:
        return model
    held = model.__deepcopy__({})
    for camera, prior in priors:
        for number in camera.focal_length_idxs():
            held.cameras[camera.camera_id].params[number] = prior
    fixed = cameras_with_fixed_focal(images, model) | ({*held.cameras} - {camera.camera_id for camera, _ in priors})
    for _ in range(2):  # the first goes far, under a loss of the wide scale that it begins with
        bundle_adjust(pycolmap, held, fixed, {"refine_focal_length": False})
    gain = held.compute_mean_reprojection_error() / model.compute_mean_reprojection_error() - 1
    return held if gain < MIN_ERROR_GAIN * float(np.mean(deviations)) else model


def contradicts_exif(focal: float, prior: float | None) -> bool:
    return prior is not None and not 0.75 < focal / prior < 1.33


def _incremental_mapping(
    work: Path, count: int, seed: int, options_of_attempt: Options, progress: Progress, safe_point: SafePoint, *, refine_camera: bool = True,
    start: Any = None,
) -> list[Any]:
    """All sub-models, by the number of registered photographs, then of points. On one thread: with two the results vary."""
    with quiet_pycolmap() as pycolmap:
        options = pipeline_options(pycolmap, seed, options_of_attempt)
        options.ba_refine_focal_length = options.ba_refine_extra_params = refine_camera
        options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = refine_camera
        registered = 0

        def one_more() -> None:
            nonlocal registered
            safe_point()
            registered = min(registered + 1, count)
            progress(registered, count, "registering images")

        output, begun = work / "models", work / "model_so_far"
        for folder in (output, begun):
            remove(folder)
            folder.mkdir()
        if start is not None:
            start.write(begun)
            registered = start.num_reg_images()
        tie_markers(work, seed, safe_point)
        pycolmap.set_random_seed(seed)
        safe_point()
        with every_image_read(pycolmap, work):  # for the colours of its points
            models = pycolmap.incremental_mapping(
                mapper_database(work),
                images_of(work),
                output,
                options,
                begun if start is not None else "",
                initial_image_pair_callback=one_more,
                next_image_callback=one_more,
            )
        for folder in (output, begun):
            remove(folder)
    safe_point()
    return [model for _, model in sorted(models.items(), key=lambda item: (-item[1].num_reg_images(), -item[1].num_points3D(), item[0]))]


def pipeline_options(pycolmap: Any, seed: int, options_of_attempt: Options) -> Any:
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = options.mapper.num_threads = 1
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = seed
    options.min_model_size = MIN_MODEL_SIZE
    options.mergedict(dict(ADJUSTMENTS))
    options.mapper.ba_global_ignore_redundant_points3D = True
    for part, values in options_of_attempt.items():
        getattr(options, part).mergedict(dict(values))
    return options


def bundle_adjusted(work: Path, images: Sequence[WorkImage], model: Any, safe_point: SafePoint) -> Any:
    """The model after a final bundle adjustment with Cauchy's loss at the scale of its own mean reprojection error: the mapper's squared loss is not
    robust to matches that are wrong by a few pixels.

    Cameras get OPENCV's eight parameters in place of SIMPLE_RADIAL where these lower the mean reprojection error by 1 %, after adjusting all
    parameters; unless the focal lengths then differ by 2 %, or fewer matches agree, which shows that the motion does not determine the intrinsics.
    Intrinsics fixed at the EXIF data stay, and focal lengths that are not determined become those of the EXIF data. Of a model with MANY_OBSERVATIONS an
    even choice of points tells the cameras; the others follow.
    """
    some = thinned(model, MANY_OBSERVATIONS)
    if some is None:
        return _with_adjusted_cameras(work, images, model, safe_point)
    some = _with_adjusted_cameras(work, images, some, safe_point)
    for camera_id, camera in some.cameras.items():
        model.cameras[camera_id].model, model.cameras[camera_id].params = camera.model, camera.params
    for frame_id in some.reg_frame_ids():
        model.frames[frame_id].rig_from_world = some.frames[frame_id].rig_from_world
    safe_point()
    with quiet_pycolmap() as pycolmap:
        model.update_point_3d_errors()
        bundle_adjust(pycolmap, model, {*model.cameras}, {"refine_rig_from_world": False})
    return model


def thinned(model: Any, most: int) -> Any:
    """A copy with an even choice of the points, of about `most` observations, and all points of the photographs that have few; None where there are no more."""
    every = -(-int(model.compute_num_observations()) // most)
    if every < 2:
        return None
    poor = [image for image in model.images.values() if image.num_points3D <= FEW_POINTS]
    needed = {point.point3D_id for image in poor for point in image.points2D if point.has_point3D()}
    some = model.__deepcopy__({})
    for number, point_id in enumerate(sorted(model.point3D_ids())):
        if number % every and point_id not in needed:
            some.delete_point3D(point_id)
    return some


def _with_adjusted_cameras(work: Path, images: Sequence[WorkImage], model: Any, safe_point: SafePoint) -> Any:
    """`bundle_adjusted` of all points of a model."""
    with quiet_pycolmap() as pycolmap:
        fixed = cameras_with_fixed_focal(images, model)
        safe_point()
        bundle_adjust(pycolmap, model, fixed)
        counts = Counter(image.camera_id for image in model.images.values() if image.has_pose)
        simple = {camera_id for camera_id in counts if model.cameras[camera_id].model == pycolmap.CameraModelId.SIMPLE_RADIAL}
        refinable = [camera_id for camera_id in sorted(simple - fixed) if counts[camera_id] >= 10]  # fewer would be overfitted
        if not refinable:
            return _with_exif_focal(pycolmap, images, model)
        richer = model.__deepcopy__({})
        for camera_id in refinable:
            camera = richer.cameras[camera_id]
            f, cx, cy, k = camera.params
            camera.model, camera.params = pycolmap.CameraModelId.OPENCV, [f, f, cx, cy, k, 0.0, 0.0, 0.0]
        safe_point()
        bundle_adjust(pycolmap, richer, fixed)
        better = richer.compute_mean_reprojection_error() < 0.99 * model.compute_mean_reprojection_error()
    square = all(abs(richer.cameras[i].focal_length_x / richer.cameras[i].focal_length_y - 1) < 0.02 for i in refinable)
    best = richer if better and square and match_agreement(work, richer) >= match_agreement(work, model) - 0.001 else model
    with quiet_pycolmap() as pycolmap:
        return _with_exif_focal(pycolmap, images, best)


def bundle_adjust(
    pycolmap: Any, model: Any, fixed_cameras: set[int], refined: Mapping[str, bool] | None = None, iterations: int = 50, tolerance: float = 1e-6
) -> None:
    """Adjust a model with Cauchy's loss.

    refined    changes of COLMAP's options of what is
    tolerance  share of the cost, below which an iteration that lowers it is the last
    """
    options = pycolmap.BundleAdjustmentOptions()
    options.mergedict(dict(refined or {}))
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = float(np.clip(model.compute_mean_reprojection_error(), 0.1, 2.0))
    solver = options.ceres.solver_options
    solver.num_threads = 1
    solver.max_num_iterations = iterations
    solver.function_tolerance = tolerance
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in sorted(model.reg_image_ids()):
        config.add_image(image_id)
    for camera_id in fixed_cameras:
        config.set_constant_cam_intrinsics(camera_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    pycolmap.ObservationManager(model).filter_observations_with_negative_depth()  # of which one alone makes the mean error infinite
    model.update_point_3d_errors()


def num_registered(models: Sequence[Any]) -> int:
    return int(models[0].num_reg_images()) if models else 0


def moving_shares(work: Path, images: Sequence[WorkImage], model: Any, safe_point: SafePoint) -> dict[str, float]:
    """Name of a photograph -> share of it that moves, of those in which anything does (`efficientnerf.capture.moving_parts`)."""
    cameras, names = cameras_of(model), {image.file: image.name for image in images}
    with quiet_pycolmap() as pycolmap, pycolmap.Database.open(database_path(work)) as database:

        def matches() -> Iterator[tuple[tuple[int, int], np.ndarray]]:
            for pair, count in inlier_counts(database_path(work)).items():
                if count >= MIN_MATCHES and all(image in cameras for image in pair):
                    safe_point()
                    yield pair, np.asarray(database.read_matches(*pair))

        keypoints = {image: np.asarray(database.read_keypoints(image), np.float64)[:, :2] for image in cameras}
        return {names[cameras[image].name]: round(share, 4) for image, share in moving_parts(cameras, keypoints, matches()).items()}


def cameras_of(model: Any) -> dict[int, Camera]:
    """By COLMAP's image id, of the photographs that have one."""
    return {image.image_id: camera_of(model, image) for image in model.images.values() if image.has_pose}


def camera_of(model: Any, image: Any) -> Camera:
    """At working size, by the name of the photograph's copy."""
    camera_from_world = np.asarray(image.cam_from_world().matrix())
    pose = Similarity(1.0, camera_from_world[:, :3].T, -camera_from_world[:, :3].T @ camera_from_world[:, 3]).matrix()
    lens = model.cameras[image.camera_id]
    return Camera(image.name, lens.width, lens.height, lens.model_name, tuple(float(p) for p in lens.params), pose)


def match_agreement(work: Path, model: Any) -> float:
    """The share of the verified matches of all pairs whose epipolar error is below MAX_EPIPOLAR_ERROR.

    COLMAP drops observations that do not fit, so that its reprojection error is small even where repeated structure was folded onto itself.
    """
    cameras, agreeing, total = cameras_of(model), 0, 0
    with quiet_pycolmap() as pycolmap, pycolmap.Database.open(mapper_database(work)) as database:
        directions = {
            image_id: rays(camera, np.asarray(database.read_keypoints(image_id), np.float64)[:, :2])[1] for image_id, camera in cameras.items()
        }  # (N, 3) each
        for (first, second), count in inlier_counts(mapper_database(work)).items():
            if count < MIN_MATCHES or first not in cameras or second not in cameras:
                continue
            inliers = np.asarray(database.read_two_view_geometry(first, second).inlier_matches)
            a, b = directions[first][inliers[:, 0]], directions[second][inliers[:, 1]]
            agreeing += int((epipolar_error(cameras[first], cameras[second], a, b) < MAX_EPIPOLAR_ERROR).sum())
            total += len(inliers)
    return agreeing / total if total else 1.0
