"""Settings of training; imports nothing heavy, so that they can be listed at once."""

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

    iterations: PositiveInt = setting(4000, "Number of training steps.")
    time_budget: Seconds | Off = setting(
        "off", "Time for training, in place of a number of steps: steps are timed, and as many are taken as fit; off: train.iterations steps.", unit="seconds"
    )
    sample_batch_size: Annotated[int, Meta(ge=1, le=1 << 26)] | Off = setting(
        65536, "Target number of samples per step, which sets the number of rays; off: always max_rays_per_batch rays.", advanced=True
    )
    max_rays_per_batch: Annotated[int, Meta(ge=1, le=1 << 22)] = setting(8192, "Maximum number of rays per step.", advanced=True)
    seed: Seed = setting(0, "Seed of all random choices in training.")
    field: Literal["hash", "mlp", "nerf"] = setting(
        "hash", "Kind of field: a multiresolution hash grid (hash), the paper's networks (mlp), or those of the original NeRF, which cannot be baked (nerf)."
    )
    precision: Literal["auto", "float32", "bfloat16"] = setting(
        "auto", "Precision of matrix products in training; auto: bfloat16 where it is faster.", advanced=True
    )
    sampling: Literal["efficient", "valid", "hierarchical", "uniform"] = setting(
        "efficient",
        "Sampling strategy: valid, then pivotal samples (efficient), valid, then importance samples (valid), all, then importance samples as in NeRF"
        " (hierarchical), or uniform samples once (uniform).",
        advanced=True,
    )
    discretise: Annotated[int, Meta(ge=LEAST_RESOLUTION, le=4096)] | Off = setting(
        "off",
        "Number of voxels along the longest side of the box at whose centres the field is evaluated, so that baking with bake.lookup=nearest is exact; off:"
        " anywhere.",
        advanced=True,
    )
    sh_degree: Annotated[int, Meta(ge=0, le=4)] = setting(2, "Degree of the spherical harmonics.", advanced=True)
    num_levels: Annotated[int, Meta(ge=1, le=24)] = setting(16, "Number of levels of the hash grid.", advanced=True)
    log2_hashmap_size: Annotated[int, Meta(ge=8, le=24)] | Auto = setting(
        "auto", "Entries of the hash table per level, as a power of two; auto: from 17 to 19, by the number of training pixels.", advanced=True
    )
    finest_resolution: Annotated[int, Meta(ge=16, le=16384)] | Auto = setting(
        "auto",
        "Resolution of the finest level of the hash grid; auto: 1024, or one grid point per pixel in normalised device coordinates, up to 4096.",
        advanced=True,
    )
    hidden_dim: Annotated[int, Meta(ge=8, le=1024)] = setting(128, "Width of the fine network (the paper: 256).", advanced=True)
    num_layers: Annotated[int, Meta(ge=1, le=16)] = setting(1, "Hidden layers of the fine network (the paper: 8).", advanced=True)
    coarse_hidden_dim: Annotated[int, Meta(ge=8, le=1024)] = setting(32, "Width of the coarse network (the paper: 128).", advanced=True)
    coarse_num_layers: Annotated[int, Meta(ge=1, le=16)] = setting(1, "Hidden layers of the coarse network (the paper: 4).", advanced=True)
    num_coarse_samples: Annotated[int, Meta(ge=8, le=1024)] | Auto = setting(
        "auto",
        "Coarse samples N_c along the diagonal of the box, or between near and far plane; auto: 128, or 96 in normalised device coordinates.",
        advanced=True,
    )
    samples_per_pivot: Annotated[int, Meta(ge=1, le=16)] = setting(4, "Fine samples N_s per pivotal interval.", advanced=True)
    early_samples_per_pivot: Annotated[int, Meta(ge=1, le=16)] | Off = setting(
        2, "Fine samples N_s per pivotal interval in the first half of the steps, at most samples_per_pivot; off: samples_per_pivot throughout.", advanced=True
    )
    num_importance_samples: Annotated[int, Meta(ge=1, le=4096)] = setting(
        128, "Importance samples N_f per ray, with sampling valid and hierarchical; uniform adds them to N_c.", advanced=True
    )
    near_plane: NonNegative | Auto = setting(
        "auto", "Near plane of the rays, along the view axis in the capture's units (the paper: 2 for synthetic scenes); auto: the scene's.", advanced=True
    )
    far_plane: Annotated[float, Meta(ge=1e-9, le=1e6)] | Auto = setting(
        "auto",
        "Far plane of the rays, along the view axis in the capture's units (the paper: 6); if set, the N_c samples lie between near and far; auto: the"
        " scene's.",
        advanced=True,
    )
    pivotal_threshold: Annotated[float, Meta(ge=0.0, le=0.01)] = setting(1e-4, "Weight epsilon above which a coarse sample is pivotal.", advanced=True)
    max_pivots: Annotated[int, Meta(ge=1, le=4096)] = setting(
        8, "Maximum number of pivotal samples per ray; those of least weight are dropped (the paper drops none).", advanced=True
    )
    exploration_fraction: Fraction = setting(0.1, "Fraction of the valid samples that are not pivotal on which the fine network is trained too.", advanced=True)
    distortion_loss_weight: NonNegative | Auto = setting(
        "auto",
        "Weight of the distortion loss of mip-NeRF 360 in unbounded scenes; auto: 0.01, or 0.002 in normalised device coordinates.",
        advanced=True,
    )
    sparse_depth_loss_weight: NonNegative = setting(
        0.1,
        "Weight of the depth loss at the sparse points (DS-NeRF) and on the floor or table that they, or else photographs that agree along it, show; it"
        " falls to zero over the first half of the steps.",
        advanced=True,
    )
    plain_loss_weight: NonNegative = setting(
        0.0,
        "Weight of the loss that makes plain regions of photographs flat, and opaque between what is, in contracted scenes: 0.01 closes plain walls of rooms,"
        " and costs other captures up to half a decibel.",
        advanced=True,
    )
    highlight_loss_weight: Fraction = setting(
        1.0,
        "Weight, in the first two fifths of the steps, of colour losses where a photograph is brighter than what the field shows in or behind the box of a"
        " contracted scene, unless that is bright: 0.1 keeps highlights from making dark glossy things hollow, and costs 0.1 to 0.3 dB.",
        advanced=True,
    )
    exposure: Literal["auto", "off", "on"] = setting(
        "auto",
        "Whether unbounded scenes learn the exposure and white balance of each photograph, and the vignetting and response of each camera; auto: where"
        " sparse points show that photographs differ.",
    )
    wrong_views: Literal["auto", "off"] = setting(
        "auto",
        "Whether training views whose cameras contradict the field and other evidence are left out, or get the pose that is found for them; auto: they are;"
        " off: all views are trained on.",
        advanced=True,
    )
    initial_density: Annotated[float, Meta(ge=1e-6, le=1e3)] = setting(0.1, "Initial density of the hash field, per unit of the training frame.", advanced=True)
    occupancy_resolution: Annotated[int, Meta(ge=1, le=512)] | Auto = setting(
        "auto", "Resolution D of the occupancy grid, in voxels along a side; auto: 128, or 192 in contracted scenes.", advanced=True
    )
    min_views: Annotated[int, Meta(ge=1, le=64)] | Off = setting(
        2,
        "Number of training views that must contain a point in or before the box for density to be learned there, in unbounded scenes; a quarter of the"
        " views is always enough; off: density is learned everywhere.",
        advanced=True,
    )
    occupancy_rule: Literal["momentum", "maximum"] = setting(
        "maximum",
        "How the occupancy grid is updated: with momentum, as in the paper's equation 7 (momentum), or by a decayed maximum, as in instant-ngp (maximum).",
        advanced=True,
    )
    occupancy_beta: Fraction = setting(0.1, "Momentum beta of the paper's equation 7.", advanced=True)
    occupancy_initial_density: NonNegative = setting(10.0, "Initial density of the occupancy grid.", advanced=True)
    occupancy_decay: Fraction = setting(0.95, "Factor by which the occupancy grid decays at each update, with occupancy_rule maximum.", advanced=True)
    occupancy_alpha_threshold: Fraction | Auto = setting(
        "auto",
        "Opacity of a coarse interval above which its voxel is valid, with occupancy_rule maximum; auto: 0.01, or 0.05 in normalised device coordinates.",
        advanced=True,
    )
    occupancy_update_interval: PositiveInt = setting(16, "Steps between updates of random voxels of the occupancy grid.", advanced=True)
    occupancy_update_fraction: Fraction = setting(
        0.03125, "Fraction of the occupancy grid that each update evaluates; an eighth during the warm-up, unless this is 0.", advanced=True
    )
    occupancy_update_ray_fraction: Fraction = setting(
        0.0, "Fraction of the rays per step whose pruned samples are evaluated too (the authors' release: 0.01).", advanced=True
    )
    occupancy_warmup_steps: Count = setting(256, "Number of warm-up steps, in which no voxel is pruned.", advanced=True)
    learning_rate: Fraction = setting(2e-2, "Learning rate of Adam after the first steps (the paper: 5e-4).", advanced=True)
    lr_final_ratio: Fraction = setting(0.05, "Ratio to which the learning rate decays exponentially over lr_decay_steps.", advanced=True)
    lr_decay_steps: PositiveInt | Auto = setting(
        "auto", "Steps over which the learning rate decays to lr_final_ratio of itself (the paper: 500,000); auto: all steps.", advanced=True
    )
    adam_beta2: Annotated[float, Meta(ge=0.0, le=0.99999)] = setting(0.99, "Decay beta_2 of Adam's second moment (the paper: 0.999).", advanced=True)
    adam_epsilon: NonNegative = setting(1e-15, "Epsilon of Adam (the paper: 1e-8).", advanced=True)
    precrop_steps: Count = setting(0, "Number of first steps that train on the middle half of each image's sides only (NeRF: 500).", advanced=True)
    background_color: Literal["random", "scene"] = setting(
        "random", "Background of images with alpha in training: a random colour per ray (random), or the scene's own (scene).", advanced=True
    )
    on_failure: Literal["retry", "continue", "stop"] = setting(
        "retry",
        "What happens if held-out views show after a tenth of the steps that nothing was learned: short trials without near planes, masks or min_views, or"
        " with exposure, and a restart with the best (retry); only a warning (continue); or an error (stop).",
        advanced=True,
    )
    checkpoint_every: PositiveInt = setting(250, "Steps between checkpoints.", advanced=True)
    preview_every: PositiveInt | Off = setting(500, "Steps between preview renders of a validation view; off: none.", advanced=True)
