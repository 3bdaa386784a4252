"""The mesh stage: the asset's surface with a texture, as PLY and OBJ in the capture's frame and as GLB, a report, and a preview."""

from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from efficientnerf.asset.format import load
from efficientnerf.asset.tree import NerfTree, Region
from efficientnerf.settings import resolved
from efficientnerf.surface.agreement import AssetView
from efficientnerf.surface.isosurface import NoSurface
from efficientnerf.surface.mesh import Mesh, face_areas, face_volumes, moved, topology
from efficientnerf.surface.nested import scene_surface
from pipeline.errors import UsageError
from pipeline.files import write_json
from pipeline.stage import Job
from stages.artifacts import BakeOutputs, MeshOutputs
from stages.compiling import running_kernels
from stages.figures.shading import IN_FRONT, render_sides
from stages.formats.exporters import MESH_EXPORTERS
from stages.formats.exporters.writing import SourceFrame, source_frame
from stages.framing.restriction import restricted
from stages.io.png import write_png
from stages.memory.need import refuse_what_does_not_fit
from stages.mesh.check import asset_views, checked, level_of, shown_by, warning_of
from stages.mesh.files import write_empty_meshes
from stages.mesh.memory import needed
from stages.mesh.refinement import refined_surface
from stages.mesh.settings import MeshSettings
from stages.mesh.texture import facts_of, textured

PARTS = ("marching cubes", "colours")  # of finding a surface, as efficientnerf.surface.isosurface reports them
STEPS = 500  # of the progress of each
SURFACE_SHARE = 0.7  # of the stage's time; the texture takes the rest


def mesh_of(
    tree: NerfTree, settings: MeshSettings, progress: Callable[[int, int, str], None], region: Region | None = None
) -> tuple[Mesh, list[AssetView]]:
    """The tree's surface in the training frame, and the views of the asset that say which components it shows. Raises UsageError where there is no surface at
    a density that was stated; else it has no faces then, and "no_surface" among its facts says why.

    progress  takes (done, total, text)
    region    that the surface is clipped to
    """
    progress = whole_progress(progress, 1 + len(tree.outer))
    seen, fused = asset_views(tree, progress)
    threshold = resolved(settings.density_threshold)

    def tick() -> None:
        progress(1, 1, PARTS[0])

    try:
        mesh = scene_surface(
            tree,
            level_of(tree, threshold, seen, tick),
            faces=settings.faces,
            min_component=settings.min_component,
            rounds=settings.smoothing_iterations,
            viewpoints=orbit_points(tree.metadata),
            shown=shown_by(seen, float(tree.voxel), tick),
            views=fused if threshold is None else (),
            region=region,
            progress=progress,
        )
    except NoSurface as error:
        if threshold is not None:
            raise UsageError(f"mesh: {error}. {remedy(threshold)}") from error
        mesh = nothing(str(error))
    return replace(mesh, facts=mesh.facts | {"threshold_chosen": "automatic" if threshold is None else "given"}), seen


def nothing(why: str) -> Mesh:
    """A mesh without faces."""
    return Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64), np.zeros((0, 3)), np.zeros((0, 3), np.float32), {"no_surface": why})


def whole_progress(progress: Callable[[int, int, str], None], grids: int) -> Callable[[int, int, str], None]:
    """Progress over views of the asset and the parts of the surfaces of so many grids together: a bar that never goes back."""
    begun: list[str] = []
    reached, most = 0, 1 + grids * len(PARTS)

    def part(done: int, total: int, text: str) -> None:
        nonlocal reached
        if not begun or (begun[-1] != text and len(begun) < most):
            begun.append(text)
        reached = max(reached, (len(begun) - 1) * STEPS + (STEPS * done // total if total else STEPS))
        progress(reached, most * STEPS, text)

    return part


def orbit_points(metadata: Mapping[str, Any]) -> np.ndarray:
    """(N, 3) points on the orbit of the capture's cameras, training frame; none where the asset's metadata have no orbit."""
    orbit = metadata.get("orbit")
    if not orbit:
        return np.zeros((0, 3))
    turn, tilt = np.radians(float(orbit["heading"]) + np.arange(8) * 45.0), np.radians(float(orbit["elevation"]))
    direction = np.stack([np.cos(tilt) * np.cos(turn), np.cos(tilt) * np.sin(turn), np.full(8, np.sin(tilt))], 1)
    return np.asarray(orbit["centre"], np.float64) + float(orbit["radius"]) * direction[: 1 if orbit["forward_facing"] else 8]


def remedy(threshold: float | None) -> str:
    """What to do where no surface was found."""
    if threshold is None:
        return "The asset is nearly empty: train longer, or set mesh.density_threshold by hand."
    return f"Lower mesh.density_threshold (found {threshold:g}), or set it to auto."


def in_capture(mesh: Mesh, frame: SourceFrame) -> Mesh:
    """A mesh of the training frame in the capture's."""
    back = frame.world_from_capture.inverse()
    return moved(mesh, back.scale, back.rotation, back.translation)


def describe(mesh: Mesh, frame: SourceFrame) -> dict[str, Any]:
    """The report of a mesh in the capture's frame: counts, topology, bounds, area, volume, settings."""
    found = topology(mesh.vertices, mesh.faces)
    return {
        "vertices": len(mesh.vertices),
        "faces": len(mesh.faces),
        **asdict(found),
        "bounds": [mesh.vertices.min(0).tolist(), mesh.vertices.max(0).tolist()] if len(mesh.vertices) else None,
        "unit": "metre" if frame.metric else "unknown",
        "area": float(face_areas(mesh.vertices, mesh.faces).sum()),
        "volume": float(face_volumes(mesh.vertices, mesh.faces).sum()) if found.watertight else None,
        **mesh.facts,
    }


def preview_of(mesh: Mesh, metadata: Mapping[str, Any], *, clipped: bool) -> np.ndarray:
    """(H, W, 3) uint8: a mesh of the training frame from four sides, of a capture from one side those that its cameras saw.

    clipped  whether the mesh ends at a region's border. One that does not may reach far behind its subject: then the nearest four fifths are shown
    """
    orbit = metadata.get("orbit", {})
    heading, elevation = float(orbit.get("heading", 0.0)), float(np.clip(orbit.get("elevation", 20.0), 10.0, 35.0))
    if not orbit.get("forward_facing", False):
        return render_sides(mesh, heading=heading, elevation=elevation)
    return render_sides(mesh, heading=heading, elevation=0.0, turns=IN_FRONT, shown=1.0 if clipped else 0.8)


def write_empty(outputs: MeshOutputs, mesh: Mesh, seen: list[AssetView], frame: SourceFrame, job: Job) -> None:
    """The files of a mesh without faces, and a warning: the run's other outputs do not need a mesh."""
    write_empty_meshes(outputs, frame)
    agreed, picture = checked(mesh, seen, job.safe_point)
    for path in (outputs.preview, outputs.check):
        write_png(picture, path)
    write_json(outputs.report, describe(mesh, frame) | {"region": job.settings.region} | agreed)
    job.warn(f"the mesh is empty: {mesh.facts['no_surface']}. {remedy(None)}")
    job.say("no faces", faces=0, components=0, watertight=False)


@running_kernels
def run(job: Job) -> None:
    outputs, settings, captured = MeshOutputs(job.out), job.settings, (job.inputs["poses"], job.inputs["train"])
    whole = load(BakeOutputs(job.inputs["bake"]).asset)
    tree = restricted(whole, settings.region)
    frame = source_frame(tree.metadata)
    refuse_what_does_not_fit(job, needed(tree, settings, captured[0]), "Lower bake.max_mib, bake.resolution or mesh.texture_size.")
    share = 1.0 if settings.texture == "off" else SURFACE_SHARE
    border = whole.region if settings.region == "foreground" else None
    surface, seen = mesh_of(tree, settings, lambda done, total, text: job.reached(share * done, total, text), border)
    if "no_surface" in surface.facts:
        write_empty(outputs, surface, seen, frame, job)
        return
    surface = refined_surface(surface, seen, settings, job)
    rest = 1 - share
    found = textured(
        surface, tree, captured, settings.texture, settings.texture_size, lambda done, total, text: job.reached(share * total + rest * done, total, text)
    )
    job.safe_point()
    write_png(preview_of(found, tree.metadata, clipped=border is not None), outputs.preview)
    job.safe_point()
    mesh = in_capture(found, frame)
    for path in (outputs.ply, outputs.glb, outputs.obj):
        MESH_EXPORTERS[path.suffix](mesh, path, frame)
    agreed, picture = checked(found, seen, job.safe_point)
    write_png(picture, outputs.check)
    report = describe(mesh, frame) | {"region": job.settings.region} | agreed
    write_json(outputs.report, report)
    if (doubt := warning_of(report)) is not None:
        job.warn(doubt)
    if not report["watertight"]:
        job.warn(f"the mesh is not closed: {report['open_edges']} open and {report['non_manifold_edges']} non-manifold edges")
    facts = {name: report[name] for name in ("faces", "components", "watertight")}
    job.say(f"{report['faces']} faces in {report['components']} component{'s' if report['components'] != 1 else ''}{facts_of(report)}", **facts)
