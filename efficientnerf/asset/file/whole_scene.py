"""What a file of an unbounded scene has besides one grid: nested grids, the environment map, the foreground region. FORMAT.md, sections 11 to 13.

B bricks, H rows of the environment map.
"""

import math
from typing import Any

import numpy as np

from efficientnerf.asset.cascades import MAX_CASCADES, Grid, check_nesting
from efficientnerf.asset.file.checks import FARTHEST, MAX_CELLS, coarse_shape, flag, matrix, number, numbers
from efficientnerf.asset.file.container import FormatError
from efficientnerf.asset.tree import Region

NEAREST_PREFIX = "nearest-"  # of layouts whose voxels are not interpolated; before the other prefix where both hold
NESTED_PREFIX = "nested-"  # of layouts with several grids, or with an environment map
MINOR = 4  # the version that brought them, and regions
MAX_ENVIRONMENT = 2048  # rows of an environment map
OCCUPANCY, ENVIRONMENT, REGION = "coarse.occupancy", "environment", "x.region.bricks"  # tensors


def is_nested(meta: dict[str, Any]) -> bool:
    return str(meta.get("layout")).removeprefix(NEAREST_PREFIX).startswith(NESTED_PREFIX)


def grids_of(meta: dict[str, Any]) -> list[Grid]:
    """All grids of a file whose metadata are checked, the innermost first."""
    entries = [meta, *(meta["cascades"] if is_nested(meta) else [])]
    grids = []
    for n, entry in enumerate(entries):
        x, y, z = (int(cells) for cells in entry["shape"])
        grids.append(Grid((x, y, z), float(meta["voxel"]) * 2.0**n, np.array(entry["bounds_min"], np.float64)))
    return grids


def occupancy_name(cascade: int) -> str:
    return f"{OCCUPANCY}.{cascade}" if cascade else OCCUPANCY


def environment_rows(meta: dict[str, Any]) -> int:
    """H of a file whose metadata are checked; 0 without an environment map."""
    return int(meta["environment"] or 0) if is_nested(meta) else 0


def states_region(meta: dict[str, Any]) -> bool:
    """Whether the file has a region; the key means nothing below 1.4."""
    return "region" in meta and int(str(meta["format_version"]).split(".")[1]) >= MINOR


def region_of(meta: dict[str, Any], bricks: np.ndarray | None) -> Region | None:
    """The region of a file whose metadata are checked, with its bricks (B,) bool."""
    if not states_region(meta):
        return None
    found = meta["region"]
    return Region(np.asarray(found["bounds"], np.float64), float(found["corner_radius"]), float(found["fade"]), bricks if found["bricks"] else None)


def names_bricks(meta: dict[str, Any]) -> bool:
    """Whether the file's region is of some bricks alone."""
    return states_region(meta) and bool(meta["region"]["bricks"])


def check_whole_scene(name: str, meta: dict[str, Any]) -> None:
    """Raises FormatError at the first rule that is broken; the innermost grid has been checked."""
    if is_nested(meta):
        _check_cascades(name, meta)
        if "environment" not in meta:
            raise FormatError(f"{name}: metadata 'environment' is missing; expected the rows of the map or null")
        if meta["environment"] is not None:
            number(name, meta, "environment", 1, MAX_ENVIRONMENT, whole=True)
    if states_region(meta):
        _check_region(name, meta["region"], float(meta["voxel"]))


def _check_cascades(name: str, meta: dict[str, Any]) -> None:
    found = meta.get("cascades")
    if not (isinstance(found, list) and len(found) < MAX_CASCADES and all(isinstance(entry, dict) for entry in found)):
        raise FormatError(f"{name}: metadata 'cascades' is {str(found)[:60]}; expected a list of at most {MAX_CASCADES - 1} objects")
    cells, far = math.prod(meta["shape"]), FARTHEST * float(meta["voxel"])
    for n, entry in enumerate(found, 1):
        try:
            cells += math.prod(coarse_shape(name, entry))
            numbers(name, entry, "bounds_min", 3, -far, far)
        except FormatError as error:
            raise FormatError(f"{error} (cascade {n})") from None
    if cells > MAX_CELLS:
        raise FormatError(f"{name}: cascades of {cells} coarse cells; expected at most {MAX_CELLS} in all")
    try:
        check_nesting(grids_of(meta), int(meta["brick"]))
    except ValueError as error:
        raise FormatError(f"{name}: metadata 'cascades': {error}") from None


def _check_region(name: str, found: Any, unit: float) -> None:
    if not isinstance(found, dict):
        raise FormatError(f"{name}: metadata 'region' is {str(found)[:60]}; expected an object")
    far = FARTHEST * unit
    low, high = matrix(name, found, "bounds", 2, 3, -far, far)
    if not (low < high).all():
        raise FormatError(f"{name}: metadata 'region': 'bounds' are {str(found['bounds'])[:60]}; expected the least corner, then the greatest")
    for key in ("corner_radius", "fade"):
        number(name, found, key, 0, far, whole=False)
    flag(name, found, "bricks")


def bits(values: np.ndarray) -> np.ndarray:
    """Booleans as the bytes of a tensor, the first in the least significant bit."""
    return np.packbits(np.asarray(values, bool).reshape(-1), bitorder="little")


def booleans(name: str, tensor: str, raw: np.ndarray, count: int, what: str) -> np.ndarray:
    """(count,) bool from the bytes of a tensor; bits beyond them must be 0."""
    if np.unpackbits(raw[count // 8 :], bitorder="little")[count % 8 :].any():
        raise FormatError(f"{name}: '{tensor}' has bits set beyond its {count} {what}")
    return np.unpackbits(raw, count=count, bitorder="little").view(bool)


def environment_bytes(environment: np.ndarray) -> np.ndarray:
    """The tensor of a tree's environment map (H, 2 H, 3). Raises FormatError for one that no file holds."""
    height = environment.shape[0] if environment.ndim == 3 else 0
    if environment.shape != (height, 2 * height, 3) or not 1 <= height <= MAX_ENVIRONMENT:
        raise FormatError(f"environment: shape {environment.shape}; expected (H, 2 H, 3), H from 1 to {MAX_ENVIRONMENT}; such a tree can't be saved")
    if not np.isfinite(environment).all():
        raise FormatError("environment: holds values that are not finite; such a tree can't be saved")
    return np.rint(np.clip(environment, 0, 1) * np.float32(255)).astype("<u1")


def environment_colours(raw: np.ndarray) -> np.ndarray:
    """Colours (H, 2 H, 3) float32 of the tensor."""
    return np.asarray(raw.astype(np.float32) / np.float32(255))
