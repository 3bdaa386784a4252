"""Settings of training; imports nothing heavy, so that they can be listed at once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from msgspec import Meta

from efficientnerf.settings import LEAST_RESOLUTION, Auto, Count, Fraction, NonNegative, Off, PositiveInt, Seconds, Seed, setting

# What `auto` means for train.log2_hashmap_size and train.finest_resolution in bounded scenes.
LOG2_TABLE = 17
FINEST = 1024


@dataclass(frozen=True)
class TrainSettings:
    """How a field is trained. The defaults are for two CPU cores (`preview`)."""

    iterations: PositiveInt = setting(4000, "Optimisation steps.")
    time_budget: Seconds | Off = setting(
        "off", "Time of the stage, in place of a number of steps: steps are timed, and as many are taken as fit; off: train.iterations steps.", unit="seconds"
    )
    sample_batch_size: Annotated[int, Meta(ge=1, le=1 << 26)] | Off = setting(
        65536, "Target number of samples in a step, from which the number of rays follows; off: always max_rays_per_batch rays.", advanced=True
    )
    max_rays_per_batch: Annotated[int, Meta(ge=1, le=1 << 22)] = setting(8192, "Most rays in a step.", advanced=True)
    seed: Seed = setting(0, "Seed of every random choice in training.")
    field: Literal["hash", "mlp", "nerf"] = setting(
        "hash", "Kind of field: a multiresolution hash grid (hash), the paper's networks (mlp), or those of the original NeRF, which cannot be baked (nerf)."
    )
    precision: Literal["auto", "float32", "bfloat16"] = setting(
        "auto", "Number type of matrix products in training; auto: bfloat16 where the device has it.", advanced=True
    )
    sampling: Literal["efficient", "valid", "hierarchical", "uniform"] = setting(
        "efficient",
        "Sampling strategy: valid then pivotal samples (efficient), valid samples then by importance (valid), all samples then by importance as in NeRF"
        " (hierarchical), or evenly and once (uniform).",
        advanced=True,
    )
    discretise: Annotated[int, Meta(ge=LEAST_RESOLUTION, le=4096)] | Off = setting(
        "off",
        "Voxels along the longest side of the box at whose centres the field is evaluated, so that baking with bake.lookup=nearest is exact; off: anywhere.",
        advanced=True,
    )
    sh_degree: Annotated[int, Meta(ge=0, le=4)] = setting(2, "Degree of the spherical harmonics.", advanced=True)
    num_levels: Annotated[int, Meta(ge=1, le=24)] = setting(16, "Levels of the hash grid.", advanced=True)
    log2_hashmap_size: Annotated[int, Meta(ge=8, le=24)] | Auto = setting(
        "auto", "Entries of the hash table of a level, as a power of two; auto: from 17 to 19, by the number of training pixels.", advanced=True
    )
    finest_resolution: Annotated[int, Meta(ge=16, le=16384)] | Auto = setting(
        "auto", "Grid points along a side of the finest level of the hash grid; auto: 1024, or one for a pixel in normalised device coordinates, up to 4096.",
        advanced=True,
    )  # fmt: skip
    hidden_dim: Annotated[int, Meta(ge=8, le=1024)] = setting(128, "Width of the fine network (the paper: 256).", advanced=True)
    num_layers: Annotated[int, Meta(ge=1, le=16)] = setting(1, "Hidden layers of the fine network (the paper: 8).", advanced=True)
    coarse_hidden_dim: Annotated[int, Meta(ge=8, le=1024)] = setting(32, "Width of the coarse network (the paper: 128).", advanced=True)
    coarse_num_layers: Annotated[int, Meta(ge=1, le=16)] = setting(1, "Hidden layers of the coarse network (the paper: 4).", advanced=True)
    num_coarse_samples: Annotated[int, Meta(ge=8, le=1024)] | Auto = setting(
        "auto", "Coarse samples N_c along the diagonal of the box, or between near and far; auto: 128, or 96 in normalised device coordinates.", advanced=True
    )
    samples_per_pivot: Annotated[int, Meta(ge=1, le=16)] = setting(4, "Fine samples N_s in a pivotal interval.", advanced=True)
    early_samples_per_pivot: Annotated[int, Meta(ge=1, le=16)] | Off = setting(
        2, "Fine samples N_s in a pivotal interval during the first half of the steps, at most samples_per_pivot; off: that many throughout.", advanced=True
    )
    num_importance_samples: Annotated[int, Meta(ge=1, le=4096)] = setting(
        128, "Fine samples N_f of a ray by importance, with sampling valid and hierarchical; uniform adds them to N_c.", advanced=True
    )
    near_plane: NonNegative | Auto = setting(
        "auto", "Where rays begin along the view axis, in the capture's units (the paper: 2 for synthetic scenes); auto: the scene's.", advanced=True
    )
    far_plane: Annotated[float, Meta(ge=1e-9, le=1e6)] | Auto = setting(
        "auto", "Where rays end along the view axis, in the capture's units (the paper: 6); N_c samples lie between near and far then; auto: the scene's.",
        advanced=True,
    )  # fmt: skip
    pivotal_threshold: Annotated[float, Meta(ge=0.0, le=0.01)] = setting(
        1e-4, "Weight epsilon above which a coarse sample is pivotal.", advanced=True
    )
    max_pivots: Annotated[int, Meta(ge=1, le=4096)] = setting(
        8, "Most pivotal samples on a ray; those of least weight are dropped (the paper drops none).", advanced=True
    )
    exploration_fraction: Fraction = setting(
        0.1, "Fraction of the valid samples that are not pivotal on which the fine network is trained all the same.", advanced=True
    )
    distortion_loss_weight: NonNegative | Auto = setting(
        "auto",
        "Weight of the distortion loss of mip-NeRF 360 in unbounded scenes; auto: 0.01, or 0.002 in normalised device coordinates.",
        advanced=True,
    )
    sparse_depth_loss_weight: NonNegative = setting(
        0.1, "Weight of the loss that puts the surface at the sparse points (DS-NeRF); it falls to zero by half of the steps.", advanced=True
    )
    exposure: Literal["auto", "off", "on"] = setting(
        "auto",
        "Whether exposure and white balance of each photograph, and vignetting and response of each camera, are learned in unbounded scenes; auto: where"
        " sparse points show that photographs differ.",
    )
    camera_refinement: Literal["auto", "off", "on"] = setting(
        "auto", "Whether poses and the focal length of the training cameras are corrected in training (on), or left alone (off); auto: off.", advanced=True,
    )
    wrong_views: Literal["auto", "off"] = setting(
        "auto", "Whether training views whose cameras the field and other evidence contradict are left out, or get the pose that is found for them;"
        " auto: they are; off: all views are trained on.",
        advanced=True,
    )  # fmt: skip
    initial_density: Annotated[float, Meta(ge=1e-6, le=1e3)] = setting(
        0.1, "Density that the hash field begins with, per unit of the training frame.", advanced=True
    )
    occupancy_resolution: Annotated[int, Meta(ge=1, le=512)] | Auto = setting(
        "auto", "Density voxels D along a side of the occupancy grid; auto: 128, or 192 in contracted scenes.", advanced=True
    )
    min_views: Annotated[int, Meta(ge=1, le=64)] | Off = setting(
        2,
        "Training views that a point of the box, or before it, must lie in for density to be learned there, in unbounded scenes; a quarter of the views is"
        " always enough; off: density is learned everywhere.",
        advanced=True,
    )
    occupancy_rule: Literal["momentum", "maximum"] = setting(
        "maximum", "How the density voxels are updated: with momentum, as in the paper's equation 7, or by a decayed maximum, as in instant-ngp.", advanced=True
    )
    occupancy_beta: Fraction = setting(0.1, "Momentum beta of the paper's equation 7.", advanced=True)
    occupancy_initial_density: NonNegative = setting(10.0, "Density that the voxels begin with.", advanced=True)
    occupancy_decay: Fraction = setting(0.95, "Factor by which the density voxels fall at an update, with occupancy_rule maximum.", advanced=True)
    occupancy_alpha_threshold: Fraction | Auto = setting(
        "auto",
        "Opacity of a coarse interval from which its voxel is valid, with occupancy_rule maximum; auto: 0.01, or 0.05 in normalised device coordinates.",
        advanced=True,
    )
    occupancy_update_interval: PositiveInt = setting(16, "Steps between updates of randomly chosen density voxels.", advanced=True)
    occupancy_update_fraction: Fraction = setting(
        0.03125, "Fraction of the density voxels that an update evaluates; an eighth during the warm-up, unless this is 0.", advanced=True
    )
    occupancy_update_ray_fraction: Fraction = setting(
        0.0, "Fraction of the rays of a step on which pruned samples are evaluated too (the authors' release: 0.01).", advanced=True
    )
    occupancy_warmup_steps: Count = setting(256, "First steps, in which no density voxel is pruned.", advanced=True)
    learning_rate: Fraction = setting(2e-2, "Learning rate of Adam after the first steps (the paper: 5e-4).", advanced=True)
    lr_final_ratio: Fraction = setting(0.05, "Ratio to which the learning rate falls exponentially over lr_decay_steps.", advanced=True)
    lr_decay_steps: PositiveInt | Auto = setting(
        "auto", "Steps in which the learning rate falls to lr_final_ratio of itself (the paper: 500,000); auto: all steps.", advanced=True
    )
    adam_beta2: Annotated[float, Meta(ge=0.0, le=0.99999)] = setting(0.99, "Decay beta_2 of Adam's second moment (the paper: 0.999).", advanced=True)
    adam_epsilon: NonNegative = setting(1e-15, "Epsilon of Adam (the paper: 1e-8).", advanced=True)
    precrop_steps: Count = setting(0, "First steps, in which rays go through the middle half of each image's sides alone (NeRF: 500).", advanced=True)
    background_color: Literal["random", "scene"] = setting(
        "random", "Background of images with alpha in training: a random colour for each ray, or the scene's own.", advanced=True
    )
    on_failure: Literal["retry", "continue", "stop"] = setting(
        "retry",
        "What follows where a tenth of the steps have taught nothing by the held-out views: short trainings without near planes, masks or min_views, or with"
        " exposure or camera_refinement, the best of which training begins again with (retry); a warning alone (continue); or an error (stop).",
        advanced=True,
    )
    checkpoint_every: PositiveInt = setting(250, "Steps between checkpoints.", advanced=True)
    preview_every: PositiveInt | Off = setting(500, "Steps between preview renders of a validation view; off: none.", advanced=True)
