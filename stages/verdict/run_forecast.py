"""A rough forecast of the stages after poses on a CPU: seconds, from those of known scenes, and bytes at the peak.

Processor seconds of a stage are assumed proportional to its steps, pictures or pixels, and to the time of SIFT here; a share of them is on one core.
docs/experiments/sfm.md
"""

from collections.abc import Mapping
from typing import Any

from efficientnerf.settings import resolved
from stages.bake.refine.refinement import usual_steps
from stages.bake.resolution import MAX_MIB, mib_for_voxels, scene_mib
from stages.memory.need import libraries

SLOWER = 1.5  # by `preflight.REFERENCE`, of the machine that the processor seconds below were taken on
SERIAL_SHARE = 0.28  # of a stage's processor seconds, on one core

A_TRAIN_STEP = 0.062  # of 65,536 samples
A_REFINE_STEP, RAYS_A_STEP = 0.33, 32768
A_MESH, A_MESH_VIEW = 55.0, 0.45
SPLATS = 32.0
EVALUATION, AN_EVALUATED_MEGAPIXEL, TEST_SHARE = 40.0, 1.5, 0.125
A_TURNTABLE, A_TURNTABLE_MEGAPIXEL = 10.0, 0.8
POINTS = 3.0

BYTES_A_VOXEL, PACKED_BYTES_A_VOXEL = 12.2, 3.0  # of a file; docs/experiments/sfm.md
BAKED_BYTES_A_VOXEL = 560  # at the peak of baking


def seconds_of(settings: Mapping[str, Any], *, views: int, megapixels: float, whole: bool, threads: int, slower: float) -> dict[str, float]:
    """Stage -> seconds; empty where they are not known: only hash grids were measured.

    settings    of each stage by its name, dataclasses
    views       photographs that cameras are found of
    megapixels  of all working images
    whole       whether the scene has surroundings
    slower      than the machine of `preflight.REFERENCE`
    """
    train, bake, turntable = settings["train"], settings["bake"], settings["turntable"]
    if train.field != "hash" or train.sample_batch_size == "off":
        return {}
    steps = resolved(bake.refine_steps)
    if steps is None:
        pixels = _training_pixels(megapixels) if whole else None
        steps = usual_steps(_voxels(bake, pixels), bake.refine_rays_per_batch, pixels)
    frames = turntable.frames * turntable.width * turntable.height * turntable.supersample**2 / 1e6
    processor = {
        "train": train.iterations * A_TRAIN_STEP * train.sample_batch_size / 65536,
        "bake": steps * A_REFINE_STEP * bake.refine_rays_per_batch / RAYS_A_STEP,
        "mesh": A_MESH + A_MESH_VIEW * views,
        "splats": 0.0 if settings["splats"].make == "off" else SPLATS,
        "evaluate": EVALUATION + AN_EVALUATED_MEGAPIXEL * TEST_SHARE * megapixels,
        "turntable": A_TURNTABLE + A_TURNTABLE_MEGAPIXEL * frames,
        "points": POINTS,
    }
    scale = (SERIAL_SHARE + (1 - SERIAL_SHARE) / threads) * slower / SLOWER
    found = {stage: scale * seconds for stage, seconds in processor.items()}
    for stage in ("train", "bake", "splats"):
        budget = resolved(settings[stage].time_budget)
        found[stage] = budget if budget is not None and found[stage] else found[stage]
    return {stage: round(seconds, 1) for stage, seconds in found.items()}


def bytes_of(settings: Mapping[str, Any], *, megapixels: float, whole: bool) -> int:
    """At the peak of the stages after poses, where the asset is as large as it may be: baking, as a rule. Arguments as of `seconds_of`."""
    return int(libraries() + BAKED_BYTES_A_VOXEL * _voxels(settings["bake"], _training_pixels(megapixels) if whole else None))


def _training_pixels(megapixels: float) -> int:
    return int((1 - TEST_SHARE) * 1e6 * megapixels)


def _voxels(bake: Any, pixels: int | None) -> int:
    """That the asset may hold; a packed one has a third of the bytes by default (`stages.bake.resolution.usual_mib`).

    pixels  of all training images of an unbounded scene; None: of another scene
    """
    packed, stated = bake.layout == "packed", resolved(bake.max_mib)
    usual = (MAX_MIB if pixels is None else scene_mib(pixels)) / (3 if packed else 1)
    mib = mib_for_voxels(usual if stated is None else stated, usual, packed=packed, fixed=resolved(bake.resolution) is not None)
    return int(mib * 2**20 / (PACKED_BYTES_A_VOXEL if packed else BYTES_A_VOXEL))
