"""OpenVDB: sparse grids of density and colour, as Blender and Houdini read them, in the capture's frame.

OpenVDB's own library has no wheel for every Python. This module writes a small part of its format, version 224: a tree of nodes of
32^3, 16^3 and 8^3 children, leaves of 8^3 voxels, and of each leaf a mask of its voxels and the values of those alone. Blender's library reads it in tests.

    density    float  per unit of the capture's frame: light falls to exp(-density) along one unit
    color      vec3s, 16 bits  linear light, 0 to 1, where there is density; as the captured cameras see it, for a volume has one colour

The cascades of an unbounded scene follow as density_1 and color_1, and so on, their voxels twice as large each time, with what lies in the box before left out.

N voxels, L leaves.
"""

from __future__ import annotations

import hashlib
import struct
import uuid
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from efficientnerf.asset.captured import captured_of
from efficientnerf.asset.cascades import cascade_tree, cascades_of, voxel_coordinates
from efficientnerf.asset.queries import normal_at
from efficientnerf.asset.region import voxel_centres
from efficientnerf.asset.tree import NerfTree
from efficientnerf.geometry.directions import outside_directions
from efficientnerf.rendering.colour import linear_from_srgb
from efficientnerf.rendering.harmonics import basis_numpy
from pipeline.errors import BadInput, UsageError
from stages.formats.exporters.writing import CAPTURE_IS_Z_UP, SourceFrame, write_parts

MAGIC, VERSION, LIBRARY = 0x56444220, 224, (12, 0)
ACTIVE_VALUES = 2  # compression: of nodes the values of their active voxels alone
LEAF, LOWER, UPPER = 3, 4, 5  # binary logarithms of the nodes' sides, in children
ROOT = LEAF + LOWER + UPPER
AT_ONCE = 1 << 16  # voxels whose colours are looked up
COLOUR_VIEWS = 16  # captured cameras that colours are seen from
_INACTIVE_ARE_BACKGROUND = b"\0"


@dataclass(frozen=True, eq=False)
class Grid:
    """Values at some voxels, zero elsewhere."""

    name: str
    coordinates: np.ndarray  # (N, 3) integers, each once
    values: np.ndarray  # (N,) or (N, 3), float32 or float16
    matrix: np.ndarray  # (4, 4) from the coordinates to the world: a voxel's centre lies at its coordinates


def write_volume(tree: NerfTree, path: Path, frame: SourceFrame = CAPTURE_IS_Z_UP) -> None:
    """Write an asset's densities and colours in the capture's frame. Raises UsageError for a forward-facing scene, BadInput for an empty asset."""
    write_grids(grids_of(tree, frame, path), path, frame.unit)


def grids_of(tree: NerfTree, frame: SourceFrame, path: Path) -> list[Grid]:
    """Density and colour of each cascade that holds something."""
    if tree.ndc is not None:
        remedy = "Export its points or a mesh instead, or train with --set poses.space=contracted."
        raise UsageError(f"{path}: the asset's grid is of normalised device coordinates, which no volume has. {remedy}")
    back, inner, found = frame.world_from_capture.inverse().matrix(), None, []
    for number, cascade in enumerate(cascades_of(tree)):
        part = cascade_tree(tree, number) if tree.outer else tree
        at = voxel_coordinates(part)
        centres = cascade.bounds_min + (at + 0.5) * cascade.voxel
        kept = part.density_values > 0
        if inner is not None:
            kept &= ~((centres >= inner[0]) & (centres < inner[1])).all(axis=1)
        inner = cascade.bounds(tree.brick)
        if not kept.any():
            continue
        matrix = np.diag([cascade.voxel] * 3 + [1.0])
        matrix[:3, 3] = cascade.bounds_min + 0.5 * cascade.voxel
        suffix = f"_{number}" if number else ""
        with np.errstate(over="ignore"):
            density = (part.density_values[kept] * frame.world_from_capture.scale).astype(np.float32)
        if not np.isfinite(density).all():
            raise BadInput(f"{path}: densities that are not finite in single precision. Bake the asset again.")
        found += [Grid(f"density{suffix}", at[kept], density, back @ matrix), Grid(f"color{suffix}", at[kept], _colours(part, kept), back @ matrix)]
    if not found:
        raise BadInput(f"{path}: the asset holds no density. Bake it again.")
    return found


def _colours(tree: NerfTree, kept: np.ndarray) -> np.ndarray:
    """(n, 3) float16, linear: for an asset that keeps its captured cameras, the mean over some of these, by how squarely each looks at the surface; else
    the median over views from outside, as in `surface_colours`. The harmonic of degree 0 is no such mean: unseen directions, as of a surface from
    within, are overfitted. docs/experiments/volume-colours.md"""
    voxels, centres, captured, eyes = np.flatnonzero(kept), voxel_centres(tree), captured_of(tree.metadata), None
    if captured is not None:  # (C, 3) where some of its cameras stood, spread over their path
        eyes = captured.centres[np.unique(np.linspace(0, len(captured.centres) - 1, COLOUR_VIEWS).round().astype(int))]
    out = np.empty((len(voxels), 3), np.float16)
    for start in range(0, len(voxels), AT_ONCE):
        chosen = voxels[start : start + AT_ONCE]
        normal = np.asarray(normal_at(tree, centres[chosen]), np.float64)
        normal[~normal.any(axis=1)] = (0.0, 0.0, 1.0)
        coefficients = tree.coefficients(chosen)  # (n, K, 3)
        directions = outside_directions(normal) if eyes is None else [_towards(centres[chosen], eye) for eye in eyes]
        views = [np.einsum("nk,nkc->nc", basis_numpy(direction, tree.degree), coefficients) for direction in directions]
        if eyes is None:
            logits = np.median(views, axis=0)
        else:
            facing = np.stack([np.maximum(-(direction * normal).sum(axis=1), 0) + 1e-3 for direction in directions])  # (C, n)
            logits = (facing[..., None] * views).sum(axis=0) / facing.sum(axis=0)[:, None]
        out[start : start + AT_ONCE] = linear_from_srgb(1 / (1 + np.exp(-np.clip(logits, -80, 80))))
    return out


def _towards(points: np.ndarray, eye: np.ndarray) -> np.ndarray:
    """(n, 3) unit directions of rays from an eye to points."""
    away = points - eye
    return np.asarray(away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-12))


def write_grids(grids: list[Grid], path: Path, unit: str = "unknown") -> None:
    """Write grids to one file, whole or not at all, whose metadata state the unit; the same grids give the same bytes."""
    trees = [_Tree(grid) for grid in grids]
    digest = hashlib.sha256()
    for tree in trees:
        for part in (tree.descriptor(), tree.head, tree.leaves.tobytes(), tree.masks.tobytes(), tree.values.tobytes()):
            digest.update(part)
    identity = str(uuid.UUID(digest.hexdigest()[:32])).upper()
    head = struct.pack("<qI2IB", MAGIC, VERSION, *LIBRARY, 1) + identity.encode("ascii")
    about = _table({"creator": ("string", b"efficientnerf"), "unit": ("string", unit.encode("ascii"))})
    write_parts(path, _parts(head + about + struct.pack("<i", len(grids)), trees))


def _parts(head: bytes, trees: list[_Tree]) -> Iterator[bytes]:
    """The file piece by piece; each grid is preceded by where it and its values begin, and where it ends."""
    yield head
    at = len(head)
    for tree in trees:
        described = tree.descriptor()
        begin = at + len(described) + 24
        values, end = begin + len(tree.head) + tree.topology_bytes, begin + len(tree.head) + tree.topology_bytes + tree.value_bytes
        yield described + struct.pack("<3q", begin, values, end)
        yield tree.head
        yield from tree.topology()
        yield from tree.leaf_values()
        at = end


class _Tree:
    """A grid sorted into nodes."""

    def __init__(self, grid: Grid) -> None:
        at = np.asarray(grid.coordinates, np.int64)
        roots, root = np.unique(at >> ROOT, axis=0, return_inverse=True)  # in the order of their coordinates, as the library keeps them
        place = ((root.reshape(-1) << 3 * UPPER | _offset(at, LEAF + LOWER, UPPER)) << 3 * LOWER | _offset(at, LEAF, LOWER)) << 3 * LEAF | _offset(at, 0, LEAF)
        order = np.argsort(place, kind="stable")
        place = place[order]
        self.name, self.roots = grid.name, roots << ROOT
        self.half = grid.values.dtype == np.float16
        self.values = np.ascontiguousarray(grid.values[order]).astype("<f2" if self.half else "<f4")
        self.vector = self.values.ndim == 2
        self.leaves, self.first = np.unique(place >> 3 * LEAF, return_index=True)  # (L,)
        mask = np.zeros((len(self.leaves), 8**LEAF), bool)
        mask[np.repeat(np.arange(len(self.leaves)), np.diff(self.first, append=len(place))), place & 8**LEAF - 1] = True
        self.masks = np.packbits(mask, axis=1, bitorder="little")  # (L, 64)
        entries = {
            "class": ("string", b"unknown" if self.vector else b"fog volume"),
            "file_bbox_max": ("vec3i", at.max(axis=0).astype("<i4").tobytes()),
            "file_bbox_min": ("vec3i", at.min(axis=0).astype("<i4").tobytes()),
            "file_voxel_count": ("int64", struct.pack("<q", len(at))),
            "is_saved_as_half_float": ("bool", bytes([self.half])),
            "name": ("string", self.name.encode("ascii")),
        }
        self.head = struct.pack("<I", ACTIVE_VALUES) + _table(entries) + _text("AffineMap") + np.ascontiguousarray(grid.matrix.T, "<f8").tobytes()
        self.lower, self.upper = np.unique(self.leaves >> 3 * LOWER), np.unique(self.leaves >> 3 * (LOWER + UPPER))
        background = 12 if self.vector else 4
        nodes = sum(len(there) * (2 * 8**side // 8 + 1) for there, side in ((self.lower, LOWER), (self.upper, UPPER)))
        self.topology_bytes = 4 + background + 8 + 12 * len(self.roots) + nodes + self.masks.size
        self.value_bytes = self.masks.size + len(self.leaves) + self.values.nbytes

    def descriptor(self) -> bytes:
        kind = f"Tree_{'vec3s' if self.vector else 'float'}_{UPPER}_{LOWER}_{LEAF}{'_HalfFloat' if self.half else ''}"
        return _text(self.name) + _text(kind) + _text("")

    def topology(self) -> Iterator[bytes]:
        """Which nodes there are: a node's own, then those of its children, each in turn."""
        yield struct.pack("<I", 1) + bytes(12 if self.vector else 4) + struct.pack("<2I", 0, len(self.roots))
        lower_first = np.searchsorted(self.lower >> 3 * UPPER, np.arange(len(self.roots) + 1))
        leaf_first = np.searchsorted(self.leaves >> 3 * LOWER, self.lower)
        leaf_end = np.append(leaf_first[1:], len(self.leaves))
        for number, origin in enumerate(self.roots):
            children = slice(lower_first[number], lower_first[number + 1])
            yield origin.astype("<i4").tobytes() + _node(self.lower[children], UPPER)
            for k in range(children.start, children.stop):
                leaves = slice(leaf_first[k], leaf_end[k])
                yield _node(self.leaves[leaves], LOWER) + self.masks[leaves].tobytes()

    def leaf_values(self) -> Iterator[bytes]:
        ends = np.append(self.first[1:], len(self.values))
        for mask, first, end in zip(self.masks, self.first.tolist(), ends.tolist(), strict=True):
            yield mask.tobytes() + _INACTIVE_ARE_BACKGROUND + self.values[first:end].tobytes()


def _node(children: np.ndarray, side: int) -> bytes:
    """An inner node: the mask of its children, that of its tiles, of which it has none, and so no values of these."""
    mask = np.zeros(8**side, bool)
    mask[children & 8**side - 1] = True
    return np.packbits(mask, bitorder="little").tobytes() + bytes(8**side // 8) + _INACTIVE_ARE_BACKGROUND


def _offset(at: np.ndarray, below: int, side: int) -> np.ndarray:
    """(N,) the number of the child that holds each coordinate, in a node whose children have 2^below voxels a side; z runs fastest."""
    part = at >> below & 2**side - 1
    return np.asarray((part[:, 0] << side | part[:, 1]) << side | part[:, 2])


def _text(text: str) -> bytes:
    return struct.pack("<I", len(text.encode("ascii"))) + text.encode("ascii")


def _table(entries: dict[str, tuple[str, bytes]]) -> bytes:
    """Metadata: name, type and value each."""
    return struct.pack("<I", len(entries)) + b"".join(
        _text(name) + _text(kind) + struct.pack("<I", len(value)) + value for name, (kind, value) in entries.items()
    )
