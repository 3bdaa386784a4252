"""How `--budget` is shared by the stages that train: the field first, then the asset."""

from __future__ import annotations

# Of the budget, for the stage train; the rest is bake's. docs/experiments/tree-training.md
TRAIN_SHARE = 0.3
PHOTOGRAPHS_TRAIN_SHARE = 0.6  # of formats whose scenes have surroundings
WITHOUT_SURROUNDINGS = ("blender", "llff")  # formats of objects before a constant background, and of forward-facing captures
MIN_TRAIN, MIN_BAKE = 15.0, 20.0  # seconds, of a budget that is large enough for both


def share_budget(seconds: float, source_format: str | None = None) -> dict[str, float]:
    """Stage -> its time_budget; they sum to `seconds`. source_format: that of the source, or None where it is not known."""
    share = TRAIN_SHARE if source_format in WITHOUT_SURROUNDINGS else PHOTOGRAPHS_TRAIN_SHARE
    if seconds <= MIN_TRAIN + MIN_BAKE:
        train = seconds * MIN_TRAIN / (MIN_TRAIN + MIN_BAKE)
    else:
        train = min(max(share * seconds, MIN_TRAIN), seconds - MIN_BAKE)
    return {"train": train, "bake": seconds - train}
