"""Verified matches to cameras: COLMAP's incremental mapper, attempted with falling demands, and a last robust bundle adjustment."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from efficientnerf.geometry.cameras import Camera, rays
from stages.sfm import matches
from stages.sfm.matches import WorkImage

FEWEST = 3  # photographs that make a model

# Each attempt asks for less than the one before; a later one is made only where photographs are left over.
# The first wants a starting pair that sees the scene from angles 16 degrees apart and agrees in 100 points. The second is for little texture and
# little parallax. The third also trusts points that two photographs alone have seen, or nearly along one line, as when walking forward.
_FEW = {"mapper": {"init_min_tri_angle": 4.0, "init_min_num_inliers": 40, "abs_pose_min_num_inliers": 15}}
ATTEMPTS: tuple[Mapping[str, Mapping[str, object]], ...] = (
    {},
    _FEW,
    {
        "mapper": {**_FEW["mapper"], "init_max_forward_motion": 1.0, "filter_min_tri_angle": 0.5},
        "triangulation": {"ignore_two_view_tracks": False, "min_angle": 0.5},
    },
)
LAST_RESORT_BELOW = 0.9  # share of photographs placed; above it, the third attempt is not made


def models_of(work: Path, images: Sequence[WorkImage], seed: int, progress: matches.Progress, safe_point: matches.SafePoint) -> list[Any]:
    """The models of the best attempt: the one that places most photographs, counted by how far their matches agree with it."""
    best: list[Any] = []
    best_score = -1.0
    for attempt, demands in enumerate(ATTEMPTS):
        if registered(best) >= (len(images) if attempt == 1 else LAST_RESORT_BELOW * len(images)):
            break
        models = _map(work, len(images), seed, demands, progress, safe_point)
        models = _with_known_lens(work, images, seed, demands, models, progress, safe_point)
        score = registered(models) * agreement_of(work, images, models[0]) if models else 0.0
        if score > best_score:
            best, best_score = models, score
    return best


def _with_known_lens(
    work: Path,
    images: Sequence[WorkImage],
    seed: int,
    demands: Mapping[str, Mapping[str, object]],
    models: list[Any],
    progress: matches.Progress,
    safe_point: matches.SafePoint,
) -> list[Any]:
    """`models`, or those found with the lens of the EXIF data where the photographs do not determine it (walking straight on does not) and
    the recovered focal length is far off: if they place as many photographs about as well."""
    if not models or not any(far_off(camera.focal_length, prior) for camera, prior in _lenses(images, models[0])):
        return models
    fixed = _map(work, len(images), seed, demands, progress, safe_point, refine_lens=False)
    if registered(fixed) >= registered(models) and fixed[0].compute_mean_reprojection_error() < 1.15 * models[0].compute_mean_reprojection_error():
        return fixed
    return models


def _lenses(images: Sequence[WorkImage], model: Any) -> list[tuple[Any, float | None]]:
    """Each camera of a model at working size with its focal length by EXIF there, or None."""
    prior = {image.file: image.focal and image.focal * image.work_width / image.width for image in images}
    found = {image.camera_id: prior[image.name] for image in model.images.values() if image.has_pose}
    return [(model.cameras[camera_id], focal) for camera_id, focal in sorted(found.items())]


def far_off(focal: float, prior: float | None) -> bool:
    return prior is not None and not 0.75 < focal / prior < 1.33


def _map(
    work: Path,
    count: int,
    seed: int,
    demands: Mapping[str, Mapping[str, object]],
    progress: matches.Progress,
    safe_point: matches.SafePoint,
    *,
    refine_lens: bool = True,
) -> list[Any]:
    """Every model that the mapper finds, the one with most photographs (then points) first; on one thread, as two are not repeatable."""
    with matches.quiet_pycolmap() as pycolmap:
        options = pycolmap.IncrementalPipelineOptions()
        options.num_threads = options.mapper.num_threads = 1
        options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = seed
        options.min_model_size = FEWEST
        for part, values in demands.items():
            getattr(options, part).mergedict(dict(values))
        options.ba_refine_focal_length = options.ba_refine_extra_params = refine_lens
        options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = refine_lens
        placed = 0

        def one_more() -> None:
            nonlocal placed
            safe_point()
            placed = min(placed + 1, count)
            progress(placed, count, "placing cameras")

        output = work / "models"
        shutil.rmtree(output, ignore_errors=True)
        output.mkdir()
        pycolmap.set_random_seed(seed)
        safe_point()
        models = pycolmap.incremental_mapping(
            matches.database_path(work), work / "images", output, options, initial_image_pair_callback=one_more, next_image_callback=one_more
        )
        shutil.rmtree(output)
    safe_point()
    return [model for _, model in sorted(models.items(), key=lambda item: (-item[1].num_reg_images(), -item[1].num_points3D(), item[0]))]


def refined(work: Path, images: Sequence[WorkImage], model: Any, safe_point: matches.SafePoint) -> Any:
    """The model after a last bundle adjustment with Cauchy's loss at the scale of its own reprojection error.

    The mapper's squared loss lets the matches that are wrong by a few pixels pull at everything; on the sample photographs the robust
    one leaves a third of the error of the camera centres. Lenses that SIMPLE_RADIAL does not describe get OPENCV's eight parameters,
    where these lower the mean reprojection error by 1 %; with thousands of observations, what no lens explains does not. (All must be
    adjusted for the comparison: points and poses hide most of what a lens does wrong.) Where the motion does not determine a lens, the
    parameters drift to what no lens has, and the matches that the mapper dropped agree less: then they are not taken. A lens held at its
    EXIF data stays.
    """
    with matches.quiet_pycolmap() as pycolmap:
        held = {camera.camera_id for camera, prior in _lenses(images, model) if camera.focal_length == prior}
        safe_point()
        _adjust(pycolmap, model, held)
        counts = _lens_counts(model)
        bendable = [camera_id for camera_id in sorted(counts) if camera_id not in held and counts[camera_id] >= 10]  # fewer photographs would fit anything
        if not bendable:
            return model
        richer = model.__deepcopy__({})
        for camera_id in bendable:
            camera = richer.cameras[camera_id]
            f, cx, cy, k = camera.params
            camera.model, camera.params = pycolmap.CameraModelId.OPENCV, [f, f, cx, cy, k, 0.0, 0.0, 0.0]
        safe_point()
        _adjust(pycolmap, richer, held)
        better = richer.compute_mean_reprojection_error() < 0.99 * model.compute_mean_reprojection_error()
    square = all(abs(richer.cameras[i].focal_length_x / richer.cameras[i].focal_length_y - 1) < 0.02 for i in bendable)
    return richer if better and square and agreement_of(work, images, richer) >= agreement_of(work, images, model) - 0.001 else model


def _lens_counts(model: Any) -> dict[int, int]:
    counts: dict[int, int] = {}
    for image in model.images.values():
        if image.has_pose:
            counts[image.camera_id] = counts.get(image.camera_id, 0) + 1
    return counts


def _adjust(pycolmap: Any, model: Any, held_lenses: set[int]) -> None:
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = float(np.clip(model.compute_mean_reprojection_error(), 0.1, 2.0))
    solver = options.ceres.solver_options
    solver.num_threads = 1
    solver.max_num_iterations = 50
    solver.function_tolerance = 1e-6
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in sorted(model.reg_image_ids()):
        config.add_image(image_id)
    for camera_id in held_lenses:
        config.set_constant_cam_intrinsics(camera_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    model.update_point_3d_errors()


def registered(models: Sequence[Any]) -> int:
    return int(models[0].num_reg_images()) if models else 0


def agreement_of(work: Path, images: Sequence[WorkImage], model: Any) -> float:
    by_file = {image.file: image for image in images}
    return pair_agreement(work, {image.image_id: camera_of(model, image, by_file[image.name]) for image in model.images.values() if image.has_pose})


def camera_of(model: Any, image: Any, source: WorkImage) -> Camera:
    pose = np.eye(4)
    camera_from_world = np.asarray(image.cam_from_world().matrix())
    pose[:3, :3] = camera_from_world[:, :3].T
    pose[:3, 3] = -camera_from_world[:, :3].T @ camera_from_world[:, 3]
    lens = model.cameras[image.camera_id]
    return Camera(source.name, source.work_width, source.work_height, lens.model_name, tuple(float(p) for p in lens.params), pose)


def pair_agreement(work: Path, cameras: Mapping[int, Camera], *, tolerance: float = 4.0) -> float:
    """How much of what the photographs say in pairs the cameras confirm: the share of matches, verified by two photographs alone, whose
    rays pass each other within `tolerance` pixels of the working size. COLMAP drops what does not fit, so that its own reprojection error
    is small even where a facade with equal windows was folded onto itself; this share is not.

    cameras  by COLMAP's image id, at working size
    """
    agreeing = total = 0
    with matches.quiet_pycolmap() as pycolmap, pycolmap.Database.open(matches.database_path(work)) as database:
        directions = {
            image_id: rays(camera, np.asarray(database.read_keypoints(image_id), np.float64)[:, :2])[1] for image_id, camera in cameras.items()
        }  # (N, 3) each
        for first, second in matches.verified_pairs(matches.database_path(work)):
            if first not in cameras or second not in cameras:
                continue
            inliers = np.asarray(database.read_two_view_geometry(first, second).inlier_matches)
            if len(inliers) < 30:
                continue
            a, b = directions[first][inliers[:, 0]], directions[second][inliers[:, 1]]
            baseline = cameras[second].centre - cameras[first].centre
            plane = np.cross(baseline, b)  # the epipolar plane of the second ray
            sine = np.abs((plane * a).sum(1)) / np.maximum(np.linalg.norm(plane, axis=1), 1e-12)
            focal = cameras[first].intrinsics["fx"]
            agreeing += int((sine * focal < tolerance).sum())
            total += len(inliers)
    return agreeing / total if total else 1.0
