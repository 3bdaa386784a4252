"""How finely the field is baked."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from msgspec import Meta

from efficientnerf.settings import LEAST_RESOLUTION, Auto, Count, Fraction, NonNegative, Off, Seconds, Seed, setting
from efficientnerf.training.settings import TrainSettings
from pipeline.errors import UsageError
from pipeline.stage import ByName, Stage
from stages.artifacts import BakeOutputs


@dataclass(frozen=True)
class BakeSettings:
    """How finely the field is baked."""

    resolution: Annotated[int, Meta(ge=LEAST_RESOLUTION, le=4096)] | Auto = setting(
        "auto",
        "Voxels along the longest side of the box, or of the innermost cascade of an unbounded scene; auto: train.discretise, or as many as max_mib allows"
        " and images resolve.",
    )
    lookup: Literal["trilinear", "nearest"] = setting(
        "trilinear", "Value at a point of the asset: interpolated from the voxels around it (trilinear), or that of its own voxel (nearest).", advanced=True
    )
    step_size: Annotated[float, Meta(ge=0.25, le=1.0)] = setting(1.0, "Distance between samples along a ray through the asset, in voxels.", advanced=True)
    max_resolution: Annotated[int, Meta(ge=32, le=4096)] | Auto = setting(
        "auto",
        "Maximum number of voxels along the longest side where resolution is auto; auto: 1024, or as many as 2^24 coarse cells of all cascades allow.",
        advanced=True,
    )
    cascades: Annotated[int, Meta(ge=1, le=16)] | Auto = setting(
        "auto",
        "Number of nested grids of a scene without a constant background, each twice as wide as the one before; auto: as many as hold 99 % of what the field"
        " shows, at most 8; the environment map holds what lies beyond.",
        advanced=True,
    )
    environment_size: Annotated[int, Meta(ge=4, le=1024)] = setting(
        128, "Rows of the environment map of a scene without a constant background; it has twice as many columns.", advanced=True
    )
    ndc_voxel_depth: Annotated[float, Meta(ge=1.0, le=8.0)] | Auto = setting(
        "auto", "Ratio of a voxel's depth to its width, in normalised device coordinates; auto: 2, or 1 with train.discretise.", advanced=True
    )
    brick_size: Annotated[int, Meta(ge=1, le=16)] = setting(4, "Voxels D_f along each side of a coarse cell of the NerfTree.", advanced=True)
    visibility_rays: Annotated[int, Meta(ge=1000, le=10**9)] = setting(
        1_000_000, "Number of training pixels that are rendered from the field to find the visible voxels.", advanced=True
    )
    weight_threshold: Annotated[float, Meta(ge=0.0, le=0.1)] = setting(
        1e-3,
        "Voxels are kept if their weight in some pixel exceeds this; in forward-facing scenes it must exceed 30 times this for voxels that 4 or more"
        " training images (half of fewer than 7) have in view.",
        advanced=True,
    )
    max_mib: Annotated[float, Meta(ge=0.03, le=65536.0)] | Auto = setting(  # header and palette of 9 harmonics: 28 kB
        "auto",
        "Maximum size of the asset, which sets the resolution if that is auto; voxels of least weight are dropped to keep to it; auto: 38; in unbounded"
        " scenes 0.7 bytes per pixel of the training images, from 38 to 76; in forward-facing captures 34 bytes per pixel of the box's face, from 24 to 56;"
        " a third of that with layout packed, where more makes the codes finer, not the voxels; less where fewer voxels are as fine as pixels resolve, or"
        " where time_budget is too short for as many.",
        unit="MiB",
    )
    layout: Literal["compact", "packed", "small", "sparse"] = setting(
        "compact",
        "How voxels are stored: 8-bit codes (compact), the same entropy-coded (packed), a coarser palette of half the bytes (small), or 16-bit floats"
        " (sparse).",
    )
    dilate: Annotated[int, Meta(ge=0, le=8)] = setting(1, "Number of voxels by which the visible ones are dilated.", advanced=True)
    min_component: Fraction = setting(
        0.02,
        "Connected components that the box cuts off are dropped in unbounded scenes if they have less than this fraction of the largest one's voxels; a"
        " hundredth of this applies to all components.",
        advanced=True,
    )
    samples_per_voxel: Annotated[int, Meta(ge=1, le=256)] = setting(
        2, "Number of jittered points averaged per voxel; only its centre where train.discretise has the same voxels.", advanced=True
    )
    seed: Seed = setting(0, "Seed of the jitter and of the refinement's rays.", advanced=True)
    refine_steps: Count | Auto = setting(
        "auto",
        "Steps that refine the baked values on the training images; auto: 15 rays per voxel, in unbounded scenes one per pixel, from 6 to 15 per voxel; at"
        " least 320 steps.",
        advanced=True,
    )
    time_budget: Seconds | Off = setting(
        "off",
        "Time for the stage, in place of a number of steps: refinement steps are timed, and as many are taken as fit; off: refine_steps.",
        unit="seconds",
        advanced=True,
    )
    refine_rays_per_batch: Annotated[int, Meta(ge=1, le=1 << 22)] = setting(32768, "Rays per refinement step.", advanced=True)
    density_lr: NonNegative = setting(0.3, "Learning rate of the refinement for the logarithm of a voxel's optical thickness.", advanced=True)
    sh_lr: NonNegative = setting(0.1, "Learning rate of the refinement for the spherical harmonics.", advanced=True)
    view_dependent_lr_ratio: Fraction | Auto = setting(
        "auto", "Ratio of the learning rate of view-dependent harmonics to sh_lr; auto: 1 for objects with alpha; in unbounded scenes 0.2 for up to 80 training"
        " images, rising to 0.6 for 240.",
        advanced=True,
    )
    total_variation: NonNegative | Auto = setting(
        "auto", "Weight of the total variation of the logarithm of the optical thickness between neighbouring voxels; auto: 0.01, or 0.03 in unbounded scenes.",
        advanced=True,
    )
    error_map: Annotated[float, Meta(ge=0.0, lt=1.0)] | Auto = setting(
        "auto", "Fraction of the refinement's rays that are drawn where earlier errors were large; auto: 0.9, or 0 in forward-facing scenes.", advanced=True
    )
    lr_final_ratio: Fraction = setting(0.1, "Ratio to which the learning rates of the refinement decay exponentially.", advanced=True)
    licence: str = setting("", "Licence text that is written into the asset.")


def refuse_nerf(trained: TrainSettings) -> None:
    if trained.field == "nerf":
        raise UsageError("train.field=nerf: its colours depend on the direction inside the network, which can't be baked. Use mlp or hash, or --until train.")


def check(settings: Mapping[str, Any]) -> None:
    """UsageError where the field is to be trained before, and can't be baked then."""
    if "train" in settings:
        refuse_nerf(settings["train"])


STAGE = Stage(
    name="bake",
    version=30,
    settings=BakeSettings,
    needs=("poses", "train"),
    run=ByName("stages.bake.run:run"),
    uses_device=True,
    check=check,
    volatile=(BakeOutputs.log, BakeOutputs.curve, f"{BakeOutputs.previews}/*"),
)
