"""How `--budget` is shared by the stages that train: the field first, then the asset."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from stages.formats.importers.photographs import is_video
from stages.formats.importers.source import pictures_in
from stages.io.pictures import UnreadableImage, read_header

# Of the budget, for the stage train; the rest is bake's. docs/experiments/tree-training.md
TRAIN_SHARE = 0.3
FEW_PIXELS_TRAIN_SHARE = 0.6  # of scenes with surroundings and few pixels, which refinement soon overfits
FEW_PIXELS = 16e6  # of all photographs at working size
WITHOUT_SURROUNDINGS = ("blender", "llff")  # formats of objects before a constant background, and of forward-facing captures
MIN_TRAIN, MIN_BAKE = 15.0, 20.0  # seconds, of a budget that is large enough for both


def share_budget(seconds: float, *, few_pixels: bool = False) -> dict[str, float]:
    """Stage -> its time_budget; they sum to `seconds`. few_pixels: see `has_few_pixels`."""
    share = FEW_PIXELS_TRAIN_SHARE if few_pixels else TRAIN_SHARE
    if seconds <= MIN_TRAIN + MIN_BAKE:
        train = seconds * MIN_TRAIN / (MIN_TRAIN + MIN_BAKE)
    else:
        train = min(max(share * seconds, MIN_TRAIN), seconds - MIN_BAKE)
    return {"train": train, "bake": seconds - train}


def has_few_pixels(sources: Sequence[Path], source_format: str | None, max_image_size: int) -> bool:
    """Whether sources, read as this format, are of a scene with surroundings and have few pixels at working size. Photographs are counted in the folder that
    has most of them, and taken to be as large as the first; videos have many."""
    if source_format in WITHOUT_SURROUNDINGS:
        return False
    try:
        return not any(map(_has_videos, sources)) and sum(_pixels(source, max_image_size) for source in sources) < FEW_PIXELS
    except OSError:  # which the stage poses reports
        return False


def _has_videos(source: Path) -> bool:
    return is_video(source) or (source.is_dir() and not pictures_in(source) and any(map(is_video, source.iterdir())))


def _pixels(source: Path, longest: int) -> float:
    folders = [source, *(sorted(path for path in source.iterdir() if path.is_dir()) if source.is_dir() else ())]
    pictures = max(map(pictures_in, folders), key=len)
    if not pictures:
        return 0.0
    try:
        width, height = read_header(pictures[0]).size
    except UnreadableImage:
        return 0.0
    return len(pictures) * width * height * min(1.0, longest / max(width, height)) ** 2
