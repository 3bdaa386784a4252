"""Contents of sources without cameras: photographs and their masks by name, and frames of videos, which become photographs here."""

import contextlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from pipeline.errors import BadInput
from pipeline.files import write_json
from pipeline.stage import Job
from stages.artifacts import PosesOutputs
from stages.cores import count_cores
from stages.formats.importers import one_line_errors
from stages.formats.importers.masks import masks_of
from stages.formats.importers.photographs import is_video, photographs
from stages.formats.importers.source import MIN_IMAGES, Source
from stages.io.pictures import MAX_SIDE, UnreadableImage, read_header
from stages.memory.need import refuse_what_does_not_fit
from stages.poses.memory import video_needed
from stages.video.figure import write_frames_plot, write_frames_sheet
from stages.video.frames import Reader, frames_of
from stages.video.panorama import VIEWS, is_panorama, views_of
from stages.video.reading import UnreadableVideo, opened

Warn = Callable[[str], object]
DECODERS = 16  # threads at most: each holds frames


@dataclass
class Material:
    """Files by the name that they have from here on."""

    paths: dict[str, Path] = field(default_factory=dict)  # photographs
    masks: dict[str, Path] = field(default_factory=dict)  # by the name of the photograph
    videos: dict[str, Path] = field(default_factory=dict)  # videos whose frames are to be chosen


def photographs_of(job: Job, warn: Warn) -> Material:
    """The photographs of the job's sources, with frames of videos and views of panoramas among them. Raises BadInput."""
    settings = job.settings
    longest = max(settings.max_image_size, settings.feature_image_size)
    round_about = settings.lens == "equirectangular"
    found = with_frames(job, find_material(job.sources, settings.allow_outside, warn), MAX_SIDE if round_about else longest, warn)
    return with_views(job, found, longest, warn)


def find_material(sources: Mapping[str, Path], allow_outside: bool, warn: Warn) -> Material:
    """What folders and videos hold, each by its source's name and its own; nothing is decoded. Raises BadInput."""
    found = Material()
    for called, path in sources.items():
        if not path.is_dir():
            found.videos[called or path.name] = path
            continue
        source, before = Source(path, allow_outside), f"{called}/" if called else ""
        with one_line_errors(source.root):
            files = photographs(source)
            into = found.videos if is_video(files[0]) else found.paths
            into |= {f"{before}{source.name_of(file)}": source.real(file) for file in files}
            if into is found.paths:
                found.masks |= {f"{before}{source.name_of(image)}": source.real(mask) for image, mask in masks_of(source, files).items()}
        for sentence in source.warnings():
            warn(sentence)
    return found


def with_frames(job: Job, found: Material, max_side: int, warn: Warn) -> Material:
    """The material with frames of its videos among the photographs; writes which were chosen, and why, into the artifact. Raises BadInput."""
    if not found.videos:
        return found
    sizes = []
    for path in found.videos.values():
        with contextlib.suppress(UnreadableVideo), opened(path) as video:  # reported where it is read
            sizes.append(video.stored)
    refuse_what_does_not_fit(job, video_needed(sizes), "Export the video at a lower resolution.")
    reader = Reader(min(DECODERS, count_cores()), job.work / "videos", job.progress, job.safe_point, warn)
    try:
        chosen = frames_of(found.videos, count=job.settings.frames, max_side=max_side, reader=reader)
    except UnreadableVideo as error:
        raise BadInput(f"{job.source}: {error}. Copy or export the video again.") from error
    for about in chosen.record:
        job.say(f"{about['video']}: {about['chosen']} of {about['frames']} frames chosen", video=about["video"], chosen=about["chosen"])
    if len(found.paths) + len(chosen.paths) < MIN_IMAGES:
        raise BadInput(
            f"{job.source}: frames that differ: {len(chosen.paths)}; at least {MIN_IMAGES} are needed, and 50 or more from all sides are better."
            " Walk round the subject while filming."
        )
    outputs = PosesOutputs(job.out)
    write_json(outputs.frames, {"videos": chosen.record})
    write_frames_plot(chosen.record, outputs.frames_plot)
    write_frames_sheet(chosen.record, chosen.paths, outputs.frames_sheet)
    return Material(found.paths | chosen.paths, found.masks)


def with_views(job: Job, found: Material, max_side: int, warn: Warn) -> Material:
    """The material with views of its panoramas in their place. Raises BadInput."""
    if job.settings.lens in ("perspective", "fisheye"):
        return found
    panoramas: dict[str, Path] = {}
    for name, path in found.paths.items():
        job.safe_point()
        if job.settings.lens == "auto" and is_panorama(path):
            panoramas[name] = path
        elif job.settings.lens == "equirectangular":
            with contextlib.suppress(UnreadableImage):  # reported where it is read
                width, height = read_header(path).size
                if width != 2 * height:
                    raise BadInput(f"{name}: {width}x{height} pixels; a 360-degree image is twice as wide as high. Omit --lens to read it as a photograph.")
            panoramas[name] = path
    if not panoramas:
        return found
    if masked := panoramas.keys() & found.masks.keys():
        warn(f"{len(masked)} masks of 360-degree images are not used.")
    job.say(f"{len(panoramas)} 360-degree images are cut into {VIEWS} views each")
    views = views_of(panoramas, max_side=max_side, work=job.work / "panoramas", safe_point=job.safe_point, progress=job.progress, warn=warn)
    left = {name: path for name, path in found.paths.items() if name not in panoramas}
    return Material(left | views, {name: mask for name, mask in found.masks.items() if name not in panoramas})
