"""How `--budget` is shared by the stages that train: the field, the asset, and its Gaussians."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pipeline.errors import PipelineError
from stages.formats.importers import formats_of
from stages.formats.importers.photographs import is_video, photographs
from stages.formats.importers.source import Source
from stages.io.photo import working_size
from stages.io.pictures import UnreadableImage, read_header

# Of the budget, for the stage train; the rest is bake's. docs/experiments/tree-training.md
TRAIN_SHARE = 0.3
FEW_PIXELS_TRAIN_SHARE = 0.6  # of scenes with surroundings and few pixels, which refinement soon overfits
FEW_PIXELS = 16e6  # of all photographs at working size
WITHOUT_SURROUNDINGS = ("blender", "llff")  # formats of objects before a constant background, and of forward-facing captures
MIN_TRAIN, MIN_BAKE = 15.0, 20.0  # seconds, of a budget that is large enough for both
# Of the budget, for Gaussians: the first share up to so many seconds, the second from so many on, and between them in proportion; and seconds, in which two
# cores take all steps of any capture. docs/experiments/splats.md
SPLATS_SHARES, SPLATS_SECONDS, MAX_SPLATS = (0.15, 0.25), (120.0, 600.0), 600.0


def share_budget(seconds: float, share: float, *, splats: bool) -> dict[str, float]:
    """Stage -> its time_budget; they sum to `seconds`.

    share   of what train and bake have together, for train: see `train_share`
    splats  whether the run makes Gaussians
    """
    parts = {"splats": min(_splats_share(seconds) * seconds, MAX_SPLATS)} if splats else {}
    seconds -= sum(parts.values())
    if seconds <= MIN_TRAIN + MIN_BAKE:
        train = seconds * MIN_TRAIN / (MIN_TRAIN + MIN_BAKE)
    else:
        train = min(max(share * seconds, MIN_TRAIN), seconds - MIN_BAKE)
    return {"train": train, "bake": seconds - train, **parts}


def _splats_share(seconds: float) -> float:
    (least, most), (first, last) = SPLATS_SHARES, SPLATS_SECONDS
    return least + (most - least) * min(max((seconds - first) / (last - first), 0.0), 1.0)


def train_share(sources: Sequence[Path], poses: Any) -> float:
    """The share of the stage train, by what the sources are and how many pixels their photographs have at working size.

    poses  settings of that stage

    Photographs of a source are taken to be as large as its first; videos have many pixels; a source that cannot be read has none (the stage poses reports it).
    """
    try:
        if len(sources) == 1 and formats_of(sources[0], poses)[0] in WITHOUT_SURROUNDINGS:
            return TRAIN_SHARE
        pixels = sum(_pixels(source, poses) for source in sources)
    except (PipelineError, OSError, UnreadableImage):
        pixels = 0.0
    return FEW_PIXELS_TRAIN_SHARE if pixels < FEW_PIXELS else TRAIN_SHARE


def _pixels(source: Path, poses: Any) -> float:
    pictures = [source] if is_video(source) else photographs(Source(source, poses.allow_outside))
    if any(map(is_video, pictures)):
        return float("inf")
    width, height = working_size(*read_header(pictures[0]).size, poses.max_image_size)
    return float(len(pictures) * width * height)
