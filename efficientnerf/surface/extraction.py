"""The surface of a volume: extracted, cleaned, decimated and coloured.

V vertices, F faces. Everything is in the frame of the volume (`efficientnerf.surface.volume`).
"""

from collections.abc import Sequence

import numpy as np

from efficientnerf.surface.agreement import AssetView
from efficientnerf.surface.colours import surface_colours
from efficientnerf.surface.fitting.silhouettes import fitted_to_silhouettes
from efficientnerf.surface.fusion import Fusion
from efficientnerf.surface.isosurface import NoSurface, Progress, automatic_threshold, enclosed_cells, isosurface, silent
from efficientnerf.surface.mesh import Mesh, decimate, separate, tidy, vertex_normals
from efficientnerf.surface.smoothing import FUSED_NORMALS, NORMALS, rounds_of, smooth, smooth_normals
from efficientnerf.surface.visible_parts import Shown, visible_parts
from efficientnerf.surface.volume import Volume


def cleaned_surface(
    volume: Volume, threshold: float | None, min_component: float, rounds: int, viewpoints: np.ndarray, progress: Progress, shown: Shown | None,
    fusion: Fusion | None,
) -> tuple[np.ndarray, np.ndarray, dict[str, object]]:  # fmt: skip
    """Vertices, faces and facts of the surface before it is decimated; see `surface`. `shown` takes components of the volume's frame."""
    level = automatic_threshold(volume) if threshold is None else float(threshold)
    if not (np.isfinite(level) and level > 0):
        raise NoSurface(f"threshold {level:g}: expected a density above zero")
    enclosed = enclosed_cells(volume, level, viewpoints)
    vertices, faces = isosurface(volume, level, progress, enclosed=enclosed if enclosed.any() else None, fusion=fusion)
    if not len(faces):
        raise NoSurface(f"the density nowhere reaches {level:.4g} per unit")
    vertices, faces, facts = visible_parts(vertices, faces, min_component, shown)
    if not len(faces):
        raise NoSurface(f"no view shows anything of the surface at {level:.4g} per unit")
    vertices = np.clip(smooth(vertices, faces, rounds), vertices.min(0), vertices.max(0))  # flat sides must not bulge out of the box
    return vertices, faces, {"threshold": level, "threshold_chosen": "automatic" if threshold is None else "given", **facts}


NO_VIEWPOINTS = np.zeros((0, 3))


def surface(
    volume: Volume,
    threshold: float | None = None,
    *,
    faces: int = 200_000,
    min_component: float = 0.01,
    rounds: int = 10,
    viewpoints: np.ndarray = NO_VIEWPOINTS,
    shown: Shown | None = None,
    fusion: Fusion | None = None,
    silhouettes: Sequence[AssetView] = (),
    progress: Progress = silent,
) -> Mesh:
    """The volume's surface as a closed, coloured mesh in the training frame.

    threshold      density per world unit of the surface; None: `automatic_threshold`
    faces          budget that it is decimated to
    min_component  components with less than this share of the largest one's area are removed
    rounds         of smoothing, which keeps the volume; those of smoothing normals, which keep edges, are NORMALS or FUSED_NORMALS
    viewpoints     (N, 3) camera positions that may lie inside the volume: what can be seen from there is not filled
    shown          how much views of the world show of components: those that they do not show are removed; None: all stay
    fusion         depths of views, which decide where the surface is wherever they agree; None: the densities alone do
    silhouettes    views of the asset by pinhole cameras, whose silhouettes the surface gets where it is sharply curved
    progress       called with (done, total, text); what it raises stops the work

    Of an `NdcVolume` it is the surface in normalised device coordinates (budget, rounds and sizes of components count there), in the world.

    Raises NoSurface.
    """
    seen = None if shown is None else (lambda places, triangles, component: shown(volume.tree.frame.world(places), triangles, component))
    inside = volume.inner(viewpoints)
    vertices, triangles, facts = cleaned_surface(volume, threshold, min_component, rounds, inside, progress, seen, fusion)
    facts["faces_before_decimation"] = len(triangles)
    vertices, triangles = separate(*tidy(*decimate(vertices, triangles, faces)))
    vertices, triangles, _ = visible_parts(vertices, triangles, min_component, seen)  # without parts that decimation cut off
    if len(triangles):
        low, high = vertices.min(0), vertices.max(0)
        vertices = smooth_normals(vertices, triangles, *rounds_of(NORMALS if fusion is None else FUSED_NORMALS, rounds, vertices, triangles))
        vertices = np.clip(fitted_to_silhouettes(vertices, triangles, silhouettes, lambda: progress(0, 1, "colours")), low, high)
    normals = vertex_normals(vertices, triangles)
    return volume.in_world(Mesh(vertices, triangles, normals, surface_colours(volume, vertices, normals, progress), facts))
