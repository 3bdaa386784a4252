"""Parts of a surface that can be seen. V vertices, F faces, C components."""

from collections.abc import Callable

import numpy as np

from efficientnerf.surface.mesh import compact, face_areas, face_components

Shown = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]  # vertices, faces, component (F,) -> how much is seen of each component (C,)
MIN_PIXELS = 1.0  # of all views together that a component has to show


def visible_parts(vertices: np.ndarray, faces: np.ndarray, min_component: float, shown: Shown | None) -> tuple[np.ndarray, np.ndarray, dict[str, int]]:
    """The mesh without small components and without those that no view shows.

    min_component   components with less than this share of the largest one's area are removed
    shown           how much views show of each component; None: all are shown
    returns         vertices, faces, and how many components were removed for which reason
    """
    label = face_components(faces, len(vertices))
    area = np.bincount(label, face_areas(vertices, faces))
    seen = np.ones(len(area), bool) if shown is None else shown(vertices, faces, label) >= MIN_PIXELS
    large = area >= min_component * area.max()
    facts = {"components_found": len(area), "unseen_removed": int((~seen).sum()), "small_removed": int((seen & ~large).sum())}
    return *compact(vertices, faces[(seen & large)[label]]), facts
