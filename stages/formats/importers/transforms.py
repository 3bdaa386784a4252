"""transforms.json in its three dialects: Blender (NeRF's Realistic Synthetic), nerfstudio and instant-ngp.

All state camera-to-world matrices with x right, y up, looking along -z, and are read by the same rules; they differ in

    blender      one file per split, `camera_angle_x`, names without extension; the world's z is up
    nerfstudio   intrinsics at the top or per frame, `mask_path` (black is left out), `train_filenames` etc., points in a PLY file
    instant-ngp  `aabb_scale`, `scale`, `offset`; masks `dynamic_mask_<image>.png` (white is left out); rolling-shutter pairs of matrices

Where a frame names no mask, one next to its image counts. Depth that frames name (PNG; nerfstudio's `depth_file_path`, instant-ngp's `depth_path`)
becomes sparse points where images agree on it. The capture's frame is that of the matrices; `applied_transform` is recorded only.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from efficientnerf.geometry.cameras import Camera
from pipeline.errors import BadInput
from pipeline.text import printable
from stages.formats.importers import lenses
from stages.formats.importers.depth import DepthFile, depth_file, with_depth
from stages.formats.importers.frames import SPLIT_ORDER, Frame, Listing, located
from stages.formats.importers.masks import masks_of
from stages.formats.importers.source import MAX_FRAMES, MIN_IMAGES, ImportSettings, Source, missing_images_warning, moved_images_warnings
from stages.formats.importers.transforms_camera import lens_of, pose_of
from stages.io.capture import Capture, Photo, SparsePoints
from stages.io.json_file import LARGEST_NUMBER, finite, read_json, shown
from stages.io.meshes.ply import read_ply
from stages.io.pictures import Header, UnreadableImage, read_header

SPLIT_FILES = {f"transforms_{split}.json": split for split in ("train", "val", "test")}
MAX_PLY = 1 << 30  # bytes
MAX_NAME = 200  # characters of a listed name that are shown
_REMEDY = "Copy them into the source folder, or take their frames out of the JSON."
_NERFSTUDIO_FACTS = ("camera_model", "applied_transform", "applied_scale", "ply_file_path")
_NERFSTUDIO_KEYS = (*_NERFSTUDIO_FACTS, "orientation_override", "train_filenames", "val_filenames", "test_filenames")
_NGP_FACTS = ("aabb_scale", "scale", "offset")
_NGP_KEYS = (*_NGP_FACTS, "is_fisheye", "from_na", "n_extra_learnable_dims", "enable_depth_loading", "integer_depth_scale", "render_aabb")
_MILLIMETRE = 0.001  # metres
_NGP_SCALE = 0.33  # of instant-ngp, where the file states none


@dataclass(frozen=True, kw_only=True)
class _Frame(Frame):
    """A frame of a file, which holds `document`, of which `entry` is the frame's part."""

    file: Path
    document: dict[str, Any]
    entry: dict[str, Any]


def json_files(folder: Path) -> list[Path]:
    """The JSON files that make up the data set: those of the splits, or transforms.json."""
    splits = [folder / name for name in SPLIT_FILES if (folder / name).is_file()]
    whole = folder / "transforms.json"
    return splits or ([whole] if whole.is_file() else [])


def dialect(source: Source) -> str:
    """ "blender", "nerfstudio" or "instant-ngp", by the keys that only one of them has."""
    document = _documents(source)[0][1]
    frames = [frame for frame in document["frames"] if isinstance(frame, dict)]
    if any(key in document for key in _NERFSTUDIO_KEYS) or any("mask_path" in frame or "depth_file_path" in frame for frame in frames):
        return "nerfstudio"
    if any(key in document for key in _NGP_KEYS) or any("transform_matrix_start" in frame for frame in frames):
        return "instant-ngp"
    return "blender" if "camera_angle_x" in document and "fl_x" not in document else "nerfstudio"


def recognises(folder: Path, allow_outside: bool, kind: str) -> bool:
    """Whether a folder holds a transforms.json of this dialect. Raises BadInput where it cannot be read."""
    return bool(json_files(folder)) and dialect(Source(folder, allow_outside)) == kind


def _documents(source: Source) -> list[tuple[Path, dict[str, Any]]]:
    """The files of the data set and what they hold."""
    return [(file, read_document(source.real(file))) for file in json_files(source.root)]


def files(folder: Path, settings: ImportSettings) -> list[Path]:
    """The JSON files, the images and masks that they name, and the points."""
    source = Source(folder, settings.allow_outside)
    paths: dict[Path, None] = dict.fromkeys(json_files(folder))
    for _, document in _documents(source):
        ply = _ply(source, document)
        if ply is not None:
            paths[ply] = None
    found = located(source, _frames(source)).found
    paths |= dict.fromkeys(mask for mask, _ in _masks(source, found).values())
    for frame, image in found:
        paths[image] = None
        depth = _depth(source, frame, image)
        if depth is not None:
            paths[depth.file] = None
    return list(paths)


def read(folder: Path, settings: ImportSettings, kind: str | None = None) -> Capture:
    """The capture that a folder's transforms*.json describes; `kind` overrides the dialect. Raises BadInput."""
    if not json_files(folder):
        raise BadInput(f"{folder}: no transforms.json or transforms_train.json. Name the folder that holds it, or choose another format with --as.")
    source = Source(folder, settings.allow_outside)
    kind = kind or dialect(source)
    where = ", ".join(file.name for file in json_files(folder))
    frames = _frames(source)
    listing = located(source, frames)
    photos, unreadable, remarks, lens_warnings = _photos(source, listing)
    rejected = [*((name, "listed but missing on disk") for name in listing.missing), *listing.repeated, *((name, why) for name, why, _ in unreadable)]
    warnings = missing_images_warning(where, len(frames), len(photos), listing.missing, settings.strict, _REMEDY)
    if len(photos) < MIN_IMAGES:
        raise BadInput(f"{folder / where}: {len(photos)} usable images of {len(frames)} frames; at least {MIN_IMAGES} are needed.")
    warnings += moved_images_warnings(where, listing.places, listing.extensions) + lenses.fit_warnings(where, remarks) + lens_warnings
    if listing.repeated:
        warnings.append(f"{where}: {len(listing.repeated)} frames name an image that an earlier frame has, e.g. {listing.repeated[0][0]}; they were left out.")
    document = _documents(source)[0][1]
    if len({file.name for file in json_files(folder)} & set(SPLIT_FILES)) and (folder / "transforms.json").is_file():
        warnings.append(f"transforms.json is not read: {where} have the same frames, with splits.")
    points, point_warnings = _points(source, document)
    capture = Capture(
        kind=kind,
        photos=tuple(sorted(photos, key=lambda photo: (SPLIT_ORDER[photo.split], photo.camera.name))),
        background=None,
        up=np.array([0.0, 0.0, 1.0]) if kind == "blender" else None,
        points=points,
        bounds=_bounds(document, json_files(folder)[0]) if kind == "instant-ngp" else None,
        rejected=tuple(rejected),
        warnings=tuple(warnings + point_warnings),
        metric=any("depth_file_path" in frame.entry for frame, _ in listing.found) and "applied_scale" not in document,
        facts={key: _fact(document[key]) for key in (*_NERFSTUDIO_FACTS, *_NGP_FACTS) if key in document},
        rejected_files={name: file for name, _, file in unreadable},
    )
    maps = {source.real(image): _depth(source, frame, image) for frame, image in listing.found}
    return with_depth(capture, lambda photo: maps.get(photo.image))


def _fact(value: Any, depth: int = 2) -> Any:
    """A value of the file as reports can hold it; what is large, nested or no JSON is only described."""
    if isinstance(value, str):
        return printable(value, MAX_NAME)
    if isinstance(value, list) and len(value) <= 16 and depth:
        return [_fact(entry, depth - 1) for entry in value]
    return value if value is None or isinstance(value, bool) or finite(value, 2.0**53) is not None else shown(value)


def read_document(file: Path, max_frames: int = MAX_FRAMES) -> dict[str, Any]:
    """The document of a transforms.json that lists 1 to `max_frames` frames. Raises BadInput."""
    document = read_json(file, "Write the data set again, or repair that place.")
    if not isinstance(document, dict) or not isinstance(document.get("frames"), list):
        raise BadInput(f"{file}: no data set: expected an object with a list `frames`. Name the folder of a data set, or choose a format with --as.")
    if not document["frames"]:
        raise BadInput(f"{file}: its list of frames is empty. At least {MIN_IMAGES} are needed.")
    if len(document["frames"]) > max_frames:
        raise BadInput(f"{file}: {len(document['frames'])} frames; at most {max_frames} are read.")
    return document


def _frames(source: Source) -> list[_Frame]:
    documents = _documents(source)
    listed = []
    for file, document in documents:
        split_of_file = SPLIT_FILES.get(file.name) if len(documents) > 1 else None
        split_of_name = dict(_listed_splits(document, file))
        for index, entry in enumerate(document["frames"]):
            if not isinstance(entry, dict) or not isinstance(entry.get("file_path"), str):
                raise BadInput(f"{file}: frame {index} has no `file_path`. Write the data set again, or take it out.")
            name = entry["file_path"]
            where, split = f"{file.name}: frame {index} ({printable(name, MAX_NAME)})", split_of_file or split_of_name.get(_plain(name))
            listed.append(_Frame(name, file.parent, where, _camera(document, entry, where), split=split, file=file, document=document, entry=entry))
    return listed


def _camera(document: dict[str, Any], entry: dict[str, Any], where: str) -> Callable[[str, tuple[int, int]], Camera]:
    return lambda name, size: lens_of(document | entry, name, size, pose_of(entry, where), where)


def _listed_splits(document: dict[str, Any], file: Path) -> Iterator[tuple[str, str]]:
    for split in ("train", "val", "test"):
        names = document.get(f"{split}_filenames", [])
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise BadInput(f"{file}: {split}_filenames is not a list of names.")
        yield from ((_plain(name), split) for name in names)


def _plain(name: str) -> str:
    return name.removeprefix("./").replace("\\", "/")


def _photos(source: Source, listing: Listing[_Frame]) -> tuple[list[Photo], list[tuple[str, str, Path]], dict[str, list[str]], list[str]]:
    """Photos, the unreadable as (name, reason, file), what `lenses.fit_to_images` remarks, and warnings."""
    photos: list[Photo] = []
    rejected: list[tuple[str, str, Path]] = []
    remarks: dict[str, list[str]] = {}
    warnings: list[str] = []
    rolling = lost_masks = 0
    readable: list[tuple[_Frame, Path]] = []
    stated: list[tuple[Camera, Header, str]] = []
    for frame, image in listing.found:
        name = source.name_of(image)
        try:
            header = read_header(source.real(image))
        except UnreadableImage as error:
            rejected.append((name, str(error), source.real(image)))
            warnings.append(f"{name}: {error}; left out.")
            continue
        rolling += "transform_matrix" not in frame.entry
        stated.append((frame.camera(name, header.size), header, frame.where))
        readable.append((frame, image))
    masks = _masks(source, listing.found)
    for (frame, image), (camera, remark) in zip(readable, lenses.fit_to_images(stated), strict=True):
        if remark is not None:
            remarks.setdefault(remark, []).append(camera.name)
        mask, ignore = masks.get(image, (None, "black"))
        lost_masks += mask is None and "mask_path" in frame.entry
        photos.append(Photo(camera, source.real(image), None if mask is None else source.real(mask), ignore, frame.split))
    if rolling:
        warnings.append(f"{rolling} frames have a rolling shutter (transform_matrix_start, _end); the middle pose is used.")
    if lost_masks:
        warnings.append(f"{lost_masks} listed masks (mask_path) are missing; those images are used without one.")
    centred = [photo for photo in photos if 0 < photo.camera.intrinsics["cx"] < photo.camera.width and 0 < photo.camera.intrinsics["cy"] < photo.camera.height]
    if len(centred) < len(photos):
        warnings.append(f"{len(photos) - len(centred)} cameras have their principal point outside the image: cx, cy may belong to another size.")
    return photos, rejected, remarks, warnings


def _masks(source: Source, found: Sequence[tuple[_Frame, Path]]) -> dict[Path, tuple[Path, str]]:
    """Image -> its mask and which of the mask's pixels are left out: the mask that its frame names; of frames that name none, that next to the image."""
    masks: dict[Path, tuple[Path, str]] = {}
    unnamed = []
    for frame, image in found:
        listed = frame.entry.get("mask_path")
        mask: Path | None
        if isinstance(listed, str) and listed:
            mask, ignore = source.find(listed, frame.file.parent).path, "black"
        else:
            names = (f"dynamic_mask_{image.stem}.png", f"dynamic_mask_{image.name}.png")
            beside = (image.with_name(name) for name in names)
            mask, ignore = next((source.check_inside(path) for path in beside if os.path.isfile(path)), None), "white"
            if mask is None:
                unnamed.append(image)
        if mask is not None:
            masks[image] = mask, ignore
    return masks | {image: (mask, "black") for image, mask in masks_of(source, unnamed).items()}


def _depth(source: Source, frame: _Frame, image: Path) -> DepthFile | None:
    """The depth of a frame: nerfstudio's in millimetres, instant-ngp's in units that the file states. Of poses that were scaled afterwards it is not used."""
    if isinstance(frame.entry.get("depth_file_path"), str) and "applied_scale" not in frame.document:
        listed, unit = frame.entry["depth_file_path"], _MILLIMETRE
    elif isinstance(frame.entry.get("depth_path"), str):
        listed, unit = frame.entry["depth_path"], finite(frame.document.get("integer_depth_scale")) or 0.0
    else:
        return None
    path = source.find(listed, frame.file.parent, (".png",)).path if unit > 0 else None
    return None if path is None or path == image or path.suffix.lower() != ".png" else depth_file(source, path, unit)


def _bounds(document: dict[str, Any], file: Path) -> np.ndarray | None:
    """instant-ngp's unit cube in the frame of the matrices: it maps x to scale * x + offset, and expects the subject within [0, 1].

    `aabb_scale` widens that cube for the background and is ignored.
    """
    if "aabb_scale" not in document and "scale" not in document:
        return None
    scale, offset = document.get("scale", _NGP_SCALE), document.get("offset", [0.5, 0.5, 0.5])
    factor, shift = finite(scale), [finite(n) for n in offset] if isinstance(offset, list) and len(offset) == 3 else [None]
    if factor is None or factor < 1 / LARGEST_NUMBER or None in shift:
        raise BadInput(f"{file}: scale {shown(scale)} and offset {shown(offset)}; expected a positive number and three numbers.")
    centre = (0.5 - np.array(shift, np.float64)) / factor
    return np.stack([centre - 0.5 / factor, centre + 0.5 / factor])


def _ply(source: Source, document: dict[str, Any]) -> Path | None:
    listed = document.get("ply_file_path")
    return source.find(listed, suffixes=(".ply",)).path if isinstance(listed, str) and listed else None


def _points(source: Source, document: dict[str, Any]) -> tuple[SparsePoints | None, list[str]]:
    if not isinstance(document.get("ply_file_path"), str):
        return None, []
    path = _ply(source, document)
    if path is None or source.real(path).stat().st_size > MAX_PLY:
        why = "missing" if path is None else "larger than 1 GiB"
        return None, [f"ply_file_path {printable(document['ply_file_path'], MAX_NAME)}: {why}; the points are not used."]
    try:
        with source.real(path).open("rb") as file:
            cloud = read_ply(file, os.fstat(file.fileno()).st_size)
    except (OSError, ValueError, OverflowError) as error:
        return None, [f"{path.name}: not readable as a PLY of points ({printable(error, 80)}); the points are not used."]
    xyz = cloud.vertices
    rgb = np.full((len(xyz), 3), 128, np.uint8) if cloud.colours is None else cloud.colours
    usable = (np.abs(xyz) <= LARGEST_NUMBER).all(-1)  # not nan either
    if not usable.any():
        return None, [f"{path.name}: holds no points; not used."]
    xyz, rgb = xyz[usable], rgb[usable]
    return SparsePoints(xyz, rgb, np.full(len(xyz), np.nan), ((),) * len(xyz)), []
