"""transforms.json in its three dialects: Blender (NeRF's Realistic Synthetic), nerfstudio and instant-ngp.

All state camera-to-world matrices with x right, y up, looking along -z, and are read by the same rules; they differ in

    blender      one file per split, `camera_angle_x`, names without extension; the world's z is up
    nerfstudio   intrinsics at the top or per frame, `mask_path` (black is left out), `train_filenames` etc., points in a PLY file
    instant-ngp  `aabb_scale`, `scale`, `offset`; masks `dynamic_mask_<image>.png` (white is left out); rolling-shutter pairs of matrices

Where a frame names no mask, one next to its image counts. Depth that frames name (PNG; nerfstudio's `depth_file_path`, instant-ngp's `depth_path`)
becomes sparse points where images agree on it. The capture's frame is that of the matrices; `applied_transform` is recorded only.
"""

import math
import os
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from efficientnerf.geometry.cameras import MODELS, Camera, pose_from_opengl
from pipeline.errors import BadInput
from pipeline.text import printable
from stages.formats.importers import lenses
from stages.formats.importers.depth import MILLIMETRE, DepthFile, depth_file
from stages.formats.importers.frames import MAX_NAME, CameraOf, Frame
from stages.formats.importers.listed import Z_UP, Listed, ListFormat, Masks, sparse_points
from stages.formats.importers.masks import masks_of
from stages.formats.importers.source import MAX_FRAMES, MIN_IMAGES, Source
from stages.io import json_file
from stages.io.capture import Capture, SparsePoints
from stages.io.json_file import LARGEST_NUMBER, finite, read_json, shown
from stages.io.meshes.ply import read_ply

SPLIT_FILES = {f"transforms_{split}.json": split for split in ("train", "val", "test")}
MAX_PLY = 1 << 30  # bytes
MIN_ANGLE = 1e-9  # radians; its tangent is a number yet
_UNSUPPORTED = ("ftheta_p0", "latlong", "equirectangular")  # lens models
_NERFSTUDIO_FACTS = ("camera_model", "applied_transform", "applied_scale", "ply_file_path")
_NERFSTUDIO_KEYS = (*_NERFSTUDIO_FACTS, "orientation_override", "train_filenames", "val_filenames", "test_filenames")
_NGP_FACTS = ("aabb_scale", "scale", "offset")
_NGP_KEYS = (*_NGP_FACTS, "is_fisheye", "from_na", "n_extra_learnable_dims", "enable_depth_loading", "integer_depth_scale", "render_aabb")
_NGP_SCALE = 0.33  # of instant-ngp, where the file states none

Documents = list[tuple[Path, dict[str, Any]]]  # the files of a data set, and what they hold


def _json_files(source: Source) -> list[Path]:
    """The JSON files that make up the data set: those of the splits, or transforms.json."""
    splits = [source.root / name for name in SPLIT_FILES if (source.root / name).is_file()]
    whole = source.root / "transforms.json"
    return splits or ([whole] if whole.is_file() else [])


def _is_of(kind: str, source: Source, signs: Sequence[Path]) -> bool:
    """Whether a transforms.json is of this dialect, by the keys that only one of them has. Raises BadInput where it cannot be read."""
    document = _documents(source, signs)[0][1]
    frames = [frame for frame in document["frames"] if isinstance(frame, dict)]
    if any(key in document for key in _NERFSTUDIO_KEYS) or any("mask_path" in frame or "depth_file_path" in frame for frame in frames):
        return kind == "nerfstudio"
    if any(key in document for key in _NGP_KEYS) or any("transform_matrix_start" in frame for frame in frames):
        return kind == "instant-ngp"
    return kind == ("blender" if "camera_angle_x" in document and "fl_x" not in document else "nerfstudio")


def _documents(source: Source, signs: Sequence[Path]) -> Documents:
    return [(file, read_document(source.real(file))) for file in signs]


def _listed(kind: str, source: Source, signs: Sequence[Path]) -> Listed:
    documents = _documents(source, signs)
    first, where = documents[0][1], ", ".join(file.name for file in signs)
    frames = _frames(documents)

    def finish(capture: Capture, kept: Sequence[Frame]) -> Capture:
        warnings = _remarks(capture, kept)
        if signs[0].name in SPLIT_FILES and (source.root / "transforms.json").is_file():
            warnings.append(f"transforms.json is not read: {where} have the same frames, with splits.")
        points, more = _points(source, first)
        return replace(capture, points=points, warnings=(*capture.warnings, *warnings, *more))

    return Listed(
        where,
        frames,
        [*signs, *(ply for _, document in documents if (ply := _ply(source, document)) is not None)],
        up=Z_UP if kind == "blender" else None,
        bounds=_bounds(first, signs[0]) if kind == "instant-ngp" else None,
        metric=any("depth_file_path" in frame.own[1] for frame in frames) and "applied_scale" not in first,
        facts={key: _fact(first[key]) for key in (*_NERFSTUDIO_FACTS, *_NGP_FACTS) if key in first},
        masks=_masks,
        depth=partial(_depth, source),
        finish=finish,
        remedy="Copy them into the source folder, or take their frames out of the JSON.",
    )


def _remarks(capture: Capture, kept: Sequence[Frame]) -> list[str]:
    """Warnings about frames whose images are used."""
    warnings = []
    if rolling := sum("transform_matrix" not in frame.own[1] for frame in kept):
        warnings.append(f"{rolling} frames have a rolling shutter (transform_matrix_start, _end); the middle pose is used.")
    if lost := sum("mask_path" in frame.own[1] and photo.mask is None for frame, photo in zip(kept, capture.photos, strict=True)):
        warnings.append(f"{lost} listed masks (mask_path) are missing; those images are used without one.")
    cameras = [photo.camera for photo in capture.photos]
    if off := sum(not (0 < camera.intrinsics["cx"] < camera.width and 0 < camera.intrinsics["cy"] < camera.height) for camera in cameras):
        warnings.append(f"{off} cameras have their principal point outside the image: cx, cy may belong to another size.")
    return warnings


def _fact(value: Any, depth: int = 2) -> Any:
    """A value of the file as reports can hold it; what is large, nested or no JSON is only described."""
    if isinstance(value, str):
        return printable(value, MAX_NAME)
    if isinstance(value, list) and len(value) <= 16 and depth:
        return [_fact(entry, depth - 1) for entry in value]
    return value if value is None or isinstance(value, bool) or finite(value, 2.0**53) is not None else shown(value)


def read_document(file: Path) -> dict[str, Any]:
    """The document of a transforms.json that lists 1 to `MAX_FRAMES` frames. Raises BadInput."""
    document = read_json(file, "Write the data set again, or repair that place.")
    if not isinstance(document, dict) or not isinstance(document.get("frames"), list):
        raise BadInput(f"{file}: no data set: expected an object with a list `frames`. Name the folder of a data set, or choose a format with --as.")
    if not document["frames"]:
        raise BadInput(f"{file}: its list of frames is empty. At least {MIN_IMAGES} are needed.")
    if len(document["frames"]) > MAX_FRAMES:
        raise BadInput(f"{file}: {len(document['frames'])} frames; at most {MAX_FRAMES} are read.")
    return document


def _frames(documents: Documents) -> list[Frame]:
    """Each keeps its document, and its own part of it."""
    listed = []
    for file, document in documents:
        split_of_file = SPLIT_FILES.get(file.name) if len(documents) > 1 else None
        split_of_name: dict[str, str] = {}
        for split in ("train", "val", "test"):
            names = document.get(f"{split}_filenames", [])
            if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
                raise BadInput(f"{file}: {split}_filenames is not a list of names.")
            split_of_name |= dict.fromkeys(map(_plain, names), split)
        for index, entry in enumerate(document["frames"]):
            if not isinstance(entry, dict) or not isinstance(entry.get("file_path"), str):
                raise BadInput(f"{file}: frame {index} has no `file_path`. Write the data set again, or take it out.")
            name = entry["file_path"]
            where, own = f"{file.name}: frame {index} ({printable(name, MAX_NAME)})", (document, entry)
            listed.append(Frame(name, file.parent, where, camera_of(*own, where), split=split_of_file or split_of_name.get(_plain(name)), own=own))
    return listed


def _plain(name: str) -> str:
    return name.removeprefix("./").replace("\\", "/")


def _masks(source: Source, found: Sequence[tuple[Frame, Path]]) -> Masks:
    """The masks that frames name; of frames that name none, those next to their images."""
    masks: Masks = {}
    unnamed = []
    for frame, image in found:
        listed = frame.own[1].get("mask_path")
        if isinstance(listed, str) and listed:
            if (mask := source.find(listed, frame.folder).path) is not None:
                masks[image] = mask, "black"
            continue
        named = (image.with_name(f"dynamic_mask_{name}.png") for name in (image.stem, image.name))
        dynamic = next((source.check_inside(path) for path in named if os.path.isfile(path)), None)
        if dynamic is not None:
            masks[image] = dynamic, "white"
        else:
            unnamed.append(image)
    return masks | {image: (mask, "black") for image, mask in masks_of(source, unnamed).items()}


def _depth(source: Source, frame: Frame, image: Path) -> DepthFile | None:
    """The depth of a frame: nerfstudio's in millimetres, instant-ngp's in units that the file states. Of poses that were scaled afterwards it is not used."""
    document, entry = frame.own
    if isinstance(entry.get("depth_file_path"), str) and "applied_scale" not in document:
        listed, unit = entry["depth_file_path"], MILLIMETRE
    elif isinstance(entry.get("depth_path"), str):
        listed, unit = entry["depth_path"], finite(document.get("integer_depth_scale")) or 0.0
    else:
        return None
    path = source.find(listed, frame.folder, (".png",)).path if unit > 0 else None
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
    usable = (np.abs(cloud.vertices) <= LARGEST_NUMBER).all(-1)  # not nan either
    if not usable.any():
        return None, [f"{path.name}: holds no points; not used."]
    return sparse_points(cloud.vertices[usable], None if cloud.colours is None else cloud.colours[usable]), []


def _pose(entry: dict[str, Any], where: str) -> np.ndarray:
    """(4, 4) camera to world, with the project's axes, of a frame. Raises BadInput."""
    if "transform_matrix" in entry:
        return pose_from_opengl(lenses.rigid(entry["transform_matrix"], f"{where}: transform_matrix"))
    if "transform_matrix_start" in entry and "transform_matrix_end" in entry:
        start, end = (lenses.rigid(entry[key], f"{where}: {key}") for key in ("transform_matrix_start", "transform_matrix_end"))
        middle = 0.5 * (start + end)
        left, _, right = np.linalg.svd(middle[:3, :3])  # the rotation half way
        middle[:3, :3] = left @ right
        return pose_from_opengl(middle)
    raise BadInput(f"{where}: no `transform_matrix`. Write the data set again, or take that frame out.")


def camera_of(document: dict[str, Any], entry: dict[str, Any], where: str) -> CameraOf:
    """For a frame: the camera of an entry of the document. Raises BadInput when it is called."""
    return lambda name, size: _camera(document | entry, name, size, _pose(entry, where), where)


def _camera(given: dict[str, Any], name: str, actual: tuple[int, int], pose: np.ndarray, where: str) -> Camera:
    """The camera at the size that the file states, or at the image's own where it states none.

    given  what stands at the top, overruled by what stands in the frame
    """

    number = partial(json_file.number, given, where=where, remedy="Write the data set again.", default=0.0)
    for key in _UNSUPPORTED:
        if given.get(key):
            raise BadInput(f"{where}: lens model {key} is not supported. Undistort the images first, e.g. to a pinhole or OPENCV_FISHEYE camera.")
    width, height = (number("w"), number("h")) if "w" in given and "h" in given else actual
    stated = lenses.image_size(width, height, where, "Correct w and h.")
    focal = {}
    for axis, side in (("x", width), ("y", height)):
        if f"fl_{axis}" in given:
            focal[axis] = number(f"fl_{axis}")
        elif f"camera_angle_{axis}" in given:
            angle = number(f"camera_angle_{axis}")
            if not MIN_ANGLE < angle < math.pi:
                raise BadInput(f"{where}: camera_angle_{axis} is {angle:g}; expected an angle between 0 and pi, in radians.")
            focal[axis] = 0.5 * side / math.tan(0.5 * angle)
    if not focal:
        raise BadInput(f"{where}: no focal length: expected fl_x or camera_angle_x, at the top or in the frame.")
    fx = focal.get("x", focal.get("y", 0.0))
    fy = focal.get("y", fx)
    named = {"f": fx, "fx": fx, "fy": fy, "cx": number("cx", default=width / 2), "cy": number("cy", default=height / 2)}
    named |= {key: number(key) for key in ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")}
    model = _model(given, named, where)
    camera = Camera(name, *stated, model, tuple(named[parameter] for parameter in MODELS[model]), pose)
    return lenses.validated(camera, where)


def _model(given: dict[str, Any], named: dict[str, float], where: str) -> str:
    """COLMAP's name of the lens that a frame states."""
    stated = given.get("camera_model")
    if given.get("is_fisheye") is True:
        stated = "OPENCV_FISHEYE"
    if stated is None or stated == "OPENCV":
        if named["k4"] or named["k5"] or named["k6"]:
            raise BadInput(f"{where}: k4 to k6 without `camera_model`; their meaning differs between models. State FULL_OPENCV or OPENCV_FISHEYE.")
        if named["k3"]:
            return "FULL_OPENCV"
        if stated == "OPENCV" or any(named[key] for key in ("k1", "k2", "p1", "p2")):
            return "OPENCV"
        return "SIMPLE_PINHOLE" if named["fx"] == named["fy"] else "PINHOLE"
    if not isinstance(stated, str) or stated not in MODELS:
        raise BadInput(f"{where}: camera_model {shown(stated)}; supported are {', '.join(MODELS)}. Undistort the images first.")
    unused = [key for key in ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2") if named[key] and key not in MODELS[stated]]
    if unused:
        raise BadInput(f"{where}: camera_model {stated} with {', '.join(unused)}, which that model does not have. State the model that fits.")
    if "f" in MODELS[stated] and named["fx"] != named["fy"]:  # SIMPLE_... and RADIAL have one focal length
        return "PINHOLE" if stated == "SIMPLE_PINHOLE" else "OPENCV"
    return str(stated)


def _format(kind: str) -> ListFormat:
    return ListFormat(kind, "transforms.json or transforms_train.json", _json_files, partial(_listed, kind), partial(_is_of, kind))


BLENDER, NERFSTUDIO, INSTANT_NGP = map(_format, ("blender", "nerfstudio", "instant-ngp"))
