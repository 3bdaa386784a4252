"""What each stage writes at its peak, its scratch and what is replaced included: by settings, and by what the stages before it made.

Estimates, on the large side: only finished artifacts were compared (docs/experiments/fleet.md); a turntable's is a bound. A fleet admits stages by them: what
does not fit beside the stages that run waits, and what does not fit although nothing else runs fails its scene.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from efficientnerf.settings import given
from stages.artifacts import BakeOutputs, PosesOutputs
from stages.memory.need import MIB

LEAST = 16 * MIB  # logs, plots, manifests, previews
# Bytes. Of a pixel of a working image; of a feature with its matches; of a parameter: the field, and two checkpoints with Adam's moments.
PIXEL, FEATURE, PARAMETER = 2, 400, 4 * (1 + 2 * 3)
DECODED = 8  # times a photograph's file: what it takes as PNG
ASPECT = 0.75  # of the longer side: the shorter
BAKED = 6  # times the asset: its arrays while they are refined
ASSET_MIB = 64.0  # where the size of the asset is automatic
SURFACE = 3  # times the asset: mesh files, textures, 3D Gaussians
VIDEO_PIXEL = 1  # of a pixel of a rendered frame, beside a byte for each of its channels as PNG
EXR_PIXEL = 4 * (4 + 1 + 3 + 3)  # float32: colour with alpha, depth, normal, position


def space_needed(stage: str, run: Path, sources: Sequence[Path], settings: Mapping[str, Any], memory: int | None = None) -> int:
    """Bytes that a stage of this name writes.

    settings  of each stage by its name, dataclasses
    memory    bytes that the stage may take: what does not fit there is written; None: no limit
    """
    own = settings[stage]
    asset = BakeOutputs.of_run(run).asset
    if stage == "poses":
        return LEAST + _working_images(own, sources)
    if stage == "train":
        return LEAST + _training(own, run, memory)
    if stage == "bake":
        return LEAST + int(BAKED * (given(own.max_mib) or ASSET_MIB) * MIB)
    if stage in ("mesh", "splats", "points"):
        return LEAST + SURFACE * (asset.stat().st_size if asset.exists() else int(ASSET_MIB * MIB))
    if stage == "turntable":
        return LEAST + own.width * own.height * _frames(own)
    return LEAST + 2 * _bytes_below([PosesOutputs.of_run(run).images])


def _frames(own: Any) -> int:
    """Bytes of a turntable for each pixel of a frame: frames are in its scratch and in its artifact."""
    channels = 4 if own.background == "transparent" else 3
    deep = {"off": 0, "first": 1, "all": own.frames}[own.exr]
    return (2 * channels + VIDEO_PIXEL) * own.frames + 2 * EXR_PIXEL * deep


def _working_images(own: Any, sources: Sequence[Path]) -> int:
    """Working images, and what structure from motion reads: copies of photographs, or the frames of videos. Videos count where there are no images."""
    from stages.io.importers.source import IMAGE_SUFFIXES
    from stages.sfm.ladder import features_for
    from stages.video.panorama import VIEWS

    pictures = [path for source in sources for path in files_below(source) if path.suffix.lower() in IMAGE_SUFFIXES]
    count = (len(pictures) or own.frames) * (VIEWS if own.lens == "equirectangular" else 1)
    images = count * int(PIXEL * ASPECT * (own.max_image_size**2 + own.feature_image_size**2))
    if pictures:
        images = min(images, 2 * DECODED * sum(os.stat(path).st_size for path in pictures))
    return images + FEATURE * (given(own.max_features) or features_for(count)) * count


def _training(own: Any, run: Path, memory: int | None) -> int:
    from stages.memory.training import parameters

    pixels = 4 * DECODED * _bytes_below([PosesOutputs.of_run(run).images])
    return PARAMETER * parameters(own) + (pixels if memory is not None and pixels > memory // 2 else 0)


def _bytes_below(folders: Sequence[Path]) -> int:
    return sum(os.stat(path).st_size for folder in folders for path in files_below(folder))


def files_below(place: Path) -> list[Path]:
    """The plain files below a folder, links left out; of a file itself."""
    if place.is_file():
        return [place]
    return [path for parent, _, names in os.walk(place) for name in names if not (path := Path(parent, name)).is_symlink()]
