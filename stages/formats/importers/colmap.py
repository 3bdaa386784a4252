"""A COLMAP model and its images.

Of several models in a folder (sparse/0, sparse/1, ...) the one with most registered images is taken: the first may be a fragment, and
a small reprojection error is no sign of a good one.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from efficientnerf.geometry.cameras import Camera, pose_from_colmap
from pipeline.errors import BadInput
from pipeline.text import printable
from stages.formats.importers import lenses
from stages.formats.importers.colmap_model import MAX_NAME, Model, Points, count_images, model_files, read_model
from stages.formats.importers.frames import relocated
from stages.formats.importers.masks import masks_of
from stages.formats.importers.source import MIN_IMAGES, ImportSettings, Source, abbreviated, missing_images_warning, moved_images_warnings
from stages.io.capture import Capture, Photo, SparsePoints
from stages.io.pictures import Header, UnreadableImage, read_header

_MODEL_PLACES = (".", "sparse", "sparse/*", "colmap", "colmap/sparse", "colmap/sparse/*", "dense/sparse", "dense/*/sparse", "model", "models/*")
_IMAGE_PLACES = ("images", "input", "rgb", "photos", ".", "../images", "../../images")
_REMEDY = "Put the images into a folder `images` next to the model."


def model_folders(source: Source) -> list[Path]:
    """Every folder of the source that holds a model, the one with most images first (then in order of name). Raises BadInput."""
    folder = source.root
    places = dict.fromkeys(place for pattern in _MODEL_PLACES for place in (sorted(folder.glob(pattern)) if pattern != "." else [folder]))
    found = [place for place in places if place.is_dir() and model_files(place)]
    return sorted(found, key=lambda place: count_images(_files(source, place)), reverse=True) if len(found) > 1 else found


def recognises(folder: Path, allow_outside: bool = False) -> bool:
    return bool(model_folders(Source(folder, allow_outside)))


def _files(source: Source, place: Path) -> list[Path]:
    """The files of a model, without links."""
    return [source.real(path) for path in model_files(place) or []]


def image_names(source: Source) -> list[str]:
    """The names that the source's best model lists. Raises BadInput."""
    place = _best(source)
    return [image.name for image in read_model(place, _files(source, place), points=False).images.values()]


def files(folder: Path, settings: ImportSettings) -> list[Path]:
    """The files of the model that is used, the images that it names and their masks."""
    source = Source(folder, settings.allow_outside)
    place = _best(source)
    model = read_model(place, _files(source, place), points=False)
    images = [path for path in _find_images(source, model)[0].values() if path is not None]
    return [*(model_files(place) or []), *images, *masks_of(source, images).values()]


def read(folder: Path, settings: ImportSettings) -> Capture:
    """The capture that the folder's best model describes. Raises BadInput."""
    source = Source(folder, settings.allow_outside)
    place = _best(source)
    model = read_model(place, _files(source, place))
    where = source.name_of(place) if place != source.root else source.root.name
    images, places, extensions = _find_images(source, model)
    missing = sorted(printable(model.images[number].name, MAX_NAME) for number, path in images.items() if path is None)
    here = {number: path for number, path in images.items() if path is not None}
    warnings = missing_images_warning(where, len(images), len(here), missing, settings.strict, _REMEDY)
    warnings += moved_images_warnings(where, places, extensions)
    others = [f"{source.name_of(other)} ({count_images(_files(source, other))} images)" for other in model_folders(source) if other != place]
    if others:
        warnings.append(f"{where} with {len(model.images)} images is used; there is also {abbreviated(others)}.")
    photos, ids, rejected, remarks = _photos(source, model, here, where)
    if len(photos) < MIN_IMAGES:
        raise BadInput(f"{place}: {len(photos)} usable images; at least {MIN_IMAGES} are needed.")
    points = _sparse(model.points, ids) if model.points is not None and len(model.points.xyz) else None
    if points is None:
        warnings.append(f"{where}: no points3D; the bounds are estimated from the cameras alone.")
    return Capture(
        kind="colmap",
        photos=photos,
        background=None,
        points=points,
        rejected=(*((name, "listed but missing on disk") for name in missing), *((name, reason) for name, reason, _ in rejected)),
        warnings=tuple(warnings + remarks),
        reprojection_error=_mean_error(points),
        facts={"model": where, "registered": len(model.images), "cameras": len(model.cameras)},
        rejected_files={name: file for name, _, file in rejected},
    )


def _best(source: Source) -> Path:
    found = model_folders(source)
    if not found:
        raise BadInput(f"{source.root}: no COLMAP model: expected cameras and images (.bin or .txt) here, in sparse/ or sparse/0. Choose a format with --as.")
    return found[0]


def _find_images(source: Source, model: Model) -> tuple[dict[int, Path | None], list[tuple[str, str]], list[tuple[str, str]]]:
    """Image id -> file or None; (listed, found) of those elsewhere; (listed, found) of those with another extension.

    The folder of images is the one in which most of the model's names are found.
    """
    names = {number: image.name for number, image in sorted(model.images.items(), key=lambda item: item[1].name)}
    places_to_look = [Path(os.path.normpath(base / place)) for place in _IMAGE_PLACES for base in (source.root, model.folder, model.folder.parent)]
    candidates = [path for path in dict.fromkeys(places_to_look) if path.is_dir() and path.is_relative_to(source.root)]
    counts = {folder: sum(os.path.isfile(folder / name) for name in names.values()) for folder in candidates}
    best = max(candidates, key=lambda folder: counts[folder])  # the first of equals
    results = {number: source.find(name, best) for number, name in names.items()}
    taken = {result.path for result in results.values() if result.path is not None}
    missing = [names[number] for number, result in results.items() if result.path is None]
    present = [names[number] for number, result in results.items() if result.path is not None]
    elsewhere = relocated(source, missing, present, taken) if missing else {}
    found: dict[int, Path | None] = {}
    places: list[tuple[str, str]] = []
    extensions: list[tuple[str, str]] = []
    for number, result in results.items():
        path = found[number] = result.path or elsewhere.get(names[number])
        if path is not None and (result.path is None or result.how != "listed"):
            (extensions if result.how == "extension" else places).append((printable(names[number], MAX_NAME), source.name_of(path)))
    return found, places, extensions


def _photos(
    source: Source, model: Model, here: dict[int, Path], where: str
) -> tuple[tuple[Photo, ...], dict[int, int], list[tuple[str, str, Path]], list[str]]:
    """Photos sorted by name; COLMAP's image id -> index of its photo; name, reason and file of the rejected; warnings."""
    masks = masks_of(source, list(here.values()))
    kept: list[tuple[int, Photo]] = []
    rejected: list[tuple[str, str, Path]] = []
    warnings: list[str] = []
    seen: set[Path] = set()
    readable: list[tuple[int, Path]] = []
    stated: list[tuple[Camera, Header, str]] = []
    remarks_by_kind: dict[str, list[str]] = {}
    for number, path in here.items():
        posed, name = model.images[number], source.name_of(path)
        lens = model.cameras[posed.camera]
        if path in seen:
            rejected.append((printable(posed.name, MAX_NAME), f"the same image as an earlier one ({name})", source.real(path)))
            continue
        seen.add(path)
        try:
            header = read_header(source.real(path))
        except UnreadableImage as error:
            rejected.append((name, str(error), source.real(path)))
            warnings.append(f"{name}: {error}; left out.")
            continue
        pose = pose_from_colmap(np.array(posed.quaternion), np.array(posed.translation))
        camera = lenses.validated(Camera(name, lens.width, lens.height, lens.model, lens.params, pose), f"{where}: camera {posed.camera}")
        stated.append((camera, header, f"{where}: {printable(posed.name, MAX_NAME)}"))
        readable.append((number, path))
    for (number, path), (camera, remark) in zip(readable, lenses.fit_to_images(stated), strict=True):
        if remark is not None:
            remarks_by_kind.setdefault(remark, []).append(camera.name)
        mask = source.real(masks[path]) if path in masks else None
        kept.append((number, Photo(camera, source.real(path), mask)))
    kept.sort(key=lambda item: item[1].camera.name)
    ids = {number: index for index, (number, _) in enumerate(kept)}
    return tuple(photo for _, photo in kept), ids, rejected, warnings + lenses.fit_warnings(where, remarks_by_kind)


def _sparse(points: Points, ids: dict[int, int]) -> SparsePoints:
    tracks = tuple(tuple(sorted(ids[number] for number in track if number in ids)) for track in points.tracks)
    return SparsePoints(points.xyz, points.rgb, points.error, tracks)


def _mean_error(points: SparsePoints | None) -> float | None:
    """As COLMAP states it: over the points whose error is known."""
    if points is None:
        return None
    known = points.error[np.isfinite(points.error) & (points.error >= 0)]
    return float(known.mean()) if len(known) else None
