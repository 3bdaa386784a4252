"""The points stage: points spread evenly over the asset's surface, with normals and colours, as PLY in the capture's frame."""

from collections.abc import Callable

from efficientnerf.asset.format import load
from efficientnerf.asset.tree import NerfTree, Region
from efficientnerf.settings import resolved
from efficientnerf.surface.isosurface import NoSurface
from efficientnerf.surface.mesh import PointCloud
from efficientnerf.surface.nested import scene_points
from pipeline.errors import StageFailed, UsageError
from pipeline.stage import Job
from stages.artifacts import PointsInputs, PointsOutputs, inputs_of
from stages.compiling import compiling_kernels
from stages.formats.exporters import POINT_EXPORTERS
from stages.formats.exporters.writing import SourceFrame, source_frame
from stages.framing.restriction import restricted
from stages.memory.need import refuse_what_does_not_fit
from stages.mesh.check import asset_views, level_of, shown_by
from stages.mesh.memory import surface_needed
from stages.mesh.run import PARTS, orbit_points, remedy, whole_progress
from stages.points.settings import PointsSettings


def points_of(
    tree: NerfTree, settings: PointsSettings, frame: SourceFrame, progress: Callable[[int, int, str], None], region: Region | None = None
) -> PointCloud:
    """Points on the tree's surface, clipped to a region, in the capture's frame.

    Raises StageFailed where there is none, UsageError where there is none at a density that was stated; `progress` takes (done, total, text).
    """
    progress = whole_progress(progress, 1 + len(tree.outer))
    views, fused = asset_views(tree, progress)

    def tick() -> None:
        progress(1, 1, PARTS[0])

    try:
        cloud = scene_points(
            tree,
            settings.num_points,
            level_of(tree, resolved(settings.density_threshold), views, tick),
            min_component=settings.min_component,
            rounds=settings.smoothing_iterations,
            seed=settings.seed,
            viewpoints=orbit_points(tree.metadata),
            shown=shown_by(views, float(tree.voxel), tick),
            views=fused if resolved(settings.density_threshold) is None else (),
            region=region,
            progress=progress,
        )
    except NoSurface as error:
        failure = StageFailed if settings.density_threshold == "auto" else UsageError
        raise failure(f"points: {error}. {remedy('points', resolved(settings.density_threshold))}") from error
    back = frame.world_from_capture.inverse()
    return PointCloud(back.points(cloud.positions), cloud.normals @ back.rotation.T, cloud.colours)


@compiling_kernels
def run(job: Job) -> None:
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
