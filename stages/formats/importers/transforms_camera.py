"""The camera of a frame of a transforms.json: matrix and lens, as nerfstudio and instant-ngp name them."""

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from efficientnerf.geometry.cameras import MODELS, Camera, pose_from_opengl
from pipeline.errors import BadInput
from stages.formats.importers import lenses
from stages.io import json_file
from stages.io.json_file import shown

MIN_ANGLE = 1e-9  # radians; its tangent is a number yet
_UNSUPPORTED = ("ftheta_p0", "latlong", "equirectangular")


def pose_of(entry: dict[str, Any], where: str) -> np.ndarray:
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


def camera_of(document: dict[str, Any], entry: dict[str, Any], where: str) -> Callable[[str, tuple[int, int]], Camera]:
    """For a frame: the camera of an entry of the document. Raises BadInput when it is called."""
    return lambda name, size: lens_of(document | entry, name, size, pose_of(entry, where), where)


def lens_of(given: dict[str, Any], name: str, actual: tuple[int, int], pose: np.ndarray, where: str) -> Camera:
    """The camera at the size that the file states, or at the image's own where it states none.

    given  what stands at the top, overruled by what stands in the frame
    """

    number = partial(json_file.number, given, where=where, remedy="Write the data set again.", default=0.0)
    for key in _UNSUPPORTED:
        if given.get(key):
            raise BadInput(f"{where}: lens model {key} is not supported. Undistort the images first, e.g. to a pinhole or OPENCV_FISHEYE camera.")
    width, height = (number("w"), number("h")) if "w" in given and "h" in given else actual
    stated = lenses.image_size(width, height, where, "Correct w and h.")
    fx, fy = _focal(given, number, width, height, where)
    named = {"f": fx, "fx": fx, "fy": fy, "cx": number("cx", default=width / 2), "cy": number("cy", default=height / 2)}
    named |= {key: number(key) for key in ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")}
    model = _model(given, named, where)
    camera = Camera(name, *stated, model, tuple(named[parameter] for parameter in MODELS[model]), pose)
    return lenses.validated(camera, where)


def _focal(given: dict[str, Any], number: Any, width: float, height: float, where: str) -> tuple[float, float]:
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
    return fx, focal.get("y", fx)


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
