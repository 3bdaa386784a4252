"""How the field is trained (`efficientnerf.training.settings`), and what is refused before."""

from collections.abc import Mapping
from typing import Any

from efficientnerf.settings import resolved
from efficientnerf.training.settings import TrainSettings
from pipeline.errors import UsageError
from pipeline.stage import ByName, Stage
from stages.artifacts import TrainOutputs

UNBOUNDED = "train.near_plane and train.far_plane are for bounded scenes, and poses.space=contracted makes this one unbounded. Leave them auto."


def stated_planes(settings: TrainSettings) -> tuple[float, float] | None:
    """train.near_plane and train.far_plane, in the capture's units; None where neither is stated. UsageError where one is stated without the other, for N_c
    samples lie between both; or where they are not in order."""
    near, far = resolved(settings.near_plane), resolved(settings.far_plane)
    if near is None and far is None:
        return None
    if near is None or far is None or near >= far:
        found = f"train.near_plane={settings.near_plane}, train.far_plane={settings.far_plane}"
        raise UsageError(f"{found}: expected two numbers, the second one greater, or auto for both.")
    return near, far


def check(settings: Mapping[str, Any]) -> None:
    """UsageError where near and far planes are stated that cannot be used."""
    planes, poses = stated_planes(settings["train"]), settings.get("poses")
    if planes is not None and poses is not None and poses.space == "contracted":
        raise UsageError(UNBOUNDED)


STAGE = Stage(
    name="train",
    version=24,
    settings=TrainSettings,
    needs=("poses",),
    run=ByName("stages.train.run:run"),
    uses_device=True,
    check=check,
    volatile=(TrainOutputs.log, TrainOutputs.curve, f"{TrainOutputs.previews}/*", TrainOutputs.report),
)
