"""How `--budget` is shared by the stages that train: the field first, then the asset."""

from __future__ import annotations

# docs/experiments/tree-training.md
TRAIN_SHARE = 0.3  # of the budget, for the stage train; the rest is bake's
MIN_TRAIN, MIN_BAKE = 15.0, 20.0  # seconds, of a budget that is large enough for both


def share_budget(seconds: float) -> dict[str, float]:
    """Stage -> its time_budget; they sum to `seconds`."""
    if seconds <= MIN_TRAIN + MIN_BAKE:
        train = seconds * MIN_TRAIN / (MIN_TRAIN + MIN_BAKE)
    else:
        train = min(max(TRAIN_SHARE * seconds, MIN_TRAIN), seconds - MIN_BAKE)
    return {"train": train, "bake": seconds - train}
