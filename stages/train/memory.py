"""Memory of training. docs/experiments/memory.md"""

from collections.abc import Sequence
from pathlib import Path

from efficientnerf.fields.hash import FEATURES, grids, level_sizes
from efficientnerf.geometry.spaces import Space
from efficientnerf.settings import resolved
from efficientnerf.training.pixels import EXACT, LISTED_SHARE, STRIDE, PixelRows
from efficientnerf.training.plain_regions import LONGEST, MOST_DISCS
from efficientnerf.training.settings import TrainSettings
from pipeline.executors.memory import size_text
from pipeline.stage import Job
from stages.artifacts import PosesOutputs
from stages.io.field_file import space_of
from stages.io.scene import View, load, views_of
from stages.memory.forecast import Known
from stages.memory.need import Need, fits_now, libraries, refuse_what_does_not_fit
from stages.train.data import MOST_OBSERVATIONS, channels_of, count_pixels, reading_threads
from stages.train.hash_resolution import with_auto_sizes
from stages.train.pixel_file import PixelFile

PIXELS = "training pixels"
# Bytes. A direction of each pixel of a lens while the table of directions is built, in float64; a density voxel, with what an update of some of them takes;
# sparse points, over those of their file, and an observation of one that is used: its rays and what they are made of.
DIRECTION, DENSITY_VOXEL = 220, 26
PLAIN, DISC, PHOTOGRAPH = 64, 24, 10  # a pixel of the picture that plain regions are looked for in, a disc of one, and a pixel of the photograph
TABLES, SAVED = 4, 6  # of float32 for each parameter: itself, its gradient, Adam's moments; and while a checkpoint is written, three of these twice
POINTS, OBSERVATION = 4, 250
# Bytes written. Of a parameter in the field's file, and in a checkpoint, with Adam's moments; of a density voxel in either; of a training pixel. Checkpoints
# that are there while the newest is written.
WRITTEN, CHECKPOINT, WRITTEN_VOXEL, CHANNELS = 4, 12, 5, 4
KEPT = 3


def pixels_needed(views: Sequence[View], channels: int) -> dict[str, int]:
    """The terms of `efficientnerf.training.pixels.Pixels`, in memory."""
    cameras = [view.camera for view in views]
    total = count_pixels(tuple(views))
    lenses = {(camera.width, camera.height, camera.model, camera.params) for camera in cameras}
    every = 1 if sum(width * height for width, height, *_ in lenses) <= EXACT else STRIDE
    knots = [(width // every + 2) * (height // every + 2) for width, height, *_ in lenses]
    # Bits of all pixels, and the numbers of those that are listed.
    masks = total // 8 + int(4 * LISTED_SHARE * total) if any(view.mask is not None for view in views) else 0
    largest = max(camera.width * camera.height for camera in cameras)
    return {
        PIXELS: total * channels + masks,
        "reading images": (1 + 2 * reading_threads()) * channels * largest,  # as decoded, and one as it is put in rows
        "directions of pixels": 12 * sum(knots) + DIRECTION * max(knots),
    }


def parameters(settings: TrainSettings) -> int:
    """Parameters of both fields, about."""
    hidden = settings.num_layers * settings.hidden_dim**2 + settings.coarse_num_layers * settings.coarse_hidden_dim**2
    if settings.field != "hash":
        return hidden
    return hidden + FEATURES * sum(sum(level_sizes(**grid)[1]) for grid in grids(settings))


def step_bytes(settings: TrainSettings, intervals: int) -> int:
    """Bytes of a step's samples, kept for the backward pass, about. Kernels of hash grids keep features and outputs; other fields keep each layer.

    intervals  on a ray, at most
    """
    fine = settings.max_pivots * settings.samples_per_pivot if settings.sampling == "efficient" else settings.num_importance_samples
    samples = settings.max_rays_per_batch * (intervals + fine)
    if settings.sample_batch_size != "off":
        samples = min(samples, 2 * settings.sample_batch_size)
    outputs = 1 + 3 * (settings.sh_degree + 1) ** 2
    if settings.field == "hash":
        return samples * 4 * (4 * settings.num_levels + 6 * outputs + 32)
    return samples * (2 * settings.hidden_dim * settings.num_layers + 4 * (4 * 63 + 6 * outputs + 32))


def needed(settings: TrainSettings, views: Sequence[View], channels: int, space: Space, device: str = "cpu", points: int = 0) -> Need:
    """Memory of training, with the pixels there.

    settings  with numbers for what is "auto" (`stages.train.hash_resolution`)
    channels  of the pixels
    points    bytes of the file of sparse points
    """
    pixels = pixels_needed(views, channels)
    reading = pixels["reading images"] + pixels["directions of pixels"]
    largest = max(view.camera.width * view.camera.height for view in views)
    plain = PLAIN * min(largest, LONGEST**2) + PHOTOGRAPH * largest + DISC * MOST_DISCS if settings.plain_loss_weight else 0
    intervals = space.max_intervals(space.sampled_length(None) / (resolved(settings.num_coarse_samples) or space.num_coarse_samples))
    return Need({
        PIXELS: pixels[PIXELS],
        "a step's samples, or reading images": max(step_bytes(settings, intervals), reading, plain),
        "parameters and checkpoints": 4 * (TABLES + SAVED) * parameters(settings),
        "density voxels": DENSITY_VOXEL * (resolved(settings.occupancy_resolution) or space.occupancy_resolution) ** 3,
        "sparse points": POINTS * points + OBSERVATION * min(MOST_OBSERVATIONS, points // 8),
        "libraries": libraries(device),
    })  # fmt: skip


def place_pixels(job: Job, most: Need, least: Need, views: Sequence[View], channels: int, remedy: str) -> PixelRows | None:
    """Where the training pixels are put: None for memory, or a file in the scratch folder. Raises UsageError where even `least` does not fit then.

    most, least  the need with the pixels in memory, at most and at least
    remedy       as for `refuse_what_does_not_fit`
    """
    if fits_now(job, most):
        refuse_what_does_not_fit(job, least, remedy)
        return None
    pixels = count_pixels(tuple(views))
    refuse_what_does_not_fit(job, least.without(PIXELS, pixels * channels), remedy)
    job.warn(
        f"the training pixels, {size_text(pixels * channels)}, do not fit into memory and are kept in a file, which is slower to read."
        " Raise --memory, or lower poses.max_image_size."
    )
    return PixelFile(pixels, channels, job.work)


def rows_for_training(job: Job, folder: Path, views: tuple[View, ...], settings: TrainSettings, space: Space) -> PixelRows | None:
    """`place_pixels` for the stage train; `settings` as for `needed`."""
    tables = f"train.log2_hashmap_size ({settings.log2_hashmap_size}), " if settings.field == "hash" else ""
    batch = "train.max_rays_per_batch" if settings.sample_batch_size == "off" else "train.sample_batch_size"
    remedy = f"Lower {tables}{batch} ({getattr(settings, batch[6:])}) or poses.max_image_size."
    need = training_needed(folder, views, settings, space, job.device)
    return place_pixels(job, need, need, views, channels_of(folder, views), remedy)


def training_needed(folder: Path, views: tuple[View, ...], settings: TrainSettings, space: Space, device: str) -> Need:
    """Memory of the stage train, `folder` being the scene's; the rest as for `needed`."""
    file = PosesOutputs(folder).points
    points = file.stat().st_size if file.is_file() else 0
    return needed(settings, views, channels_of(folder, views), space, device, points)


def memory_needed(known: Known) -> Need:
    """Memory of the stage train."""
    return training_needed(known.run / "poses", *_before(known), known.device)


def space_needed(known: Known) -> int:
    """The field, its checkpoints, and pixels that do not fit into memory."""
    views, own, space = _before(known)
    pixels = CHANNELS * count_pixels(views)
    saved = KEPT if own.time_budget != "off" else min(KEPT, 1 + (own.iterations - 1) // own.checkpoint_every)
    voxels = WRITTEN_VOXEL * (resolved(own.occupancy_resolution) or space.occupancy_resolution) ** 3
    stored = pixels if known.memory is not None and pixels > known.memory // 2 else 0
    return (WRITTEN + saved * CHECKPOINT) * parameters(own) + (1 + saved) * voxels + stored + known.pictures()


def _before(known: Known) -> tuple[tuple[View, ...], TrainSettings, Space]:
    """Training views, settings without "auto" as for `needed`, and the field's space."""
    s = load(known.run / "poses")
    views = views_of(s, "train")
    return views, with_auto_sizes(known.settings["train"], s, count_pixels(views)), space_of(s)
