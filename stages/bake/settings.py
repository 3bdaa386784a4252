"""How finely the field is baked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from msgspec import Meta

from efficientnerf.settings import LEAST_RESOLUTION, Auto, Count, Fraction, NonNegative, Off, Seconds, Seed, setting
from efficientnerf.training.settings import TrainSettings
from pipeline.errors import UsageError
from pipeline.stage import ByName, Stage
from stages.artifacts import BakeInputs, BakeOutputs, needs_of


@dataclass(frozen=True)
class BakeSettings:
    """How finely the field is baked."""

    resolution: Annotated[int, Meta(ge=LEAST_RESOLUTION, le=4096)] | Auto = setting(
        "auto", "Voxels along the longest side of the box, of a whole scene of its innermost cascade; auto: train.discretise, or as many as max_mib holds and"
        " images resolve.",
    )
    lookup: Literal["trilinear", "nearest"] = setting(
        "trilinear", "Value of a point in the asset: interpolated from the voxels around it (trilinear), or that of its own voxel (nearest).", advanced=True
    )
    step_size: Annotated[float, Meta(ge=0.25, le=1.0)] = setting(1.0, "Distance between the samples of a ray through the asset, voxels.", advanced=True)
    max_resolution: Annotated[int, Meta(ge=32, le=4096)] | Auto = setting(
        "auto", "Most voxels along the longest side where resolution is auto; auto: 1024, or as many as 2^24 coarse cells of all cascades allow.", advanced=True
    )
    cascades: Annotated[int, Meta(ge=1, le=16)] | Auto = setting(
        "auto",
        "Nested grids of a scene without a constant background, each twice as wide as the one before; auto: as many as hold 99 % of what the field shows, at"
        " most 8; what lies beyond is in the environment map.",
        advanced=True,
    )
    environment_size: Annotated[int, Meta(ge=4, le=1024)] = setting(
        128, "Rows of the environment map of a scene without a constant background; it has twice as many columns.", advanced=True
    )
    ndc_voxel_depth: Annotated[float, Meta(ge=1.0, le=8.0)] | Auto = setting(
        "auto", "Depth of a voxel over its width, in normalised device coordinates; auto: 2, or 1 with train.discretise.", advanced=True
    )
    brick_size: Annotated[int, Meta(ge=1, le=16)] = setting(4, "Voxels D_f along a side of a coarse cell of the NerfTree.", advanced=True)
    visibility_rays: Annotated[int, Meta(ge=1000, le=10**9)] = setting(
        1_000_000, "Training pixels that the field is rendered for, to find the visible voxels.", advanced=True
    )
    weight_threshold: Annotated[float, Meta(ge=0.0, le=0.1)] = setting(
        1e-3,
        "A voxel is kept where its weight in some pixel exceeds this; in forward-facing scenes those that 4 or more training images (half of fewer than 7) have"
        " in view are baked where it exceeds 30 times this.",
        advanced=True,
    )
    max_mib: Annotated[float, Meta(ge=0.03, le=65536.0)] | Auto = setting(  # header and palette of 9 harmonics: 28 kB
        "auto",
        "Largest size of the asset: resolution auto follows from it, and voxels of least weight are dropped to keep to it; auto: 38;"
        " 0.7 bytes for each pixel of the training images of a whole scene, from 38 to 76; 34 bytes for each pixel of a forward-facing capture,"
        " from 24 to 56; a third of that with layout packed, whose codes become finer with more, not its voxels; less where voxels"
        " as fine as pixels resolve are fewer, or where time_budget is too short for as many.",
        unit="MiB",
    )
    layout: Literal["compact", "packed", "small", "sparse"] = setting(
        "compact",
        "How voxels are stored: codes of 8 bits (compact), the same entropy-coded (packed), a coarser palette of half the bytes (small), or 16-bit floats"
        " (sparse).",
    )
    dilate: Annotated[int, Meta(ge=0, le=8)] = setting(1, "Voxels by which the visible ones are dilated.", advanced=True)
    min_component: Fraction = setting(
        0.02,
        "Size below which connected components that the box cuts off are dropped in unbounded scenes, as a fraction of the largest one's voxels; a hundredth"
        " of this applies to all components.",
        advanced=True,
    )
    samples_per_voxel: Annotated[int, Meta(ge=1, le=256)] = setting(
        2, "Jittered points averaged in a voxel; its centre alone where train.discretise has the same voxels.", advanced=True
    )
    seed: Seed = setting(0, "Seed of the jitter and of the rays of the refinement.", advanced=True)
    refine_steps: Count | Auto = setting(
        "auto",
        "Steps in which the baked values are refined on the training images; auto: 15 rays for each voxel, in unbounded scenes one for each pixel,"
        " from 6 to 15 for each voxel; at least 320 steps.",
        advanced=True,
    )
    time_budget: Seconds | Off = setting(
        "off", "Time of the stage, in place of a number of steps: steps of the refinement are timed, and as many are taken as fit; off: refine_steps.",
        unit="seconds",
        advanced=True,
    )
    refine_rays_per_batch: Annotated[int, Meta(ge=1, le=1 << 22)] = setting(32768, "Rays in a step of the refinement.", advanced=True)
    density_lr: NonNegative = setting(0.3, "Learning rate of the refinement for the logarithm of a voxel's optical thickness.", advanced=True)
    sh_lr: NonNegative = setting(0.1, "Learning rate of the refinement for the spherical harmonics.", advanced=True)
    view_dependent_lr_ratio: Fraction | Auto = setting(
        "auto", "Ratio of the learning rate of view-dependent harmonics to sh_lr; auto: 1 for objects with alpha, 0.2 in unbounded scenes.", advanced=True
    )
    total_variation: NonNegative = setting(
        0.01, "Weight of the total variation of the logarithm of the optical thickness between a voxel and those beside it.", advanced=True
    )
    error_map: Annotated[float, Meta(ge=0.0, lt=1.0)] | Auto = setting(
        "auto",
        "Share of the refinement's rays that are drawn where earlier errors were large; auto: 0.9, 0 in forward-facing scenes.",
        advanced=True,
    )
    lr_final_ratio: Fraction = setting(0.1, "Ratio to which the learning rates of the refinement fall exponentially.", advanced=True)
    licence: str = setting("", "Licence text to write into the asset.")


def refuse_nerf(trained: TrainSettings) -> None:
    if trained.field == "nerf":
        raise UsageError("train.field=nerf: its colours depend on the direction inside the network, which can't be baked. Use mlp or hash, or --until train.")


def check(settings: Mapping[str, Any]) -> None:
    """UsageError where the field is to be trained before, and can't be baked then."""
    if "train" in settings:
        refuse_nerf(settings["train"])


STAGE = Stage(
    name="bake",
    version=22,
    settings=BakeSettings,
    needs=needs_of(BakeInputs),
    run=ByName("stages.bake.run:run"),
    uses_device=True,
    check=check,
    volatile=(BakeOutputs.log, BakeOutputs.curve, f"{BakeOutputs.previews}/*"),
)
