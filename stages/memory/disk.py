"""What each stage writes at its peak, its scratch and what is replaced included: by settings, and by what the stages before it made.

Estimates (docs/experiments/fleet.md, "Space"). A fleet admits stages by them: what does not fit beside the stages that run waits, and what does not fit
although nothing else runs fails its scene. What an interruption would add counts: a checkpoint each of training and of the refinement.
"""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from efficientnerf.settings import given
from stages.artifacts import BakeOutputs, PosesOutputs, TrainOutputs
from stages.memory.need import MIB

LEAST = MIB  # logs, plots, manifests, previews of small pictures
# Bytes. Of a pixel of a working image; of a feature with its matches; of a parameter of the field, and of a checkpoint, with Adam's moments; of a density
# voxel.
PIXEL, FEATURE, PARAMETER, CHECKPOINT, DENSITY_VOXEL = 2, 400, 4, 12, 5
KEPT = 3  # checkpoints of training while the newest is written
DECODED = 8  # times a photograph's file: what it takes as PNG
ASPECT = 0.75  # of the longer side: the shorter
PREVIEWS = 6  # pictures of a stage, as large as a working image
VOXEL = 24  # of a baked voxel, beside its values: coordinates, visits, its greatest weight
ASSET_MIB, BAKED = 64.0, 6  # where the asset, or what is baked, is not there yet; times the asset: its voxels while they are refined
MESH, SHEET = 3, MIB // 2  # times the asset: mesh files and textures; a picture of them
GAUSSIAN, POINT = 300, 30  # bytes in all files
VIDEO_PIXEL = 1  # of a pixel of a rendered frame, beside a byte for each of its channels as PNG
EXR_PIXEL = 4 * (4 + 1 + 3 + 3)  # float32: colour with alpha, depth, normal, position
HEADERS = 150  # of photographs that are read, evenly spaced


def space_needed(stage: str, run: Path, sources: Sequence[Path], settings: Mapping[str, Any], memory: int | None = None) -> int:
    """Bytes that a stage of this name writes.

    settings  of each stage by its name, dataclasses
    memory    bytes that the stage may take: what does not fit there is written; None: no limit
    """
    own = settings[stage]
    asset = BakeOutputs.of_run(run).asset
    size = asset.stat().st_size if asset.exists() else int(ASSET_MIB * MIB)
    if stage == "poses":
        return LEAST + _working_images(own, sources)
    if stage == "train":
        return LEAST + _training(own, run, memory) + _pictures(run)
    if stage == "bake":
        return LEAST + _baking(own, run) + _pictures(run)
    if stage == "mesh":
        texture = 0 if own.texture == "off" else 3 * own.texture_size**2
        return LEAST + SHEET + MESH * size + (min(texture, MESH * size) if asset.exists() else texture)
    if stage == "splats":
        return LEAST + SHEET + (0 if own.make == "off" else GAUSSIAN * own.count)
    if stage == "points":
        return LEAST + POINT * own.num_points
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
    from stages.formats.importers.source import IMAGE_SUFFIXES
    from stages.sfm.ladder import features_for
    from stages.video.panorama import VIEWS

    pictures = [path for source in sources for path in files_below(source) if path.suffix.lower() in IMAGE_SUFFIXES]
    count = (len(pictures) or own.frames) * (VIEWS if own.lens == "equirectangular" else 1)
    finding = _cameras_are_found(own, sources)
    sides = (own.max_image_size, own.feature_image_size) if finding else (own.max_image_size,)
    images = int(PIXEL * sum(_pixels(pictures, side) for side in sides) * count)
    if pictures:
        images = min(images, len(sides) * DECODED * sum(os.stat(path).st_size for path in pictures))
    return images + (FEATURE * (given(own.max_features) or features_for(count)) * count if finding else 0)


def _pixels(pictures: Sequence[Path], side: int) -> float:
    """Mean pixels of the pictures once they are no larger than `side`; of some of them."""
    from stages.io.pictures import UnreadableImage, read_header

    found = []
    for path in pictures[:: -(-len(pictures) // HEADERS) or 1]:
        with contextlib.suppress(UnreadableImage, OSError):  # the stage says so
            width, height = read_header(path).size
            found.append(width * height * min(1.0, side / max(width, height)) ** 2)
    return sum(found) / len(found) if found else ASPECT * side**2


def _cameras_are_found(own: Any, sources: Sequence[Path]) -> bool:
    """Whether structure from motion has to find them, as far as can be told before."""
    from pipeline.errors import PipelineError
    from stages.formats.importers import detect

    if own.format != "auto" or len(sources) != 1:
        return own.format in ("auto", "photographs")
    with contextlib.suppress(PipelineError, OSError):  # the stage says so
        return detect(sources[0], own.allow_outside, own.llff_factor) == "photographs"
    return True


def _training(own: Any, run: Path, memory: int | None) -> int:
    from stages.io.scene import load, views_of
    from stages.train.data import count_pixels
    from stages.train.hash_resolution import with_auto_sizes
    from stages.train.memory import parameters

    folder = PosesOutputs.of_run(run)
    pixels = 4 * DECODED * _bytes_below([folder.images])
    if folder.scene.is_file():
        scene = load(folder.folder)
        views = views_of(scene, "train")
        own, pixels = with_auto_sizes(own, scene, count_pixels(views)), 4 * count_pixels(views)
    saved = KEPT if own.time_budget != "off" else min(KEPT, 1 + (own.iterations - 1) // own.checkpoint_every)
    voxels = DENSITY_VOXEL * (given(own.occupancy_resolution) or 128) ** 3
    return (PARAMETER + saved * CHECKPOINT) * parameters(own) + (1 + saved) * voxels + (pixels if memory is not None and pixels > memory // 2 else 0)


def _baking(own: Any, run: Path) -> int:
    """The values of the voxels as they are baked, the state of their refinement, twice while it is written, and the asset."""
    from efficientnerf.asset.file.serialisation import most_voxels
    from efficientnerf.rendering.harmonics import harmonics_count
    from stages.bake.resolution import size_limits
    from stages.bake.voxels import MAX_OVERSHOOT, finest_choice
    from stages.cores import count_cores
    from stages.evaluate.views import constant_background
    from stages.io.field_file import load_renderer
    from stages.io.refined_cameras import load_scene

    trained = TrainOutputs.of_run(run)
    if not trained.field.is_file():
        return int(BAKED * (given(own.max_mib) or ASSET_MIB) * MIB)
    m, s = load_renderer(trained.folder, "cpu").model, load_scene(PosesOutputs.of_run(run).folder, trained.folder)
    whole = constant_background(s) is None
    _, mib = size_limits(own, s, "cpu", count_cores(), whole=whole, discretise=given(m.settings.discretise))
    voxels = int(MAX_OVERSHOOT * most_voxels(int(mib * MIB), own.layout, m.fine.degree, (1, 1, 1), own.brick_size))
    if not whole and s.forward is None:  # surfaces have as many as their area; density voxels that show are around them
        finest, side = finest_choice(own, m, s).resolution, len(m.voxels.values)
        voxels = min(voxels, finest**3, math.ceil(int(m.voxels.count_occupied()) * max(1.0, finest / side) ** 2))
    values = 4 * (1 + 3 * harmonics_count(m.fine.degree))
    return (values + 2 * (2 * values + VOXEL)) * voxels + min(int(mib * MIB), values * voxels)


def _pictures(run: Path) -> int:
    """Previews and figures as large as a working image."""
    images = PosesOutputs.of_run(run).images
    return PREVIEWS * max((os.stat(path).st_size for path in files_below(images)), default=0)


def _bytes_below(folders: Sequence[Path]) -> int:
    return sum(os.stat(path).st_size for folder in folders for path in files_below(folder))


def files_below(place: Path) -> list[Path]:
    """The plain files below a folder, links left out; of a file itself."""
    if place.is_file():
        return [place]
    return [path for parent, _, names in os.walk(place) for name in names if not (path := Path(parent, name)).is_symlink()]
