"""Memory of reading photographs and finding their cameras. docs/experiments/memory.md"""

import contextlib
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from efficientnerf.settings import resolved
from pipeline.errors import PipelineError
from pipeline.stage import Job
from stages.cores import count_cores
from stages.formats.importers import formats_of
from stages.formats.importers.source import IMAGE_SUFFIXES
from stages.io.capture import FOREGROUND
from stages.io.photo import working_size
from stages.io.pictures import UnreadableImage, read_header
from stages.memory.forecast import Known, files_below, sizes_below
from stages.memory.need import IMAGING, MIB, Need, most_threads, refuse_what_does_not_fit
from stages.sfm.added.matches import MAX_AT_ONCE
from stages.sfm.added.networks import LONGEST_SIDE
from stages.sfm.matches import MAX_WORKERS, UPSAMPLE_BELOW
from stages.sfm.pairs import BLOCK_SIZE, features_for
from stages.video.panorama import VIEWS
from stages.video.reading import UnreadableVideo, opened

# Bytes. Of a pixel of the photograph that is decoded, turned, reduced and written; of a pixel of a photograph in which features are detected, on a thread
# of its own (SIFT's first octave), four times as many where that is twice as large; of an image's descriptors while they are matched.
DECODED, SIFT, DESCRIPTOR = 26, 80, 640
NETWORK = 2400  # of a pixel of a picture in a network that detects features: ALIKED-T16 took 1,200, and the larger ones have twice its channels
FRAME = 60  # of a pixel of a video: what its decoder keeps, 16 frames of 10 bits, and the frame that is checked or written
COLMAP = 200 * MIB  # the process in which structure from motion runs
# Bytes written. Of a pixel of a working image; of a feature with its matches. Times a photograph's file: what it takes as PNG.
WRITTEN, FEATURE, AS_PNG = 2, 400, 8
ASPECT = 0.75  # of the longer side of a picture: the shorter
HEADERS = 150  # of photographs that are read, evenly spaced
REMEDY = "Lower poses.feature_image_size, or reduce the largest photographs."


def decoding_needed(sizes: Sequence[tuple[int, int]], threads: int = 1) -> Need:
    """Memory to read photographs of these sizes, one at a time on each thread."""
    return Need({"a photograph": DECODED * threads * max((width * height for width, height in sizes), default=0), "libraries": IMAGING})


def video_needed(sizes: Sequence[tuple[int, int]]) -> Need:
    """Memory to decode videos of these sizes, one at a time."""
    return Need({"frames of a video": FRAME * max((width * height for width, height in sizes), default=0), "libraries": IMAGING})


def features_needed(sizes: Sequence[tuple[int, int]], max_side: int, features: int, threads: int, *, networks: bool = False) -> Need:
    """Memory to find the cameras of photographs of these sizes.

    max_side  of the photographs in which features are detected, pixels
    features  of a photograph, at most
    networks  whether photographs without a camera are matched by networks
    """
    reduced = {working_size(*size, max_side) for size in sizes}
    most = max((width * height * (4 if max(width, height) < UPSAMPLE_BELOW else 1) for width, height in reduced), default=0)
    decoded = decoding_needed(sizes).terms
    workers = min(threads, MAX_WORKERS)
    matching = workers * (COLMAP + 4 * BLOCK_SIZE * DESCRIPTOR * features) if workers > 1 and len(sizes) > 2 * BLOCK_SIZE else 0
    in_networks = min(threads, MAX_AT_ONCE) * NETWORK * LONGEST_SIDE**2 if networks else 0
    return Need({
        "a photograph, or features, on each thread": max(decoded["a photograph"] * threads, SIFT * most * threads, matching, in_networks),
        "descriptors": DESCRIPTOR * features * len(sizes),
        "libraries": decoded["libraries"] + COLMAP,
    })  # fmt: skip


def reading_threads(job: Job, sizes: Sequence[tuple[int, int]], threads: int) -> int:
    """On how many of the threads photographs of these sizes are read: as many as fit into memory."""
    return most_threads(job, threads, lambda count: decoding_needed(sizes, count))


def feature_threads(job: Job, sizes: Sequence[tuple[int, int]], max_side: int, features: int, threads: int, *, networks: bool = False) -> int:
    """On how many of the threads features are detected: as many as fit. Each image's features depend on that image alone. UsageError where one does not fit."""
    need = partial(features_needed, sizes, max_side, features, networks=networks)
    fewer = most_threads(job, threads, need)
    refuse_what_does_not_fit(job, need(fewer), REMEDY)
    if fewer < threads:
        job.warn(
            f"features are detected on {fewer} of {threads} threads, because more do not fit into memory. Raise --memory, or lower poses.feature_image_size."
        )
    return fewer


def memory_needed(known: Known) -> Need:
    """As if no cameras were known: of a set with cameras less is taken."""
    own, (pictures, sizes) = known.settings["poses"], _pictures(known.sources)
    films = []
    for path in [] if pictures else [path for source in known.sources for path in files_below(source)]:
        with contextlib.suppress(UnreadableVideo), opened(path) as video:
            films.append(video.stored)
    count = len(pictures) or own.frames
    largest = max([*sizes, *films], key=lambda size: size[0] * size[1], default=(0, 0))
    features = resolved(own.max_features) or features_for(count)
    needs = [features_needed([largest] * count, own.feature_image_size, features, count_cores(), networks=own.features_model != "off"), video_needed(films)]
    if own.mask_from == FOREGROUND:
        from stages.masking.first_training import first_training_needed  # without it the stage needs no torch

        needs.append(first_training_needed(count))
    return max(needs, key=lambda need: need.total)


def space_needed(known: Known) -> int:
    """Working images, and what structure from motion reads: copies of photographs, or the frames of videos. Videos count where there are no images."""
    own, (pictures, sizes) = known.settings["poses"], _pictures(known.sources)
    count = (len(pictures) or own.frames) * (VIEWS if own.lens == "equirectangular" else 1)
    found = True  # whether structure from motion has to find cameras, as far as is known before
    with contextlib.suppress(PipelineError, OSError):  # the stage says so
        found = len(known.sources) != 1 or formats_of(known.sources[0], own)[0] == "photographs"
    sides = (own.max_image_size, own.feature_image_size) if found else (own.max_image_size,)
    pixels = [sum(width * height for width, height in (working_size(*size, side) for side in sides)) for size in sizes]
    mean = sum(pixels) / len(pixels) if pixels else ASPECT * sum(side**2 for side in sides)
    images = WRITTEN * mean * count
    if pictures:
        images = min(images, len(sides) * AS_PNG * sum(sizes_below(pictures)))
    return int(images) + (FEATURE * (resolved(own.max_features) or features_for(count)) * count if found else 0)


def _pictures(sources: Sequence[Path]) -> tuple[list[Path], list[tuple[int, int]]]:
    """All photographs below the sources, and the sizes of some of them."""
    pictures = [path for source in sources for path in files_below(source) if path.suffix.lower() in IMAGE_SUFFIXES]
    sizes = []
    for path in pictures[:: -(-len(pictures) // HEADERS) or 1]:
        with contextlib.suppress(UnreadableImage, OSError):  # the stage says so
            sizes.append(read_header(path).size)
    return pictures, sizes
