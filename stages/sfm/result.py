"""A model of COLMAP as a capture: cameras at the photographs' own size, points, facts, and the reasons why photographs have none."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import structs

from efficientnerf.geometry.cameras import Camera, resized
from pipeline.errors import BadInput
from pipeline.files import write_json
from stages.formats.importers.source import abbreviated
from stages.io.capture import Capture, Lens, Photo, Provenance, SparsePoints
from stages.sfm import mapping
from stages.sfm.attempts import OWN_FOCAL_LENGTHS, OWN_PRINCIPAL_POINTS, Search
from stages.sfm.colmap import quiet_pycolmap
from stages.sfm.database import WorkImage, database_path, inlier_counts, neighbours, planar_share
from stages.sfm.images import Masks
from stages.sfm.pairs import components
from stages.verdict.looks import look_at_all
from stages.verdict.parallax import parallax
from stages.verdict.verdict import WITHOUT_TEXTURE, failed

VERDICT = "verdict.json"  # in the scratch folder, where no cameras are found
MIN_FEATURES = 50  # of a photograph, below which it has too little detail
OWN_LENSES: dict[str, Lens] = {OWN_FOCAL_LENGTHS: "zoomed", OWN_PRINCIPAL_POINTS: "cropped"}  # by attempt
OTHER_LENS_RATIO = 1.2  # times a focal length: that of another lens
MAX_NAMES = 8  # photographs that an error lists by name
Rejected = Sequence[tuple[str, str]]  # name and reason of each


def capture_of(search: Search, model: Any, paths: Mapping[str, Path], masks: Masks, rejected: Rejected, found: Provenance) -> Capture:
    """The capture of a model that was adjusted, of the photographs of a search."""
    by_file = {image.file: image for image in search.images}
    registered = sorted((image for image in model.images.values() if image.has_pose), key=lambda image: image.name)
    sources = [by_file[image.name] for image in registered]
    photos = tuple(
        Photo(replace(resized(mapping.camera_of(model, image), source.width, source.height), name=source.name), paths[source.name], masks.get(source.name))
        for image, source in zip(registered, sources, strict=True)
    )
    points = _points(model, {image.image_id: i for i, image in enumerate(registered)})
    agreement = mapping.match_agreement(search.work, model)
    angle = round(parallax(points, photos).angle, 3)
    counts = {"photographs": len(search.images), "registered": len(photos), "points": len(points.xyz)}
    warnings = _model_warnings(photos, points, agreement, [source.focal for source in sources])
    if mapping.cameras_with_fixed_focal(search.images, model):
        warnings.append(
            "The photographs do not determine the focal length, and with it depths: that of the EXIF data is used. Photographs at other angles would tell, "
            "as some that are not taken straight down."
        )
    if rejected:
        which = abbreviated([name for name, _ in rejected], MAX_NAMES)
        warnings.append(f"{len(rejected)} photograph{'s' if len(rejected) > 1 else ''} not registered: {which}.")
    return Capture(
        kind="photographs",
        photos=photos,
        background=None,
        points=points,
        rejected=tuple(rejected),
        warnings=tuple(warnings),
        reprojection_error=float(model.compute_mean_reprojection_error()),
        provenance=structs.replace(found, **counts, triangulation_angle=angle, pairs_agreeing=round(agreement, 4)),
        overlaps=_overlaps(search.work, search.images),
    )


def provenance_of(search: Search, matching: str) -> Provenance:
    """How the photographs were matched, the sizes of the components of overlap and of the sub-models that add to the first, and the attempts."""
    parts = [{image.name for image in model.images.values() if image.has_pose} for model in search.models]
    return Provenance(
        matching=matching,
        components=[len(part) for part in components(neighbours(search.work, len(search.images)))],
        models=[len(part) for part in parts if part is parts[0] or part - parts[0]],
        attempts=search.tried,
        planar_pairs=planar_share(database_path(search.work)),
        lens=OWN_LENSES.get(search.best),
    )


def not_found(folder: Path, paths: Mapping[str, Path], search: Search, rejected: Rejected, matching: str) -> BadInput:
    """The error where most photographs have no camera; the verdict on them is written into the scratch folder."""
    hints = ["more photographs with at least 60 % overlap between neighbours, sharp, of a subject with texture"]
    if matching == "sequential":
        hints.append("--set poses.matching=exhaustive if the names do not follow the path of the camera")
    hints.append("--set poses.max_features=8192")
    worst, images, registered = dict(rejected), search.images, mapping.num_registered(search.models)
    fewest = max(mapping.MIN_MODEL_SIZE, -(-len(images) // 2))
    what = f"cameras found for {registered} of {len(images)} photographs; at least {fewest} are needed."
    looks = look_at_all({image.name: search.base / "images" / image.file for image in images}, paths)
    provenance, overlaps = provenance_of(search, matching), _overlaps(search.work, images)
    capture = Capture(kind="photographs", photos=(), background=None, rejected=tuple(rejected), provenance=provenance, overlaps=overlaps)
    verdict = failed(what, "; ".join(hints), registered, capture, looks)
    write_json(search.base / VERDICT, {"source": str(folder), **verdict.document()})
    also = " ".join(problem.sentence for problem in verdict.problems[1:] if problem.grade != "good")
    return BadInput(
        f"{folder}: {what} Not registered: {abbreviated(list(worst), MAX_NAMES)} ({next(iter(worst.values()), 'no model')}).{also and ' '}{also}"
        f" Try {'; '.join(hints)}. Of each photograph: {search.base / VERDICT}"
    )


def unregistered(search: Search) -> list[tuple[str, str]]:
    """(name, reason) of each photograph that is not registered in the best sub-model."""
    missing = [search.images[position] for position in search.missing]
    if not missing:
        return []
    others = [{image.name for image in model.images.values() if image.has_pose} for model in search.models[1:]]
    with quiet_pycolmap() as pycolmap, pycolmap.Database.open(database_path(search.work)) as database:
        ids = {image.name: image.image_id for image in database.read_all_images()}
        features = {image.file: database.num_keypoints_for_image(ids[image.file]) for image in missing}
    best: dict[int, int] = {}
    for pair, count in inlier_counts(database_path(search.work)).items():
        for image_id in pair:
            best[image_id] = max(best.get(image_id, 0), count)
    rejected = []
    for image in missing:
        other = next((model for model in others if image.file in model), None)
        inliers = best.get(ids[image.file], 0)
        if other is not None:
            reason = f"belongs to another sub-model, of {len(other)} photographs, which shares too few points with the rest"
        elif features[image.file] < MIN_FEATURES:
            reason = f"only {features[image.file]} features detected: {WITHOUT_TEXTURE}"
        elif inliers < 15:
            reason = "overlaps no other photograph well enough"
        else:
            reason = f"too few points shared with the cameras found (at most {inliers} with one photograph)"
        rejected.append((image.name, reason))
    return rejected


def _overlaps(work: Path, images: Sequence[WorkImage]) -> tuple[tuple[str, str, int], ...]:
    """(name, name, verified matches) of each pair that has any."""
    counts = inlier_counts(database_path(work))
    return tuple((images[i - 1].name, images[j - 1].name, count) for (i, j), count in counts.items() if count)


def _points(model: Any, index: Mapping[int, int]) -> SparsePoints:
    ordered = [point for _, point in sorted(model.points3D.items())]
    return SparsePoints(
        xyz=np.array([point.xyz for point in ordered], np.float64).reshape(-1, 3),
        rgb=np.array([point.color for point in ordered], np.uint8).reshape(-1, 3),
        error=np.array([point.error for point in ordered], np.float64),
        tracks=tuple(tuple(sorted({index[element.image_id] for element in point.track.elements})) for point in ordered),
    )


def _model_warnings(photos: Sequence[Photo], points: SparsePoints, agreement: float, priors: Sequence[float | None]) -> list[str]:
    """Warnings about a model whose counts and reprojection error are fine."""
    warnings, cameras = [], [photo.camera for photo in photos]
    seen = parallax(points, photos)
    if seen.small and seen.angle < 2.0:
        warnings.append(f"The photographs were taken from almost one place (triangulation angle {seen.angle:.1f} degrees): depth will be poor.")
    if agreement < 0.8:
        warnings.append(
            f"Only {agreement:.0%} of the verified matches agree with the cameras found: repeated structure may have folded the scene. "
            "Check the cameras before training."
        )
    lenses: dict[tuple[float | None, str, int, int, int], Camera] = {}  # one of each: with intrinsics of their own they have much the same focal length
    for camera, prior in zip(cameras, priors, strict=True):
        step = round(math.log(camera.intrinsics["fx"]) / math.log(OTHER_LENS_RATIO))
        lenses[prior, camera.model, camera.width, camera.height, step] = camera
    for (prior, *_), camera in lenses.items():
        focal, longest = camera.intrinsics["fx"], max(camera.width, camera.height)
        if prior and mapping.contradicts_exif(focal, prior):
            warnings.append(f"{camera.name}: focal length {focal:.0f} px, but {prior:.0f} px by its EXIF data; cropped or edited photographs may explain it.")
        elif not (0.15 if camera.model == "OPENCV_FISHEYE" else 0.35) < focal / longest < 6.0:
            warnings.append(f"{camera.name}: an unlikely focal length, {focal:.0f} px at {longest} px wide.")
    return warnings
