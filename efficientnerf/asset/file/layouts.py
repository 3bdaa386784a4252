"""How the voxels of a tree lie in a file: one entry of LAYOUTS for each layout of FORMAT.md, section 3.

    sparse   the stored voxels, halves                                            2 + 6 K bytes a voxel
    compact  the stored voxels, codes into tables and palettes                    4 + G (or 2 G) bytes a voxel
    packed   the same, entropy-coded                                              about half
    full     the paper's plain layout: all voxels of each brick, halves or floats

B bricks, N stored voxels, K harmonics, G groups of them, T entries of a table, P of a palette.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from efficientnerf.asset.file import packed
from efficientnerf.asset.file.container import FormatError
from efficientnerf.asset.palettes import PaletteHarmonics
from efficientnerf.rendering.harmonics import harmonics_count

Shape = tuple[int, ...]
Tensors = dict[str, np.ndarray]


@dataclass(frozen=True)
class Layout:
    """The tensors of one layout, and how they are read."""

    minor: int  # the format 1.x that brought it
    tensors: dict[str, tuple[str, ...]]  # names besides `coarse.occupancy` (which entropy-coded layouts do not have), and the types that each may have
    # shapes that the tensors must have, from the metadata and the shapes they do have
    expected: Callable[[str, dict[str, Any], dict[str, Shape]], dict[str, Shape]]
    stored: Callable[[str, dict[str, Any], Tensors], np.ndarray]  # which voxels of each brick are stored, (B, b^3) bool
    # density (N,) float32 and harmonics of the stored voxels; anything wrong in them is a FormatError
    values: Callable[[str, dict[str, Any], Tensors, int], tuple[np.ndarray, np.ndarray | PaletteHarmonics]]
    # of an entropy-coded layout the tensors that `stored` and `values` read, those of `coarse.occupancy` among them
    unpacked: Callable[[str, dict[str, Any], Tensors], Tensors] | None = None
    # of such a layout the shapes and types that the metadata claim for these
    claimed: Callable[[str, dict[str, Any]], tuple[dict[str, Shape], dict[str, np.dtype[Any]]]] | None = None


def _voxels_of(meta: dict[str, Any]) -> int:
    return int(meta["brick"]) ** 3


def _harmonics_of(meta: dict[str, Any]) -> int:
    return harmonics_count(int(meta["sh_degree"]))


def _first(shape: Shape) -> int:
    return shape[0] if shape else -1


def _masked(name: str, meta: dict[str, Any], raw: Tensors) -> np.ndarray:
    """Rows of `brick.mask` as booleans."""
    masks, voxels = raw["brick.mask"], _voxels_of(meta)
    if not len(masks):
        return np.zeros((0, voxels), bool)
    bits = np.unpackbits(masks.view(np.uint8), axis=1, bitorder="little").view(bool)
    if bits[:, voxels:].any():
        raise FormatError(f"{name}: 'brick.mask' has bits set beyond the {voxels} voxels of a brick")
    return bits[:, :voxels]


def _mask_shape(meta: dict[str, Any], found: dict[str, Shape]) -> Shape:
    return (_first(found["brick.mask"]), math.ceil(_voxels_of(meta) / 64))


def _counted(name: str, count: int, stored: int) -> None:
    if count != stored:
        raise FormatError(f"{name}: masks name {count} voxels but {stored} are stored")


def _sound(name: str, density: np.ndarray, *coefficients: np.ndarray) -> None:
    if not (np.isfinite(density).all() and (density >= 0).all() and all(np.isfinite(values).all() for values in coefficients)):
        raise FormatError(f"{name}: densities must be finite and not negative, harmonics finite")


# sparse


def _sparse_shapes(name: str, meta: dict[str, Any], found: dict[str, Shape]) -> dict[str, Shape]:
    count = _first(found["voxel.density"])
    return {"brick.mask": _mask_shape(meta, found), "voxel.density": (count,), "voxel.sh": (count, _harmonics_of(meta), 3)}


def _sparse_values(name: str, meta: dict[str, Any], raw: Tensors, count: int) -> tuple[np.ndarray, np.ndarray]:
    _counted(name, count, len(raw["voxel.density"]))
    density, sh = raw["voxel.density"].astype(np.float32), raw["voxel.sh"].astype(np.float32)
    _sound(name, density, sh)
    return density, sh


# compact


def _groups_of(name: str, meta: dict[str, Any]) -> tuple[int, ...]:
    groups, above = meta.get("sh_groups"), _harmonics_of(meta) - 1
    if not (isinstance(groups, list) and all(type(n) is int and n > 0 for n in groups) and sum(groups) == above):
        raise FormatError(f"{name}: metadata 'sh_groups' is {str(groups)[:60]}; expected whole numbers above 0 whose sum is {above}")
    return tuple(groups)


def _compact_shapes(name: str, meta: dict[str, Any], found: dict[str, Shape]) -> dict[str, Shape]:
    count = _first(found["voxel.density"])
    groups = _groups_of(name, meta)
    codes = {"brick.mask": _mask_shape(meta, found), "voxel.density": (count,), "voxel.base": (count, 3), "voxel.sh": (count, len(groups))}
    return codes | _table_shapes(name, meta, found)


def _table_shapes(name: str, meta: dict[str, Any], found: dict[str, Shape]) -> dict[str, Shape]:
    most = {"density.table": 256, "base.table": 256, "sh.palette": 65536}
    length = {table: _first(found[table]) for table in most}
    for table, limit in most.items():
        if length[table] > limit:
            raise FormatError(f"{name}: tensor '{table}' has {length[table]} entries; expected at most {limit}")
    above = _harmonics_of(meta) - 1
    return {"density.table": (length["density.table"],), "base.table": (length["base.table"], 3), "sh.palette": (length["sh.palette"], above, 3)}


def _compact_values(name: str, meta: dict[str, Any], raw: Tensors, count: int) -> tuple[np.ndarray, PaletteHarmonics]:
    _counted(name, count, len(raw["voxel.density"]))
    for codes, entries in (("voxel.density", "density.table"), ("voxel.base", "base.table"), ("voxel.sh", "sh.palette")):
        if raw[codes].size and int(raw[codes].max()) >= len(raw[entries]):
            raise FormatError(f"{name}: '{codes}' holds the code {int(raw[codes].max())}; expected codes below the {len(raw[entries])} entries of '{entries}'")
    table, base, palette = (raw[key].astype(np.float32) for key in ("density.table", "base.table", "sh.palette"))
    _sound(name, table, base, palette)
    return table[raw["voxel.density"]], PaletteHarmonics(raw["voxel.base"], base, raw["voxel.sh"], palette, _groups_of(name, meta))


# packed


def _packed_shapes(name: str, meta: dict[str, Any], found: dict[str, Shape]) -> dict[str, Shape]:
    _claimed(name, meta)
    return {stream: (_first(found[stream]),) for stream in packed.STREAMS} | _table_shapes(name, meta, found)


def _claimed(name: str, meta: dict[str, Any]) -> tuple[dict[str, Shape], dict[str, np.dtype[Any]]]:
    return packed.claimed(name, meta, len(_groups_of(name, meta)))


# full


def _full_shapes(name: str, meta: dict[str, Any], found: dict[str, Shape]) -> dict[str, Shape]:
    bricks, voxels = _first(found["brick.density"]), _voxels_of(meta)
    return {"brick.density": (bricks, voxels), "brick.sh": (bricks, voxels, _harmonics_of(meta), 3)}


def _full_values(name: str, meta: dict[str, Any], raw: Tensors, count: int) -> tuple[np.ndarray, np.ndarray]:
    every = {"voxel.density": raw["brick.density"].reshape(-1), "voxel.sh": raw["brick.sh"].reshape(count, _harmonics_of(meta), 3)}
    return _sparse_values(name, meta, every, count)


LAYOUTS = {
    "sparse": Layout(0, {"brick.mask": ("U64",), "voxel.density": ("F16",), "voxel.sh": ("F16",)}, _sparse_shapes, _masked, _sparse_values),
    "compact": Layout(
        1,
        {
            "brick.mask": ("U64",), "voxel.density": ("U8",), "voxel.base": ("U8",), "voxel.sh": ("U8", "U16"),
            "density.table": ("F32",), "base.table": ("F32",), "sh.palette": ("F16",),
        },
        _compact_shapes, _masked, _compact_values,
    ),
    "packed": Layout(
        packed.MINOR,
        {**dict.fromkeys(packed.STREAMS, ("U8",)), "density.table": ("F32",), "base.table": ("F32",), "sh.palette": ("F16",)},
        _packed_shapes, _masked, _compact_values, packed.unpacked, _claimed,
    ),
    "full": Layout(
        1, {"brick.density": ("F16", "F32"), "brick.sh": ("F16", "F32")},
        _full_shapes, lambda name, meta, raw: np.ones(raw["brick.density"].shape, bool), _full_values,
    ),
}  # fmt: skip
