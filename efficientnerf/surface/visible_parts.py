"""Parts of a surface that can be seen. V vertices, F faces, C components."""

from collections.abc import Callable

import numpy as np

from efficientnerf.surface.mesh import compact, face_areas, face_components, face_volumes

Shown = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]  # vertices, faces, component (F,) -> how much is seen of each component (C,)
SHOWN = 1.0  # pixel of all views together that a component has to show


def visible_parts(
    vertices: np.ndarray, faces: np.ndarray, min_component: float, viewpoints: np.ndarray, shown: Shown | None = None
) -> tuple[np.ndarray, np.ndarray, dict[str, int]]:
    """The closed mesh without small components, hollows, and parts in hollows; or, where views say what they see, without parts that they do not.

    min_component   components with less than this share of the largest one's area are removed
    shown           how much views show of each component; None: not known
    returns         vertices, faces, and how many components were removed for which reason

    A component that encloses a negative volume is the wall of a hollow inside something solid. It cannot be seen from anywhere outside, and neither can
    the components in it. All of this is kept where one of the
    `viewpoints` (N, 3) lies in a hollow, as in a room seen from inside.
    """
    label = face_components(faces, len(vertices))
    areas, volumes = face_areas(vertices, faces), face_volumes(vertices, faces)
    area, volume = np.bincount(label, areas), np.bincount(label, volumes)
    if shown is not None:
        seen, enough = shown(vertices, faces, label) >= SHOWN, area >= min_component * area.max()
        removed = {"unseen_removed": int((~seen).sum()), "small_removed": int((seen & ~enough).sum())}
        return *compact(vertices, faces[(seen & enough)[label]]), {"components_found": len(area), **removed}
    hollow = volume <= 0
    large = ~hollow & (area >= min_component * area[~hollow].max())
    walls = vertices[faces[hollow[label]]]  # (F, 3, 3)
    if any(_crossings(viewpoint, walls) % 2 for viewpoint in viewpoints):
        hollow[:] = False
        walls = walls[:0]
        large = area >= min_component * area.max()
    first = np.full(len(area), -1)
    first[label[::-1]] = faces[::-1, 0]
    inside = np.zeros(len(area), bool)
    if len(walls):
        inside[large] = [_crossings(vertices[first[component]], walls) % 2 == 1 for component in np.flatnonzero(large)]
    kept = large & ~inside
    counts = {"small_removed": ~hollow & ~large, "hollows_removed": hollow, "hidden_removed": inside}
    return *compact(vertices, faces[kept[label]]), {"components_found": len(area), **{name: int(which.sum()) for name, which in counts.items()}}


def _crossings(point: np.ndarray, triangles: np.ndarray) -> int:
    """How many of the (F, 3, 3) triangles a ray from `point` along +x passes; a slight tilt keeps it off the grid's edges."""
    shifted = triangles - point
    shifted = shifted[..., 1:] - shifted[..., :1] * np.array([0.0137, 0.0071])  # (F, 3, 2) seen along the ray
    turn = shifted[:, [0, 1, 2], 0] * shifted[:, [1, 2, 0], 1] - shifted[:, [0, 1, 2], 1] * shifted[:, [1, 2, 0], 0]  # (F, 3) also barycentric weights
    hit = (turn > 0).all(1) | (turn < 0).all(1)
    weight = turn[hit] / turn[hit].sum(1, keepdims=True)
    return int(((weight * (triangles[hit, :, 0] - point[0])).sum(1) > 0).sum())
