"""What can be set about training; imports nothing heavy, so that it can be listed in no time."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any


def _setting(default: Any, doc: str, **limits: Any) -> Any:
    return field(default=default, metadata={"doc": doc, **limits})


# Where train.log2_hashmap_size and train.finest_resolution are 0.
LOG2_TABLE = 17
FINEST = 1024


@dataclass(frozen=True)
class TrainSettings:
    """How a scene is learned. The defaults are for two CPU cores (`preview`)."""

    iterations: int = _setting(4000, "optimisation steps", minimum=1)
    time_budget: float = _setting(
        0.0, "seconds to train for, in place of a number of steps: steps are timed, the number that fits is settled on the way and reported; 0: iterations",
        minimum=0.0,
    )  # fmt: skip
    sample_batch_size: int = _setting(65536, "network evaluations aimed at in a step; the number of rays follows from it; 0: always `rays`", minimum=0)
    max_rays_per_batch: int = _setting(8192, "rays in a step at most", minimum=1)
    seed: int = _setting(0, "seed of every random choice", minimum=0)
    field: str = _setting(
        "hash", "hash: multiresolution hash grid; mlp: the paper's networks; nerf: those of the original NeRF, which can't be baked",
        choices=("hash", "mlp", "nerf"),
    )  # fmt: skip
    precision: str = _setting(
        "auto", "what matrix products of training are computed in; auto: bfloat16 where the device has it", choices=("auto", "float32", "bfloat16")
    )
    sampling: str = _setting(
        "efficient",
        "efficient: valid, then pivotal samples; valid: valid, then by importance; hierarchical: NeRF's, all, then by importance; uniform: evenly, once",
        choices=("efficient", "valid", "hierarchical", "uniform"),
    )
    discretise: int = _setting(
        0,
        "voxels along the longest side of the box whose centres stand for all points in them, so that baking with bake.lookup=nearest loses nothing; "
        "looks up a single voxel a sample, but at 160 voxels a short run on chair came out 1.9 dB below interpolation; 0: off",
        minimum=0, maximum=4096,
    )  # fmt: skip
    sh_degree: int = _setting(2, "degree of the spherical harmonics", minimum=0, maximum=4)
    num_levels: int = _setting(16, "hash: levels", minimum=1, maximum=24)
    log2_hashmap_size: int = _setting(
        0, "hash: entries of a level's table, as a power of two; 0: from 17 to 19, by the number of training pixels",
        minimum=8, maximum=24, besides=(0,),
    )  # fmt: skip
    finest_resolution: int = _setting(
        0, "hash: lattice points a side of the finest level; 0: 1024, and more in normalised device coordinates, one for a pixel, up to 4096",
        minimum=16, maximum=16384, besides=(0,),
    )  # fmt: skip
    hidden_dim: int = _setting(
        128, "width of the fine network (the paper: 256, with field mlp); one wide layer learned more in a step than two of 64, at the same cost",
        minimum=8, maximum=1024,
    )  # fmt: skip
    num_layers: int = _setting(1, "hidden layers of the fine network (the paper: 8)", minimum=1, maximum=16)
    coarse_hidden_dim: int = _setting(32, "width of the coarse network (the paper: 128)", minimum=8, maximum=1024)
    coarse_num_layers: int = _setting(1, "hidden layers of the coarse network (the paper: 4)", minimum=1, maximum=16)
    num_coarse_samples: int = _setting(
        0, "N_c: intervals over the diagonal of the box, or between near and far; 0: 128, and 96 in normalised device coordinates",
        minimum=8, maximum=1024, besides=(0,),
    )  # fmt: skip
    samples_per_pivot: int = _setting(4, "N_s: fine samples in a pivotal interval", minimum=1, maximum=16)
    early_samples_per_pivot: int = _setting(
        2, "N_s in the first half of the steps, when more rays are worth more than more samples on each; 0: fine_samples", minimum=0, maximum=16
    )
    num_importance_samples: int = _setting(
        128, "N_f: fine samples of a ray by importance, beside the coarse ones (sampling valid, hierarchical; uniform adds them to N_c)",
        minimum=1, maximum=4096,
    )  # fmt: skip
    near_plane: float = _setting(
        0.0, "where rays begin, in the capture's units along the view axis (the paper: 2 for synthetic scenes); with far = 0 the scene says", minimum=0.0
    )
    far_plane: float = _setting(
        0.0, "where rays end (the paper: 6); N_c intervals lie between near and far then, and those outside of the box are never valid", minimum=0.0
    )
    pivotal_threshold: float = _setting(1e-4, "epsilon: weight above which a coarse sample is pivotal", minimum=0.0, maximum=1.0)
    max_pivots: int = _setting(
        8, "pivotal samples on a ray at most; the lightest are dropped, which while all is fog are those behind (the paper drops none)", minimum=1, maximum=4096
    )
    coarse: str = _setting(
        "field", "hash: what pivots are chosen by; field: a lighter field that gives densities alone; voxels: the density voxels, and no coarse field",
        choices=("field", "voxels"),
    )  # fmt: skip
    exploration_fraction: float = _setting(
        0.1, "share of the valid intervals without a pivot that the fine network is trained on all the same", minimum=0.0, maximum=1.0
    )
    distortion_loss_weight: float | None = _setting(
        None, "weight of the loss on spread-out densities, where surroundings are learned: it clears fog; none: 0.01, in normalised device coordinates 0.002",
        minimum=0.0,
    )  # fmt: skip
    sparse_depth_loss_weight: float = _setting(
        0.1, "weight of the loss that puts matter at the sparse points, and none before them; gone by half of the steps", minimum=0.0
    )
    exposure: str = _setting(
        "off", "gain: a factor for each colour and photograph is learned beside the field and left out of it, where surroundings are learned; off: none",
        choices=("off", "gain"),
    )  # fmt: skip
    initial_density: float = _setting(0.1, "hash: density that the fields start with, per world unit", minimum=1e-6, maximum=1e3)
    occupancy_resolution: int = _setting(0, "D: side of the density voxels; 0 chooses 128, or 192 where surroundings are learned too", minimum=0, maximum=512)
    min_views: int = _setting(
        2, "training photographs that must have a place in the box in view for matter to be learned there, where surroundings are learned: what fewer show"
        " could be at any distance, and is left to the surroundings; at most a quarter of the photographs, so that up to four ask for nothing; 0: anywhere",
        minimum=0, maximum=64,
    )  # fmt: skip
    occupancy_rule: str = _setting(
        "maximum", "momentum: equation 7 on raw densities, threshold 0, as in the paper; maximum: decayed maximum of densities", choices=("momentum", "maximum")
    )
    occupancy_beta: float = _setting(0.1, "beta of equation 7", minimum=0.0, maximum=1.0)
    occupancy_initial_density: float = _setting(10.0, "density that the voxels start with", minimum=0.0)
    occupancy_decay: float = _setting(0.95, "maximum: what a voxel keeps at each refresh", minimum=0.0, maximum=1.0)
    occupancy_alpha_threshold: float | None = _setting(
        None, "maximum: share of light that an interval of a valid voxel absorbs at least; none: 0.01, and 0.05 in normalised device coordinates",
        minimum=0.0, maximum=1.0,
    )  # fmt: skip
    occupancy_update_interval: int = _setting(16, "steps between looks at random voxels, which let pruned space return", minimum=1)
    occupancy_update_fraction: float = _setting(
        0.03125, "share of the voxels looked at in a refresh; in the warm-up an eighth, unless 0", minimum=0.0, maximum=1.0
    )
    occupancy_update_ray_fraction: float = _setting(
        0.0, "share of the rays of a step whose pruned samples are looked at too, which lets pruned space return (the authors' release: 0.01)",
        minimum=0.0, maximum=1.0,
    )  # fmt: skip
    occupancy_warmup_steps: int = _setting(256, "steps in which no voxel is pruned", minimum=0)
    learning_rate: float = _setting(2e-2, "Adam's rate after the first steps (the paper: 5e-4, with field mlp)", minimum=0.0)
    lr_final_ratio: float = _setting(0.05, "what is left of the rate after rate_steps; it falls exponentially", minimum=0.0, maximum=1.0)
    lr_decay_steps: int = _setting(0, "steps in which the rate falls to final_rate of itself (the paper: 0.1 every 500,000); 0: all of them", minimum=0)
    rate_hold: int = _setting(0, "first steps in which the rate does not fall; 0: none, or with a budget those that are timed", minimum=0)
    rate_aims: tuple[int, ...] = _setting(
        (), "pairs n, s: up to step s the schedule was one of n steps; a budget writes them, so that its steps can be repeated", minimum=1
    )
    adam_beta2: float = _setting(0.99, "Adam's second decay (0.999 by default elsewhere, so for the paper)", minimum=0.0, maximum=0.99999)
    adam_epsilon: float = _setting(1e-15, "Adam's epsilon: this small because a table entry's gradient can be (1e-8 by default elsewhere)", minimum=0.0)
    precrop_steps: int = _setting(
        0, "first steps that see only the middle half of each picture's sides, so that thin scenes on white don't collapse to white (NeRF: 500)", minimum=0
    )
    background_color: str = _setting(
        "random", "behind cut-out objects in training; random: a colour for each ray, so that none is learned; scene: its own (NeRF; the paper doesn't say)",
        choices=("random", "scene"),
    )  # fmt: skip
    checkpoint_every: int = _setting(250, "steps between checkpoints", minimum=1)
    preview_every: int = _setting(500, "steps between preview pictures of a held-back view; 0: none", minimum=0)
