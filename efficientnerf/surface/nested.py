"""The surface of an unbounded scene: that of each cascade in its own grid, joined.

A cascade's surface is cut where the one before begins and where its own box ends, and open there. Voxels of two cascades differ by a factor of two, so that
the parts do not meet: flaps of both cover the crack.

V vertices, F faces.
"""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from efficientnerf.asset.cascades import cascade_sides, cascade_tree, cascades_of, point_cascades, voxel_cascades
from efficientnerf.asset.tree import Cascade, NerfTree, Region
from efficientnerf.surface.agreement import AssetView
from efficientnerf.surface.extraction import surface
from efficientnerf.surface.fusion import fusion_of
from efficientnerf.surface.isosurface import NoSurface, Progress
from efficientnerf.surface.mesh import Mesh, face_areas
from efficientnerf.surface.visible_parts import Shown
from efficientnerf.surface.volume import volume_of

MIN_FACES = 20
SKIPPED = 2  # of the views whose depths are fused, one in this many has its silhouette fitted
BORDER = 0.6  # voxels of a cascade from the borders of its box, and of the one before, in which its surface has lids
ALONG = 0.7  # cosine of a lid's normal to that of the border
# Voxels of the coarser cascade: how far from the border of the two, and from each other, open edges face each other; how far a flap goes on; between samples.
FACING, OVERLAP, SPACING = 2.0, 0.5, 0.25


def scene_surface(
    tree: NerfTree, threshold: float | None, *, faces: int, min_component: float, rounds: int, viewpoints: np.ndarray, progress: Progress,
    shown: Shown | None = None, views: Sequence[AssetView] = (), region: Region | None = None,
) -> Mesh:  # fmt: skip
    """The surface of all cascades as one mesh; of a tree with one grid the same as `surface`. Arguments as there.

    threshold  density per world unit of the inmost cascade; each one after it has half of that, for its voxels are twice as large
    views      of the tree by cameras with images of one size, whose depths are fused; none, and of cascades beyond the region: the densities alone decide
    region     that the surface is clipped to
    faces      budget of all together, shared by the numbers of voxels; a cascade whose share is under MIN_FACES is left out, but for the greatest

    Raises NoSurface where no cascade has any.
    """
    fused = _cascades_of_region(tree, region)

    def surface_of(number: int, part: NerfTree, budget: int) -> Mesh:
        # Cascades after the first `fused` may hold parts of a few voxels, and fused distances are smoothed over more than one.
        fusion = fusion_of(part, views, lambda: progress(0, 1, "marching cubes")) if views and number < fused else None
        return surface(
            volume_of(part, region), None if threshold is None else threshold / 2.0**number, faces=budget, min_component=min_component, rounds=rounds,
            viewpoints=viewpoints, shown=shown, fusion=fusion, silhouettes=views[::SKIPPED] if number == 0 and tree.ndc is None else (), progress=progress,
        )  # fmt: skip

    if not tree.outer:
        return surface_of(0, tree, faces)
    found = []
    sizes = np.bincount(voxel_cascades(tree), minlength=len(cascades_of(tree)))
    for number, size in enumerate(sizes.tolist()):
        share = faces * size // len(tree.density_values)
        if not size or (share < MIN_FACES and number != int(sizes.argmax())):
            continue
        try:
            mesh = surface_of(number, cascade_tree(tree, number), share)
        except NoSurface:
            continue
        kept = _visible(tree, number, mesh.vertices, mesh.faces)
        if kept.any():
            found.append(_part(mesh, kept, number))
    if not found:
        raise NoSurface("the density of no cascade reaches the threshold" + ("" if threshold is None else f" {threshold:.4g}"))
    cascades = cascades_of(tree)
    for n, (fine, coarse) in enumerate(itertools.pairwise(list(found))):
        if coarse.number == fine.number + 1:
            seam = cascades[fine.number], tree.brick, cascades[coarse.number].voxel
            found[n : n + 2] = _with_flaps(found[n], coarse, *seam), _with_flaps(coarse, fine, *seam)
    return _joined(found)


def face_sizes(tree: NerfTree, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(F,) areas of a surface's faces, counted in faces of the voxels there: points in proportion to them are sparser where voxels are larger, and of a
    forward-facing tree as far apart in images at any depth.

    vertices  (V, 3) in the world
    """
    if tree.ndc is not None:
        return face_areas(tree.ndc.points(vertices), faces)
    sides = cascade_sides(tree)[point_cascades(tree, vertices[faces].mean(axis=1))]  # beyond all boxes, by less than a voxel, that of the last
    return face_areas(vertices, faces) / sides**2


def _cascades_of_region(tree: NerfTree, region: Region | None) -> int:
    """How many cascades hold the foreground region, but for a voxel of the last; 1 without a region."""
    cascades = cascades_of(tree)
    for count, cascade in enumerate(cascades, 1):
        low, high = cascade.bounds(tree.brick)
        if region is None or ((region.bounds[0] >= low - cascade.voxel) & (region.bounds[1] <= high + cascade.voxel)).all():
            return count
    return len(cascades)


def _visible(tree: NerfTree, number: int, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(F,) bool: faces of a cascade's surface that lie in its box, not in the one before, and do not close it where it merely ends at a border."""
    cascades = cascades_of(tree)
    corners = vertices[faces]  # (F, 3, 3)
    middle = corners.mean(axis=1)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    out = np.ones(len(faces), bool)
    if number:
        out &= (_depth(cascades[number - 1], tree.brick, middle) <= 0).any(axis=1)
        out &= ~_lids(cascades[number - 1], tree.brick, middle, -normal, cascades[number].voxel)
    if number + 1 < len(cascades):
        out &= (_depth(cascades[number], tree.brick, middle) >= 0).all(axis=1)
        out &= ~_lids(cascades[number], tree.brick, middle, normal, cascades[number].voxel)
    return out


def _depth(cascade: Cascade, brick: int, at: np.ndarray) -> np.ndarray:
    """(F, 3) how far points lie inside of the nearer side of a box along each axis."""
    low, high = cascade.bounds(brick)
    return np.asarray(np.minimum(at - low, high - at))


def _lids(cascade: Cascade, brick: int, at: np.ndarray, normal: np.ndarray, voxel: float) -> np.ndarray:
    """(F,) bool: faces about at a side of a box, and along it, with normals out of it."""
    low, high = cascade.bounds(brick)
    outward = np.maximum(np.sign(at - (low + high) / 2) * normal, 0)
    near = np.abs(_depth(cascade, brick, at)) < BORDER * voxel  # of several sides at edges and corners, which are bevelled
    return np.asarray(np.linalg.norm(np.where(near, outward, 0), axis=1) > ALONG)


class _Part(NamedTuple):
    """What is seen of a cascade's surface."""

    number: int  # of the cascade
    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    colours: np.ndarray
    facts: dict[str, object]


def _part(mesh: Mesh, kept: np.ndarray, number: int) -> _Part:
    used, index = np.unique(mesh.faces[kept], return_inverse=True)
    return _Part(number, mesh.vertices[used], index.reshape(-1, 3), mesh.normals[used], mesh.colours[used], mesh.facts)


def _open_edges(part: _Part, border: Cascade, brick: int, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """(E, 2) edges that one face has, in its order, and the face's third corner (E,), within reach of the border of a box."""
    edges, third = part.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), part.faces[:, [2, 0, 1]].ravel()
    key = edges @ [len(part.vertices), 1]
    near = (np.abs(_depth(border, brick, part.vertices).min(axis=1)) < reach)[edges].all(axis=1)
    alone = near & ~np.isin(key, edges[:, ::-1] @ [len(part.vertices), 1])
    return edges[alone], third[alone]


def _with_flaps(part: _Part, other: _Part, border: Cascade, brick: int, voxel: float) -> _Part:
    """A part with a flap from each open edge to the open edges of the other part that it faces, and a little farther."""
    edges, third = _open_edges(part, border, brick, FACING * voxel)
    others, _ = _open_edges(other, border, brick, FACING * voxel)
    if not len(edges) or not len(others):
        return part
    begin, whole = other.vertices[others[:, 0]], np.diff(other.vertices[others], axis=1)[:, 0]
    pieces = 1 + (np.linalg.norm(whole, axis=1) / (SPACING * voxel)).astype(np.int64)
    piece = np.repeat(np.arange(len(others)), pieces)
    share = (np.arange(len(piece)) - (np.cumsum(pieces) - pieces)[piece] + 0.5) / pieces[piece]
    samples = begin[piece] + share[:, None] * whole[piece]
    along = part.vertices[edges[:, 1]] - part.vertices[edges[:, 0]]
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-300)
    inward = part.vertices[third] - part.vertices[edges[:, 0]]
    inward -= (inward * along).sum(axis=1, keepdims=True) * along
    outward = np.zeros_like(part.vertices)
    np.add.at(outward, edges.ravel(), np.repeat(-inward / np.maximum(np.linalg.norm(inward, axis=1, keepdims=True), 1e-300), 2, axis=0))
    rim = np.unique(edges)
    distance, nearest = cKDTree(samples).query(part.vertices[rim])
    facing = np.zeros(len(part.vertices), bool)
    facing[rim] = distance < FACING * voxel
    edges = edges[facing[edges].all(axis=1)]
    rim, nearest = rim[facing[rim]], nearest[facing[rim]]
    if not len(edges):
        return part
    direction = outward[rim] / np.maximum(np.linalg.norm(outward[rim], axis=1, keepdims=True), 1e-300)
    beyond = np.zeros(len(part.vertices), np.int64)
    beyond[rim] = len(part.vertices) + np.arange(len(rim))
    (u, v), (u2, v2) = edges.T, beyond[edges].T
    flaps = np.concatenate([np.stack([v, u, u2], axis=1), np.stack([v, u2, v2], axis=1)])
    vertices = np.concatenate([part.vertices, samples[nearest] + OVERLAP * voxel * direction])
    used, index = np.unique(np.concatenate([part.faces, flaps]), return_inverse=True)
    normals, colours = (np.concatenate([each, each[rim]])[used] for each in (part.normals, part.colours))
    return part._replace(vertices=vertices[used], faces=index.reshape(-1, 3), normals=normals, colours=colours)


def _joined(parts: list[_Part]) -> Mesh:
    """One mesh of several parts; the facts are those of the first, with the numbers of faces and components summed."""
    first = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = [part.faces + begin for part, begin in zip(parts, first[:-1].tolist(), strict=True)]
    facts: dict[str, object] = dict(parts[0].facts) | {"cascades": len(parts)}
    for name, value in facts.items():
        others = [part.facts.get(name) for part in parts]
        if name != "cascades" and all(type(other) is int for other in [value, *others]):
            facts[name] = sum(other for other in others if isinstance(other, int))
    vertices, normals, colours = (np.concatenate([getattr(part, name) for part in parts]) for name in ("vertices", "normals", "colours"))
    return Mesh(vertices, np.concatenate(faces).astype(np.int64), normals, colours, facts)
