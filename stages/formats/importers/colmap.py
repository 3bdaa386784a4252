"""A COLMAP model and its images.

Of several models in a folder (sparse/0, sparse/1, ...) the one with most registered images is taken: the first may be a fragment, and
a small reprojection error is no sign of a good one.
"""

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from efficientnerf.geometry.cameras import pose_from_colmap
from pipeline.text import printable
from stages.formats.importers import lenses
from stages.formats.importers.colmap_model import MAX_NAME, Model, PosedImage, count_images, model_files, read_model, read_points
from stages.formats.importers.frames import CameraOf, Frame
from stages.formats.importers.listed import Listed, ListFormat
from stages.formats.importers.source import Source, abbreviated
from stages.io.capture import Capture

_MODEL_PLACES = (".", "sparse", "sparse/*", "colmap", "colmap/sparse", "colmap/sparse/*", "dense/sparse", "dense/*/sparse", "model", "models/*")
_IMAGE_PLACES = ("images", "input", "rgb", "photos", ".", "../images", "../../images")


def _models(source: Source) -> list[Path]:
    """Every folder of the source that holds a model, the one with most images first (then in order of name). Raises BadInput."""
    folder = source.root
    places = dict.fromkeys(place for pattern in _MODEL_PLACES for place in (sorted(folder.glob(pattern)) if pattern != "." else [folder]))
    found = [place for place in places if place.is_dir() and model_files(place)]
    return sorted(found, key=lambda place: count_images(_files(source, place)), reverse=True) if len(found) > 1 else found


def _files(source: Source, place: Path) -> list[Path]:
    """The files of a model, without links."""
    return [source.real(path) for path in model_files(place) or []]


def image_names(source: Source) -> list[str]:
    """The names that the source's best model lists; none where there is no model. Raises BadInput."""
    return [image.name for place in _models(source)[:1] for image in read_model(place, _files(source, place)).images.values()]


def _listed(source: Source, signs: Sequence[Path]) -> Listed:
    place, *others = signs
    files = _files(source, place)
    model = read_model(place, files)
    where = source.name_of(place) if place != source.root else source.root.name
    # The folder in which most of the model's names are found, the first of equals.
    names = [image.name for image in model.images.values()]
    places = [Path(os.path.normpath(base / place)) for place in _IMAGE_PLACES for base in (source.root, model.folder, model.folder.parent)]
    candidates = [path for path in dict.fromkeys(places) if path.is_dir() and path.is_relative_to(source.root)]
    images = max(candidates, key=lambda folder: sum(os.path.isfile(folder / name) for name in names))
    frames = [
        Frame(image.name, images, f"{where}: {printable(image.name, MAX_NAME)}", _camera(model, image, where), own=number)
        for number, image in sorted(model.images.items(), key=lambda item: item[1].name)
    ]

    def finish(capture: Capture, kept: Sequence[Frame]) -> Capture:
        warnings = []
        if others:
            counts = [f"{source.name_of(other)} ({count_images(_files(source, other))} images)" for other in others]
            warnings.append(f"{where} with {len(model.images)} images is used; there is also {abbreviated(counts)}.")
        points, places = read_points(files), {frame.own: index for index, frame in enumerate(kept)}
        if points is None or not len(points.xyz):
            warnings.append(f"{where}: no points3D; the bounds are estimated from the cameras alone.")
            return replace(capture, warnings=(*capture.warnings, *warnings))
        tracks = tuple(tuple(sorted(places[number] for number in track if number in places)) for track in points.tracks)
        known = points.error[np.isfinite(points.error) & (points.error >= 0)]
        error = float(known.mean()) if len(known) else None  # as COLMAP states it
        return replace(capture, points=replace(points, tracks=tracks), reprojection_error=error, warnings=(*capture.warnings, *warnings))

    facts: dict[str, object] = {"model": where, "registered": len(model.images), "cameras": len(model.cameras)}
    remedy = "Put the images into a folder `images` next to the model."
    return Listed(where, frames, model_files(place) or [], facts=facts, finish=finish, remedy=remedy)


def _camera(model: Model, image: PosedImage, where: str) -> CameraOf:
    lens, pose = model.cameras[image.camera], pose_from_colmap(np.array(image.quaternion), np.array(image.translation))
    return lambda name, size: lenses.validated(replace(lens, name=name, world_from_camera=pose), f"{where}: camera {image.camera}")


FORMAT = ListFormat("colmap", "cameras and images (.bin or .txt) here, in sparse/ or sparse/0", _models, _listed)
