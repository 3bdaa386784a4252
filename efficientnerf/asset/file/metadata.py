"""The metadata of an asset, checked: the rules of FORMAT.md, sections 2, 8 and 9; those of unbounded scenes are in `whole_scene.py`."""

from typing import Any

import numpy as np

from efficientnerf.asset.file.checks import FARTHEST, coarse_shape, flag, matrix, number, numbers
from efficientnerf.asset.file.container import FormatError
from efficientnerf.asset.file.whole_scene import MINOR, NEAREST_PREFIX, NESTED_PREFIX, check_whole_scene
from efficientnerf.asset.tree import MAX_STEP, MIN_STEP, STEP_SIZE
from efficientnerf.geometry.ndc import NUMBERS, Ndc
from efficientnerf.rendering.harmonics import MAX_DEGREE

MAJOR = 1
STEEPEST = 1e6  # of the reference camera's field of view, and of a spiral's
NDC_PREFIX = "ndc-"  # of layouts whose grid lies in normalised device coordinates: a reader that does not know them must not render it
NDC_MINOR = 2  # the version that brought them
NEAREST_MINOR = 3
STEP_MINOR = 6  # the version that brought `step_size`
STRUCTURE = {
    "format", "format_version", "layout", "shape", "brick", "voxel", "bounds_min", "sh_degree", "sh_convention", "sh_groups", "colour_space",
    "background", "sha256", "ndc", "lookup", "step_size", "cascades", "environment", "region", "packed",
}  # fmt: skip


def _check_frame(name: str, meta: dict[str, Any], unit: float) -> None:
    """The capture's frame and the cameras' orbit, where they are given; `unit` a length of the world."""
    for key in ("world_from_capture", "orbit"):
        if not isinstance(meta.get(key, {}), dict):
            raise FormatError(f"{name}: metadata '{key}' is {str(meta[key])[:60]}; expected an object")
    if "metric" in meta:
        flag(name, meta, "metric")
    if "world_from_capture" in meta:
        similarity = meta["world_from_capture"]
        number(name, similarity, "scale", 1e-30, 1e30, whole=False)
        numbers(name, similarity, "translation", 3, -1e30, 1e30)
        rotation = matrix(name, similarity, "rotation", 3, 3, -2, 2)
        if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4) or np.linalg.det(rotation) < 0:
            raise FormatError(f"{name}: metadata 'rotation' is not a rotation")
    if "orbit" in meta:
        orbit, far = meta["orbit"], FARTHEST * unit
        numbers(name, orbit, "centre", 3, -far, far)
        number(name, orbit, "radius", 1e-30, far, whole=False)
        number(name, orbit, "elevation", -90, 90, whole=False)
        number(name, orbit, "heading", -360, 360, whole=False)
        flag(name, orbit, "forward_facing")


def layout_of(meta: dict[str, Any]) -> str:
    """The layout of the tensors, without the prefixes of frame and lookup."""
    name = str(meta.get("layout")).removeprefix(NEAREST_PREFIX)
    return name.removeprefix(NDC_PREFIX) if name.startswith(NDC_PREFIX) else name.removeprefix(NESTED_PREFIX)


def layout_name(layout: str, *, ndc: bool, nested: bool, lookup: str) -> tuple[str, int]:
    """The layout's name with its prefixes, and the minor version that brought them; 0 without prefixes."""
    name, minor = (NDC_PREFIX + layout, NDC_MINOR) if ndc else (NESTED_PREFIX + layout, MINOR) if nested else (layout, 0)
    return (NEAREST_PREFIX + name, max(minor, NEAREST_MINOR)) if lookup == "nearest" else (name, minor)


def lookup_of(name: str, meta: dict[str, Any]) -> str:
    """How the voxels are looked up; the layout's name and the key `lookup` must agree."""
    nearest = str(meta.get("layout")).startswith(NEAREST_PREFIX)
    found, expected = meta.get("lookup", None if nearest else "trilinear"), "nearest" if nearest else "trilinear"
    if found != expected:
        raise FormatError(f"{name}: metadata 'lookup' is {str(found)[:60]}; expected {expected} in layout {str(meta.get('layout'))[:60]}")
    return expected


def step_size_of(name: str, meta: dict[str, Any]) -> float:
    """Distance between the samples of a ray, voxels."""
    return float(number(name, meta, "step_size", MIN_STEP, MAX_STEP, whole=False)) if "step_size" in meta else STEP_SIZE


def ndc_of(name: str, meta: dict[str, Any]) -> Ndc | None:
    """The reference camera of a file in normalised device coordinates, which must name one; None for a file in the world."""
    if not str(meta.get("layout")).removeprefix(NEAREST_PREFIX).startswith(NDC_PREFIX):
        return None
    found = meta.get("ndc")
    if not isinstance(found, dict):
        raise FormatError(f"{name}: metadata 'ndc' is {str(found)[:60]}; expected an object")
    for key in NUMBERS:
        number(name, found, key, 1e-30, 1e30, whole=False)
    matrix(name, found, "world_from_camera", 4, 4, -1e30, 1e30)
    try:
        ndc = Ndc.from_json(found)
    except ValueError as error:
        raise FormatError(f"{name}: metadata 'ndc': {error}") from None
    if not all(1 / STEEPEST <= slope <= STEEPEST for slope in ndc.slopes):
        raise FormatError(f"{name}: metadata 'ndc': 2 f / w and 2 f / h are {ndc.slopes[0]:g} and {ndc.slopes[1]:g}; expected {1 / STEEPEST:g} to {STEEPEST:g}")
    if np.abs(ndc.world_from_camera[:3, 3]).max() > FARTHEST * ndc.near:
        raise FormatError(f"{name}: metadata 'ndc': the reference camera is more than {FARTHEST:g} times `near` from the world's origin")
    return ndc


def _check_spiral(name: str, spiral: Any, unit: float) -> None:
    """The camera path before a forward-facing scene; `unit` a length of the world."""
    if not isinstance(spiral, dict):
        raise FormatError(f"{name}: metadata 'spiral' is {str(spiral)[:60]}; expected an object")
    far = FARTHEST * unit
    if "radii" in spiral:
        numbers(name, spiral, "radii", 3, 0, far)
    for key in ("focus", "far"):
        if key in spiral:
            number(name, spiral, key, unit / FARTHEST, far, whole=False)
    if "tangents" in spiral:
        numbers(name, spiral, "tangents", 2, 1 / STEEPEST, STEEPEST)


def check_metadata(name: str, meta: dict[str, Any], layouts: tuple[str, ...]) -> None:
    """Raises FormatError, naming the file `name`, at the first rule that is broken."""
    if meta.get("format") != "nerftree":
        raise FormatError(f"{name}: metadata 'format' is {str(meta.get('format'))[:60]}; expected nerftree")
    version = str(meta.get("format_version")).split(".")
    if len(version) != 2 or not all(part.isascii() and part.isdecimal() and len(part) < 6 for part in version):
        raise FormatError(f"{name}: format version {str(meta.get('format_version'))[:60]}; expected MAJOR.MINOR")
    if int(version[0]) != MAJOR:
        raise FormatError(f"{name}: format version {'.'.join(version)}; this build reads {MAJOR}.x. Upgrade efficientnerf.")
    if layout_of(meta) not in layouts:
        raise FormatError(f"{name}: layout {str(meta.get('layout'))[:60]}; this build reads {', '.join(layouts)}. Upgrade efficientnerf.")
    if meta.get("sh_convention") != "real-orthonormal-plenoctree" or meta.get("colour_space") != "srgb-sigmoid":
        found = f"harmonics {str(meta.get('sh_convention'))[:60]} in {str(meta.get('colour_space'))[:60]}"
        raise FormatError(f"{name}: {found}; expected real-orthonormal-plenoctree in srgb-sigmoid")
    coarse_shape(name, meta)
    number(name, meta, "brick", 1, 16, whole=True)
    number(name, meta, "sh_degree", 0, MAX_DEGREE, whole=True)
    far = FARTHEST * number(name, meta, "voxel", 1e-30, 1e30, whole=False)
    numbers(name, meta, "bounds_min", 3, -far, far)
    if "background" not in meta:
        raise FormatError(f"{name}: metadata 'background' is missing; expected three numbers or null")
    if meta["background"] is not None:
        numbers(name, meta, "background", 3, 0, 1)
    lookup_of(name, meta)
    step_size_of(name, meta)
    check_whole_scene(name, meta)
    ndc = ndc_of(name, meta)
    unit = float(meta["voxel"]) if ndc is None else ndc.near
    _check_frame(name, meta, unit)
    if ndc is not None and "spiral" in meta:
        _check_spiral(name, meta["spiral"], unit)
