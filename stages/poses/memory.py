"""What reading photographs takes, and finding their cameras. docs/experiments/memory.md"""

from __future__ import annotations

from collections.abc import Sequence

from pipeline.executors.memory import available_now
from pipeline.stage import Job
from stages.io.photo import working_size
from stages.memory.need import IMAGING, MIB, Need, refuse_what_does_not_fit

# Bytes. Of a pixel of the photograph that is decoded, turned, reduced and written; of a pixel of a photograph in which features are detected, on a thread
# of its own (SIFT's first octave), four times as many where that is twice as large; of an image's descriptors while they are matched.
DECODED, SIFT, DESCRIPTOR = 26, 80, 640
NETWORK = 2400  # of a pixel of a picture in a network that detects features: ALIKED-T16 took 1,200, and the larger ones have twice its channels
FRAME = 60  # of a pixel of a video: what its decoder keeps, 16 frames of 10 bits, and the frame that is looked at or written
COLMAP = 200 * MIB  # the process in which structure from motion runs
REMEDY = "Lower poses.feature_image_size, or reduce the largest photographs."


def decoding_needed(sizes: Sequence[tuple[int, int]]) -> Need:
    """What it takes to read photographs of these sizes, one at a time."""
    return Need({"a photograph": DECODED * max((width * height for width, height in sizes), default=0), "libraries": IMAGING})


def video_needed(sizes: Sequence[tuple[int, int]]) -> Need:
    """What it takes to decode videos of these sizes, one at a time."""
    return Need({"frames of a video": FRAME * max((width * height for width, height in sizes), default=0), "libraries": IMAGING})


def features_needed(sizes: Sequence[tuple[int, int]], max_side: int, features: int, threads: int, *, networks: bool = False) -> Need:
    """What it takes to find the cameras of photographs of these sizes.

    max_side  of the photographs in which features are detected, pixels
    features  of a photograph, at most
    networks  whether photographs without a camera are matched by networks
    """
    from stages.sfm.learned.matches import AT_ONCE
    from stages.sfm.learned.networks import LONGEST
    from stages.sfm.matches import MAX_WORKERS, UPSAMPLE_BELOW
    from stages.sfm.pairs import BLOCK_SIZE

    reduced = {working_size(*size, max_side) for size in sizes}
    most = max((width * height * (4 if max(width, height) < UPSAMPLE_BELOW else 1) for width, height in reduced), default=0)
    decoded = decoding_needed(sizes).terms
    workers = min(threads, MAX_WORKERS)
    matching = workers * (COLMAP + 4 * BLOCK_SIZE * DESCRIPTOR * features) if workers > 1 and len(sizes) > 2 * BLOCK_SIZE else 0
    in_networks = min(threads, AT_ONCE) * NETWORK * LONGEST**2 if networks else 0
    return Need({
        "a photograph, or features, on each thread": max(decoded["a photograph"] * threads, SIFT * most * threads, matching, in_networks),
        "descriptors": DESCRIPTOR * features * len(sizes),
        "libraries": decoded["libraries"] + COLMAP,
    })  # fmt: skip


def refuse_large_photographs(job: Job, sizes: Sequence[tuple[int, int]]) -> None:
    """UsageError where the largest photograph does not fit into memory while it is decoded."""
    refuse_what_does_not_fit(job, decoding_needed(sizes), "Reduce the largest photographs.")


def refuse_large_videos(job: Job, sizes: Sequence[tuple[int, int]]) -> None:
    """UsageError where the frames of a video do not fit into memory while it is decoded."""
    refuse_what_does_not_fit(job, video_needed(sizes), "Export the video at a lower resolution.")


def reading_threads(job: Job, sizes: Sequence[tuple[int, int]], threads: int) -> int:
    """On how many of the threads photographs of these sizes are read: as many as fit into memory."""
    if job.memory is None:
        return threads
    now, needed = available_now(), decoding_needed(sizes).terms
    room = (job.memory.bytes if now is None else min(job.memory.bytes, now)) - needed["libraries"]
    return int(min(threads, max(1, room // max(1, needed["a photograph"]))))


def feature_threads(job: Job, sizes: Sequence[tuple[int, int]], max_side: int, features: int, threads: int, *, networks: bool = False) -> int:
    """On how many of the threads features are detected: as many as fit. Each image's features depend on that image alone. UsageError where one does not fit."""
    now = available_now()
    fewer = threads
    if job.memory is not None:
        room = job.memory.bytes if now is None else min(job.memory.bytes, now)
        while fewer > 1 and features_needed(sizes, max_side, features, fewer, networks=networks).total > room:
            fewer -= 1
    refuse_what_does_not_fit(job, features_needed(sizes, max_side, features, fewer, networks=networks), REMEDY)
    if fewer < threads:
        job.warn(
            f"features are detected on {fewer} of {threads} threads: more do not fit into memory. Give more by --memory, or lower poses.feature_image_size."
        )
    return fewer
