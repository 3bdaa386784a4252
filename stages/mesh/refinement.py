"""The surface of a mesh fitted to the training photographs, where the cameras are good enough for that."""

from dataclasses import replace

import numpy as np

from efficientnerf.surface.agreement import AssetView
from efficientnerf.surface.fitting.contours import fitted_to_contours
from efficientnerf.surface.fitting.photometric import refined
from efficientnerf.surface.fitting.silhouettes import fitted_to_silhouettes
from efficientnerf.surface.mesh import Mesh, vertex_normals
from efficientnerf.surface.nested import SKIPPED
from efficientnerf.surface.smoothing import FITTED_NORMALS, rounds_of, smooth_normals
from pipeline.stage import Job
from stages.artifacts import PosesOutputs
from stages.io.refined_cameras import load_scene
from stages.io.scene import views_of
from stages.mesh.settings import MeshSettings
from stages.mesh.texture import photographs
from stages.reports import CameraVerdict, read_report

MAX_PHOTOGRAPHS = 64  # photographs, evenly spread over the capture


def refined_surface(mesh: Mesh, seen: list[AssetView], settings: MeshSettings, job: Job) -> Mesh:
    """A mesh of the training frame moved to where photographs agree on it, with the asset's silhouettes again and smoother normals, then with contours at the
    photographs' edges, and facts of that."""
    poses, train = job.inputs["poses"], job.inputs["train"]
    views, verdict = views_of(load_scene(poses, train), "train"), PosesOutputs(poses).verdict
    cameras = read_report(verdict, CameraVerdict) if verdict.is_file() else CameraVerdict()
    if settings.photometric_refinement == "off" or cameras.grade == "poor":
        return mesh
    chosen = tuple(views[n] for n in np.unique(np.linspace(0, len(views) - 1, min(MAX_PHOTOGRAPHS, len(views))).round().astype(int)))
    found = refined(mesh.vertices, mesh.faces, photographs(poses, train, chosen), job.safe_point)
    vertices = found.vertices
    if found.improved:
        vertices = fitted_to_silhouettes(vertices, mesh.faces, seen[::SKIPPED], job.safe_point)
        low, high = vertices.min(0), vertices.max(0)
        vertices = np.clip(smooth_normals(vertices, mesh.faces, *rounds_of(FITTED_NORMALS, settings.smoothing_iterations, vertices, mesh.faces)), low, high)
    fit = fitted_to_contours(vertices, mesh.faces, mesh.colours, lambda: photographs(poses, train, chosen), job.safe_point)
    vertices = fit.vertices
    facts = {
        "photo_consistency": [round(found.before, 4), round(found.after, 4)], "photo_consistent": round(found.seen, 4), "refined": found.improved,
        "contour_distance": [None if np.isnan(value) else round(value, 3) for value in (fit.before, fit.after)], "contours_fitted": fit.improved,
    }  # fmt: skip
    return replace(mesh, vertices=vertices, normals=vertex_normals(vertices, mesh.faces), facts=mesh.facts | facts)
