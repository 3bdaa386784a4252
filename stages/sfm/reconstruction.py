"""Structure from motion with COLMAP's incremental mapper, on the CPU, bit-exact from run to run.

The capture's frame is COLMAP's: its scale and axes are arbitrary.
"""

from __future__ import annotations

import base64
import contextlib
import errno
import fcntl
import math
import os
import shutil
import sqlite3
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Unpack

import numpy as np
from msgspec import convert, structs, to_builtins

from efficientnerf.geometry.cameras import Camera, resized
from pipeline.errors import BadInput
from pipeline.files import write_json
from stages.cores import count_cores
from stages.io.capture import Capture, Lens, Photo, Provenance, SparsePoints
from stages.sfm import ladder, mapping, matches, process
from stages.sfm.colmap import quiet_pycolmap
from stages.sfm.database import database_path, inlier_counts, open_database, planar_share, remove_database
from stages.sfm.images import Callables, Masks, WorkImage, prepare_images
from stages.sfm.intrinsics.own import with_own_intrinsics
from stages.verdict.looks import look_at_all
from stages.verdict.parallax import parallax
from stages.verdict.verdict import WITHOUT_TEXTURE, failed

WAIT = 0.05  # seconds between two checks of a lock
VERDICT = "verdict.json"  # in the scratch folder, where no cameras are found
FEW_FEATURES = 50  # of a photograph, below which it has too little detail
OWN_LENSES: dict[str, Lens] = {ladder.EACH: "zoomed", ladder.CROPPED: "cropped"}  # by step
OTHER_FOCAL = 1.2  # times a focal length: that of another lens
MAX_NAMES = 8  # photographs that an error lists by name


def find_cameras(
    folder: Path,
    names: Sequence[str] | Mapping[str, Path],
    *,
    max_side: int = 1600,
    features: int | None = None,
    matching: str = "auto",
    seed: int = 0,
    threads: int | None = None,
    masks: Masks | None = None,
    lens: str = "auto",
    networks: tuple[Path, Path] | None = None,
    work: Path,
    **callables: Unpack[Callables],
) -> Capture:
    """Find the pose and the intrinsics of each photograph's camera.

    folder, names   the photographs, paths relative to the folder, any order; or for each the file that is read
    max_side        longest side of the photographs in which features are detected, pixels
    features        most features of a photograph; None: as `ladder.features_for` has it
    threads         on which features are detected, and processes in which pairs are matched; None: as many as the process may use. Changes no bit
    matching        "exhaustive", "retrieval", "sequential" (the sorted names follow a path; `stages.sfm.pairs`), or "auto": exhaustive up to 60 photographs
    masks           of some or all names: no features where the mask is black, nor where a photograph is transparent; None: features everywhere
    lens            "fisheye", "perspective", or "auto": fisheye where EXIF data say so
    networks        files of a detector and a matcher (`stages.sfm.learned.networks`), for photographs that SIFT leaves without a camera
    work            scratch folder; what a killed call left in it is used again, and the result has the same bits
    returns         a Capture of kind "photographs"; photographs that were not registered are in `rejected`, with the reason

    It is done in a process of its own (`stages.sfm.process`), whose callables are called here.

    Raises BadInput where fewer than 3 or less than half of the photographs are registered, StageFailed where the process aborts.
    """
    masks, paths = masks or {}, _paths(folder, names)
    arguments: dict[str, Any] = {"folder": os.path.abspath(folder), "names": {name: os.path.abspath(path) for name, path in paths.items()}}
    features = features or ladder.features_for(len(paths))
    arguments |= {"max_side": max_side, "features": features, "matching": matching, "seed": seed, "threads": threads, "lens": lens}
    arguments |= {"networks": networks and [os.path.abspath(path) for path in networks]}
    arguments |= {"masks": {name: mask and os.path.abspath(mask) for name, mask in masks.items()}, "work": os.path.abspath(work)}
    resumed = database_path(work).exists()
    try:
        found = process.run(arguments, **callables)
    except process.ChildAborted:
        if resumed:  # leftovers of an earlier attempt may be what COLMAP cannot bear
            remove_database(work)
        raise
    return _capture_from(found, folder, paths, masks)


def _paths(folder: Path, names: Sequence[str] | Mapping[str, Path]) -> dict[str, Path]:
    return dict(names) if isinstance(names, Mapping) else {name: folder / name for name in names}


def capture_for(arguments: Mapping[str, Any], **callables: Callable[..., None]) -> dict[str, Any]:
    """`reconstruct` for arguments that have come through JSON; the capture as JSON can hold it."""
    paths: dict[str, Any] = {"folder": Path(arguments["folder"]), "work": Path(arguments["work"])}
    paths |= {of: {name: path and Path(path) for name, path in arguments[of].items()} for of in ("names", "masks")}
    networks = arguments["networks"]
    paths["networks"] = networks and (Path(networks[0]), Path(networks[1]))
    with _alone(Path(arguments["work"]), callables["safe_point"]):
        return _plain(reconstruct(**{**arguments, **paths}, **callables))  # type: ignore[arg-type]


@contextlib.contextmanager
def _alone(work: Path, safe_point: Callable[[], None]) -> Iterator[None]:
    """Wait until the process of a run that was killed, which ends a moment after it, writes into the scratch folder no more."""
    work.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(work, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        while True:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                safe_point()
                time.sleep(WAIT)
            except OSError:  # a file system without locks
                break
        yield
    finally:
        os.close(descriptor)


def reconstruct(
    folder: Path,
    names: Sequence[str] | Mapping[str, Path],
    *,
    max_side: int,
    features: int,
    matching: str,
    seed: int,
    threads: int | None = None,
    masks: Masks,
    lens: str = "auto",
    networks: tuple[Path, Path] | None = None,
    work: Path,
    **callables: Unpack[Callables],
) -> Capture:
    """`find_cameras` in this process."""
    progress, safe_point = callables["progress"], callables["safe_point"]
    work.mkdir(parents=True, exist_ok=True)
    images, unreadable = prepare_images(
        folder,
        [*names],
        max_side=max_side,
        features=features,
        seed=seed,
        masks=masks,
        lens=lens,
        paths=_paths(folder, names),
        threads=threads or count_cores(),
        work=work,
        **callables,
    )
    if len(images) < mapping.MIN_MODEL_SIZE:
        raise BadInput(
            f"{folder}: {len(images)} readable photographs; at least {mapping.MIN_MODEL_SIZE} are needed, and 20 or more all round a subject are better."
            + (f" Unreadable: {_abbreviated([name for name, _ in unreadable])}." if unreadable else "")
        )
    if matching == "auto":
        matching = ladder.matching_for(len(images))
    with _full_disk_named(work):
        open_database(work, images, callables["warn"])
        matches.extract_features(work, images, features=features, threads=threads, progress=progress, safe_point=safe_point)
        how: dict[str, Any] = {"features": features, "seed": seed, "threads": threads or count_cores(), "networks": networks}
        found = ladder.find_models(work, images, matching, **how, progress=progress, safe_point=safe_point)
    models, place = found.models, found.work
    rejected = [*unreadable, *_unregistered(place, images, models)]
    if mapping.num_registered(models) < max(mapping.MIN_MODEL_SIZE, len(images) / 2):
        raise BadInput(_failure(folder, _paths(folder, names), work, images, found, rejected, matching))
    provenance = _provenance(images, found, matching)
    model = models[0] if found.rung == ladder.CROPPED else mapping.bundle_adjusted(place, images, models[0], safe_point)
    if found.rung not in OWN_LENSES:
        model, own = with_own_intrinsics(images, model, safe_point)
        provenance = structs.replace(provenance, own_intrinsics=own)
    provenance = structs.replace(provenance, moving_parts=mapping.moving_shares(place, images, model, safe_point))
    capture = _capture(folder, place, images, model, masks, rejected, provenance)
    for sentence in capture.warnings:
        callables["warn"](sentence)
    return capture


def _plain(capture: Capture) -> dict[str, Any]:
    """The capture of `reconstruct` as JSON can hold it, bit for bit: floats by their shortest spelling, arrays by their bytes."""
    assert capture.points is not None
    cameras = [photo.camera for photo in capture.photos]
    lenses = [[c.name, c.width, c.height, c.model, [float(p) for p in c.params]] for c in cameras]
    points = (capture.points.xyz, capture.points.rgb, capture.points.error, np.array([camera.world_from_camera for camera in cameras], np.float64))
    return {
        "lenses": lenses,
        "arrays": [[array.dtype.str, array.shape, base64.b64encode(np.ascontiguousarray(array).tobytes()).decode()] for array in points],
        "tracks": capture.points.tracks,
        "rejected": capture.rejected,
        "warnings": capture.warnings,
        "reprojection_error": capture.reprojection_error,
        "provenance": to_builtins(capture.provenance),
        "overlaps": capture.overlaps,
    }


def _capture_from(found: Mapping[str, Any], folder: Path, paths: Mapping[str, Path], masks: Masks) -> Capture:
    """The inverse of `_plain`."""
    xyz, rgb, error, poses = (np.frombuffer(base64.b64decode(data), dtype).reshape(shape).copy() for dtype, shape, data in found["arrays"])
    lenses = zip(found["lenses"], poses, strict=True)
    cameras = [Camera(name, width, height, model, tuple(params), pose) for (name, width, height, model, params), pose in lenses]
    return Capture(
        kind="photographs",
        photos=tuple(Photo(camera, paths.get(camera.name, folder / camera.name), masks.get(camera.name)) for camera in cameras),
        background=None,
        points=SparsePoints(xyz, rgb, error, tuple(tuple(track) for track in found["tracks"])),
        rejected=tuple((name, reason) for name, reason in found["rejected"]),
        warnings=tuple(found["warnings"]),
        reprojection_error=found["reprojection_error"],
        provenance=convert(found["provenance"], Provenance),
        overlaps=tuple((first, second, count) for first, second, count in found["overlaps"]),
    )


@contextlib.contextmanager
def _full_disk_named(work: Path) -> Iterator[None]:
    """COLMAP reports a full disk as one of many RuntimeErrors."""
    try:
        yield
    except (RuntimeError, sqlite3.OperationalError) as error:
        if shutil.disk_usage(work).free < 1 << 20:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(work)) from error
        raise


def _abbreviated(names: Sequence[str]) -> str:
    return ", ".join(names[:MAX_NAMES]) + (f" and {len(names) - MAX_NAMES} more" if len(names) > MAX_NAMES else "")


def _unregistered(work: Path, images: Sequence[WorkImage], models: Sequence[Any]) -> list[tuple[str, str]]:
    """(name, reason) of each photograph that is not registered in the best sub-model."""
    of_model = [{image.name for image in model.images.values() if image.has_pose} for model in models]
    missing = [image for image in images if not of_model or image.file not in of_model[0]]
    if not missing:
        return []
    with quiet_pycolmap() as pycolmap, pycolmap.Database.open(database_path(work)) as database:
        ids = {image.name: image.image_id for image in database.read_all_images()}
        features = {image.file: database.num_keypoints_for_image(ids[image.file]) for image in missing}
        best: dict[int, int] = {}
        for pair, inliers in inlier_counts(database_path(work)).items():
            for image_id in pair:
                best[image_id] = max(best.get(image_id, 0), inliers)
    rejected = []
    for image in missing:
        other = next((model for model in of_model[1:] if image.file in model), None)
        inliers = best.get(ids[image.file], 0)
        if other is not None:
            reason = f"belongs to another sub-model, of {len(other)} photographs, which shares too few points with the rest"
        elif features[image.file] < FEW_FEATURES:
            reason = f"only {features[image.file]} features detected: {WITHOUT_TEXTURE}"
        elif inliers < 15:
            reason = "overlaps no other photograph well enough"
        else:
            reason = f"too few points shared with the cameras found (at most {inliers} with one photograph)"
        rejected.append((image.name, reason))
    return rejected


def _provenance(images: Sequence[WorkImage], found: ladder.Found, how: str) -> Provenance:
    """How the photographs were matched, the sizes of the components of overlap and of the sub-models that add to the first, and the steps tried."""
    parts = [{image.name for image in model.images.values() if image.has_pose} for model in found.models]
    return Provenance(
        matching=how,
        components=[len(part) for part in ladder.components(ladder.neighbours(found.work, len(images)))],
        models=[len(part) for part in parts if part is parts[0] or part - parts[0]],
        rungs=found.rungs,
        planar_pairs=planar_share(database_path(found.work)),
        lens=OWN_LENSES.get(found.rung),
    )


def _overlaps(work: Path, images: Sequence[WorkImage]) -> tuple[tuple[str, str, int], ...]:
    """(name, name, verified matches) of each pair that has any."""
    counts = inlier_counts(database_path(work))
    return tuple((images[i - 1].name, images[j - 1].name, count) for (i, j), count in counts.items() if count)


def _failure(
    folder: Path,
    paths: Mapping[str, Path],
    work: Path,
    images: Sequence[WorkImage],
    found: ladder.Found,
    rejected: Sequence[tuple[str, str]],
    how: str,
) -> str:
    hints = ["more photographs with at least 60 % overlap between neighbours, sharp, of a subject with texture"]
    if how == "sequential":
        hints.append("--set poses.matching=exhaustive if the names do not follow the path of the camera")
    hints.append("--set poses.max_features=8192")
    worst = dict(rejected)
    fewest = max(mapping.MIN_MODEL_SIZE, -(-len(images) // 2))
    registered = mapping.num_registered(found.models)
    what = f"cameras found for {registered} of {len(images)} photographs; at least {fewest} are needed."
    looks = look_at_all({image.name: work / "images" / image.file for image in images}, paths)
    verdict = failed(what, "; ".join(hints), registered, rejected, looks, _provenance(images, found, how), _overlaps(found.work, images))
    write_json(work / VERDICT, {"source": str(folder), **verdict.document()})
    also = " ".join(problem.sentence for problem in verdict.problems[1:] if problem.grade != "good")
    return (
        f"{folder}: {what} Not registered: {_abbreviated(list(worst))} ({next(iter(worst.values()), 'no model')}).{also and ' '}{also}"
        f" Try {'; '.join(hints)}. Of each photograph: {work / VERDICT}"
    )


def _capture(
    folder: Path, work: Path, images: Sequence[WorkImage], model: Any, masks: Masks, rejected: list[tuple[str, str]], found: Provenance
) -> Capture:
    by_file = {image.file: image for image in images}
    registered = sorted((image for image in model.images.values() if image.has_pose), key=lambda image: image.name)
    at_work = [mapping.camera_of(model, image, by_file[image.name]) for image in registered]  # at working size
    photos = tuple(
        Photo(camera=resized(camera, by_file[image.name].width, by_file[image.name].height), image=folder / camera.name, mask=masks.get(camera.name))
        for camera, image in zip(at_work, registered, strict=True)
    )
    index = {image.image_id: i for i, image in enumerate(registered)}
    points = _points(model, index)
    agreement = mapping.match_agreement(work, images, model)
    angle = round(parallax(points, photos).angle, 3)
    counts = {"photographs": len(images), "registered": len(photos), "points": len(points.xyz)}
    warnings = _model_warnings(photos, points, agreement, [by_file[image.name].focal for image in registered])
    if rejected:
        warnings.append(f"{len(rejected)} photograph{'s' if len(rejected) > 1 else ''} not registered: {_abbreviated([name for name, _ in rejected])}.")
    return Capture(
        kind="photographs",
        photos=photos,
        background=None,
        points=points,
        rejected=tuple(rejected),
        warnings=tuple(warnings),
        reprojection_error=float(model.compute_mean_reprojection_error()),
        provenance=structs.replace(found, **counts, triangulation_angle=angle, pairs_agreeing=round(agreement, 4)),
        overlaps=_overlaps(work, images),
    )


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
            "Look at the cameras before training."
        )
    lenses: dict[tuple[float | None, str, int, int, int], Camera] = {}  # one of each: with intrinsics of their own they have much the same focal length
    for camera, prior in zip(cameras, priors, strict=True):
        step = round(math.log(camera.intrinsics["fx"]) / math.log(OTHER_FOCAL))
        lenses[prior, camera.model, camera.width, camera.height, step] = camera
    for (prior, *_), camera in lenses.items():
        focal, longest = camera.intrinsics["fx"], max(camera.width, camera.height)
        if prior and mapping.contradicts_exif(focal, prior):
            warnings.append(f"{camera.name}: focal length {focal:.0f} px, but {prior:.0f} px by its EXIF data; cropped or edited photographs may explain it.")
        elif not (0.15 if camera.model == "OPENCV_FISHEYE" else 0.35) < focal / longest < 6.0:
            warnings.append(f"{camera.name}: an unlikely focal length, {focal:.0f} px at {longest} px wide.")
    return warnings
