"""Memory of baking: at most, before it begins; and once its voxels are known. docs/experiments/memory.md"""

from collections.abc import Sequence

from efficientnerf.asset.file.serialisation import bytes_per_voxel
from efficientnerf.asset.refinement.error_map import MAX_CELLS
from efficientnerf.asset.refinement.fit import PATCH_SIDE
from efficientnerf.model import Model
from efficientnerf.rendering.harmonics import harmonics_count
from efficientnerf.training.pixels import PixelRows, Pixels
from pipeline.stage import Job
from stages.bake.plan import Bake, bake_plan, coarse_cells
from stages.bake.settings import BakeSettings
from stages.bake.voxels import Voxels
from stages.bake.whole_scene import PAST_SHARE
from stages.cores import count_cores
from stages.io.field_file import load_renderer
from stages.io.refined_cameras import load_scene
from stages.io.scene import View, views_of
from stages.memory.forecast import Known
from stages.memory.need import MIB, Need, libraries, refuse_what_does_not_fit
from stages.train.data import channels_of, count_pixels
from stages.train.memory import DENSITY_VOXEL, PIXELS, parameters, pixels_needed, place_pixels
from stages.train.pixel_file import PixelFile

COPIES = 3  # of every voxel's values at the same time: as baked, in the tree, and in the refinement
PACKED_COPIES = 1  # and while codes are chosen and fitted: the tree's own, those in the order of the file or decoded, two in the refinement
# Bytes. Of a voxel besides its values: coordinates and keys while it is sorted into the tree; of a coarse cell: its brick, its row while voxels are chosen,
# its distance to the next one; of a brick's voxel: greatest weight, three times while they grow, and its number; of a training pixel that visibility is
# measured on: its number, or of unbounded scenes the field's samples of its ray, twice while they are joined; of a ray of a refinement step: its records.
VOXEL, CELL, BRICK_VOXEL, VISIBILITY_RAY, SCENE_RAY, REFINEMENT_RAY = 130, 20, 16, 64, 400, 5000
ERROR_CELL = 48  # bytes of a cell of the error map: two errors, chances, factors and numbers of tiles, and what is made of these
# Bytes written: of a voxel in a checkpoint besides its values; of a ray, the field's samples of an unbounded scene. Voxels that a visibility ray shows:
# 4 to 6 were measured. Rays that are refined before a first checkpoint is written.
WRITTEN, WRITTEN_RAY, SHOWN, SHORT = 13, 700, 8, 20 * 32768
MAX_SHARES = 16  # of the rays, each with the greatest weights of all voxels: efficientnerf.backends.numba.tree.contributions


def needed_on_device(voxels: int, harmonics: int, bricks: int, cells: int, brick: int, *, smooth: bool) -> int:
    """Bytes that such a tree takes on a device while it is refined there (`efficientnerf.asset.refinement.device`): values and means of squares in
    float32, visits and stamps, sums of gradients in 64 bits; where there is a total variation (`smooth`) the six voxels next to each, and densities before a
    step; of bricks their voxels with a border; of the grid's cells three numbers while it is sent."""
    return (28 + 36 * harmonics + 28 * smooth) * voxels + 4 * (brick + 2) ** 3 * bricks + 12 * cells


def needed(
    settings: BakeSettings, plan: Bake, m: Model, views: Sequence[View], channels: int, device: str, voxels: int, cells: int | None = None, bricks: int = 0
) -> Need:
    """Memory to bake a model, with the pixels there.

    channels  of the pixels
    voxels    that are baked
    cells     coarse cells of all grids; None: neither these nor bricks are counted yet
    bricks    that are reached by samples
    """
    if cells is None:
        cells, bricks = plan.most_cells, min(plan.most_cells, voxels // 8)
    pixels, harmonics = pixels_needed(views, channels), harmonics_count(plan.degree)
    rays, copies = _rays(plan, settings, views), COPIES + PACKED_COPIES * (plan.layout == "packed")
    of_a_voxel = copies * 4 * (1 + 3 * harmonics) + VOXEL + 4 * min(MAX_SHARES, count_cores())
    return Need({
        PIXELS: pixels[PIXELS],
        "voxels": max(of_a_voxel * voxels, pixels["reading images"] + pixels["directions of pixels"]),
        "the grid": CELL * cells + BRICK_VOXEL * plan.brick_size**3 * bricks,
        "rays": (SCENE_RAY if plan.kind == "scene" else VISIBILITY_RAY) * rays + REFINEMENT_RAY * settings.refine_rays_per_batch,
        "the error map": ERROR_CELL * min(MAX_CELLS, count_pixels(tuple(views)) // PATCH_SIDE),
        "the field": 3 * 4 * parameters(m.settings) + DENSITY_VOXEL * m.voxels.side**3 // 4,
        "libraries": libraries(device),
    })  # fmt: skip


def _rays(plan: Bake, settings: BakeSettings, views: Sequence[View]) -> int:
    """That voxels are chosen by."""
    count = min(settings.visibility_rays, count_pixels(tuple(views)))
    return count + (plan.kind == "scene") * int(PAST_SHARE * count)


def rows_for_baking(job: Job, plan: Bake, m: Model, views: tuple[View, ...]) -> PixelRows | None:
    """Where the pixels are put, before anything else is done: None for memory, or a file in the scratch folder where they might not fit with the voxels.

    The number of voxels is not known yet: what would not fit without any is refused here, and the rest by `refuse_more_than_fits`, before voxels are baked.
    """
    settings, channels = job.settings, channels_of(job.inputs["poses"], views)
    most, least = (needed(settings, plan, m, views, channels, job.device, voxels) for voxels in (plan.most_voxels, 0))
    finest = plan.resolution.resolution
    remedy = f"Lower bake.max_resolution ({finest} voxels), bake.visibility_rays ({settings.visibility_rays}) or poses.max_image_size."
    return place_pixels(job, most, least, views, channels, remedy)


def refuse_more_than_fits(job: Job, plan: Bake, m: Model, views: tuple[View, ...], pixels: Pixels, voxels: Voxels) -> None:
    """UsageError where the voxels would take more memory than the job may.

    pixels  as they were placed
    """
    need = needed(job.settings, plan, m, views, pixels.images.shape[1], job.device, voxels.count, coarse_cells(voxels.grids), voxels.bricks)
    if isinstance(pixels.images, PixelFile):
        need = need.without(PIXELS, pixels.images.nbytes)
    many = f"{voxels.count:,} voxels with {harmonics_count(plan.degree)} harmonics are too many"
    refuse_what_does_not_fit(job, need, f"Lower bake.max_mib ({plan.mib:g}) or bake.resolution ({voxels.choice.resolution}): {many}.")


def memory_needed(known: Known) -> Need:
    """Most memory of the stage bake, before its voxels are counted."""
    plan, m, views = _before(known)
    channels = channels_of(known.run / "poses", views)
    return needed(known.settings["bake"], plan, m, views, channels, known.device, plan.most_voxels)


def space_needed(known: Known) -> int:
    """The field's samples, the values of the voxels as they are baked, a checkpoint of their refinement, two while it is replaced, and the asset."""
    own, (plan, _, views) = known.settings["bake"], _before(known)
    rays = _rays(plan, own, views)
    values, voxels = 4 * (1 + 3 * harmonics_count(plan.degree)), min(plan.most_voxels, SHOWN * rays)
    checkpoints = 1 if plan.refine_steps is not None and plan.refine_steps * own.refine_rays_per_batch < SHORT else 2
    asset = min(int(plan.mib * MIB), 2 * bytes_per_voxel(plan.layout, plan.degree) * voxels)
    return (values + checkpoints * (values + WRITTEN)) * voxels + asset + (plan.kind == "scene") * WRITTEN_RAY * rays + known.pictures()


def _before(known: Known) -> tuple[Bake, Model, tuple[View, ...]]:
    """The plan, the model and the training views."""
    poses, train = known.run / "poses", known.run / "train"
    m, s = load_renderer(train).model, load_scene(poses, train)
    return bake_plan(known.settings["bake"], m, s, known.device, count_cores()), m, views_of(s, "train")
