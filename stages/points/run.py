"""The points stage: points spread evenly over the asset's surface, with normals and colours, as PLY in the capture's frame."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal

from msgspec import Meta

from efficientnerf.settings import Auto, Density, Fraction, Seed, given, setting
from pipeline.errors import StageFailed, UsageError
from pipeline.stage import Job, Stage
from stages.artifacts import PointsInputs, PointsOutputs, inputs_of, needs_of
from stages.compiling import compiling_kernels
from stages.mesh.check import asset_views, level_of, shown_by
from stages.mesh.run import PARTS, orbit_points, remedy, whole_progress

if TYPE_CHECKING:
    from efficientnerf.asset.region import Region
    from efficientnerf.surface.mesh import PointCloud
    from stages.formats.exporters.writing import SourceFrame


@dataclass(frozen=True)
class PointsSettings:
    """How points are spread over the surface."""

    region: Literal["foreground", "all"] = setting(
        "foreground", "What gets points: the subject with what supports it, its edge clipped (foreground), or the whole scene (all).", advanced=True
    )
    num_points: Annotated[int, Meta(ge=1, le=10**8)] = setting(200_000, "Number of points.")
    density_threshold: Density | Auto = setting(
        "auto",
        "Density at which the surface lies, per unit of the training frame; auto: where views agree on its depth, else where it has their silhouettes.",
        advanced=True,
    )
    min_component: Fraction = setting(
        0.0, "Area below which connected components get no points, as a fraction of the largest one's; nor do those that no view shows.", advanced=True
    )
    smoothing_iterations: Annotated[int, Meta(ge=0, le=200)] = setting(10, "Iterations of Taubin smoothing of the surface.", advanced=True)
    seed: Seed = setting(0, "Seed of the places of the points on the surface.", advanced=True)


def points_of(tree: Any, settings: PointsSettings, frame: SourceFrame, progress: Callable[[int, int, str], None], region: Region | None = None) -> PointCloud:
    """Points on the tree's surface, clipped to a region, in the capture's frame.

    Raises StageFailed where there is none, UsageError where there is none at a density that was stated; `progress` takes (done, total, text).
    """
    from efficientnerf.surface.isosurface import NoSurface
    from efficientnerf.surface.mesh import PointCloud
    from efficientnerf.surface.nested import scene_points

    progress = whole_progress(progress, 1 + len(tree.outer))
    views, fused = asset_views(tree, progress)

    def tick() -> None:
        progress(1, 1, PARTS[0])

    try:
        cloud = scene_points(
            tree,
            settings.num_points,
            level_of(tree, given(settings.density_threshold), views, tick),
            min_component=settings.min_component,
            rounds=settings.smoothing_iterations,
            seed=settings.seed,
            viewpoints=orbit_points(tree.metadata),
            shown=shown_by(views, float(tree.voxel), tick),
            views=fused if given(settings.density_threshold) is None else (),
            region=region,
            progress=progress,
        )
    except NoSurface as error:
        failure = StageFailed if settings.density_threshold == "auto" else UsageError
        raise failure(f"points: {error}. {remedy('points', given(settings.density_threshold))}") from error
    back = frame.world_from_capture.inverse()
    return PointCloud(back.points(cloud.positions), cloud.normals @ back.rotation.T, cloud.colours)


@compiling_kernels
def run(job: Job) -> None:
    from efficientnerf.asset.format import load
    from stages.formats.exporters import POINT_EXPORTERS
    from stages.formats.exporters.writing import source_frame
    from stages.framing.restriction import restricted
    from stages.memory.need import refuse_what_does_not_fit
    from stages.mesh.memory import surface_needed

    whole = load(inputs_of(PointsInputs, job.inputs).bake.asset)
    tree = restricted(whole, job.settings.region)
    frame = source_frame(tree.metadata)
    remedy = f"Lower points.num_points ({job.settings.num_points}), bake.max_mib or bake.resolution."
    refuse_what_does_not_fit(job, surface_needed(tree, job.settings.num_points), remedy)
    cloud = points_of(tree, job.settings, frame, job.reached, whole.region if job.settings.region == "foreground" else None)
    job.safe_point()
    path = PointsOutputs(job.out).ply
    POINT_EXPORTERS[path.suffix](cloud, path, frame)
    job.say(f"{len(cloud.positions)} points", points=len(cloud.positions))


STAGE = Stage(name="points", version=5, settings=PointsSettings, needs=needs_of(PointsInputs), run=run)
