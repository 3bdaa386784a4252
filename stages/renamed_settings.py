"""Settings of earlier releases: their present names and values.

An old name on the command line or in a file is answered with `moved`; recorded settings are read with `updated`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgspec

from pipeline.stage import hints_of

RENAMED: dict[str, dict[str, str]] = {
    "poses": {
        "max_side": "max_image_size", "box": "crop_box", "margin": "box_margin", "features": "max_features", "feature_side": "feature_image_size",
        "alpha": "masks",
    },
    "train": {
        "budget": "time_budget", "samples": "sample_batch_size", "rays": "max_rays_per_batch", "degree": "sh_degree", "levels": "num_levels",
        "log2_table": "log2_hashmap_size", "finest": "finest_resolution", "hidden": "hidden_dim", "layers": "num_layers",
        "coarse_hidden": "coarse_hidden_dim", "coarse_layers": "coarse_num_layers", "coarse_samples": "num_coarse_samples",
        "fine_samples": "samples_per_pivot", "first_fine_samples": "early_samples_per_pivot", "importance_samples": "num_importance_samples",
        "near": "near_plane", "far": "far_plane", "pivotal_weight": "pivotal_threshold", "explored": "exploration_fraction",
        "distortion": "distortion_loss_weight", "anchors": "sparse_depth_loss_weight", "observers": "min_views", "voxels": "occupancy_resolution",
        "voxel_rule": "occupancy_rule", "voxel_beta": "occupancy_beta", "voxel_initial": "occupancy_initial_density", "voxel_decay": "occupancy_decay",
        "voxel_absorption": "occupancy_alpha_threshold", "refresh_every": "occupancy_update_interval", "refresh_share": "occupancy_update_fraction",
        "refresh_rays": "occupancy_update_ray_fraction", "warm_up": "occupancy_warmup_steps", "final_rate": "lr_final_ratio",
        "rate_steps": "lr_decay_steps", "crop_steps": "precrop_steps", "backdrop": "background_color",
    },
    "bake": {
        "ndc_depth": "ndc_voxel_depth", "brick": "brick_size", "pixels": "visibility_rays", "weight": "weight_threshold", "points": "samples_per_voxel",
        "optimise": "refine_steps", "optimise_rays": "refine_rays_per_batch", "density_rate": "density_lr", "colour_rate": "sh_lr",
        "view_share": "view_dependent_lr_ratio", "final_rate": "lr_final_ratio",
    },
    "evaluate": {"views": "field_views", "scale": "field_image_scale", "background_pixels": "field_background_rays"},
    "mesh": {"faces": "max_faces", "threshold": "density_threshold", "smooth": "smoothing_iterations"},
    "points": {"count": "num_points", "threshold": "density_threshold", "smooth": "smoothing_iterations"},
}  # fmt: skip

REMOVED: dict[str, dict[str, str]] = {
    "train": {
        "coarse": "pivots are always chosen by the coarse field",
        "rate_hold": "the field file and train/report.json record the schedule",
        "rate_aims": "the field file and train/report.json record the schedule",
    },
}

# Values that have another name under the present name of their setting.
VALUES: dict[str, dict[str, dict[str, str]]] = {"poses": {"alpha": {"composite": "silhouette", "mask": "ignore"}}, "train": {"exposure": {"gain": "on"}}}

# Words that replace 0, none and empty texts.
WORDS = ("auto", "off", "all")


def moved(stage: str, name: str) -> str | None:
    """The present name of an old setting, as a sentence; None where the name is none of the old ones."""
    if new := RENAMED.get(stage, {}).get(name):
        values = VALUES.get(stage, {}).get(name, {})
        return f"{stage}.{name} is now {stage}.{new}{''.join(f', {before} is now {after}' for before, after in values.items())}."
    if why := REMOVED.get(stage, {}).get(name):
        return f"{stage}.{name} was removed: {why}. Leave it out."
    return None


def moved_in(table: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """`moved` for every setting of {stage: {setting: value}} that was renamed or removed."""
    return [sentence for stage, entries in table.items() for name in entries if (sentence := moved(stage, name)) is not None]


def updated(stage: str, settings_type: type, recorded: Mapping[str, Any]) -> dict[str, Any]:
    """Recorded settings of a stage under their present names.

    Values that meant "choose" or "off" become `auto`, `off` or `all` where the setting admits the word and not the value; settings that were removed
    are left out; everything else stays as it is.
    """
    hints = hints_of(settings_type)
    out: dict[str, Any] = {}
    for old, value in recorded.items():
        name = old if old in hints else RENAMED.get(stage, {}).get(old, old)
        if name not in hints and name in REMOVED.get(stage, {}):
            continue
        value = VALUES.get(stage, {}).get(old, {}).get(value, value) if isinstance(value, str) else value
        out[name] = _word(hints[name], value) if name in hints else value
    return out


def _word(hint: Any, value: Any) -> Any:
    """The word for a 0, none or empty text that the type does not admit."""
    if value not in (0, None, "", "none") or _admits(hint, value):
        return value
    return next((word for word in WORDS if _admits(hint, word)), value)


def _admits(hint: Any, value: Any) -> bool:
    try:
        msgspec.convert(value, hint, strict=True)
    except msgspec.ValidationError:
        return False
    return True
