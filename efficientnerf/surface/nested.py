"""The surface of an unbounded scene: that of each cascade in its own grid, joined.

A cascade's surface is cut where the one before begins and where its own box ends, and open there. The parts are not sewn together: between cascades, whose
voxels differ by a factor of two, there may be cracks of about a voxel.

F faces.
"""

from collections.abc import Sequence

import numpy as np

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
        found.append((mesh, _visible(tree, number, mesh.vertices, mesh.faces)))
    if not any(kept.any() for _, kept in found):
        raise NoSurface("the density of no cascade reaches the threshold" + ("" if threshold is None else f" {threshold:.4g}"))
    return _joined([(mesh, kept) for mesh, kept in found if kept.any()])


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


def _joined(parts: list[tuple[Mesh, np.ndarray]]) -> Mesh:
    """One mesh of the chosen faces (F,) of several; the facts are those of the first, with the numbers of faces and components summed."""
    vertices, faces, normals, colours, first = [], [], [], [], 0
    for mesh, kept in parts:
        used, index = np.unique(mesh.faces[kept], return_inverse=True)
        vertices.append(mesh.vertices[used])
        normals.append(mesh.normals[used])
        colours.append(mesh.colours[used])
        faces.append(index.reshape(-1, 3) + first)
        first += len(used)
    facts: dict[str, object] = dict(parts[0][0].facts) | {"cascades": len(parts)}
    for name, value in facts.items():
        others = [mesh.facts.get(name) for mesh, _ in parts]
        if name != "cascades" and all(type(other) is int for other in [value, *others]):
            facts[name] = sum(other for other in others if isinstance(other, int))
    return Mesh(np.concatenate(vertices), np.concatenate(faces).astype(np.int64), np.concatenate(normals), np.concatenate(colours), facts)
