"""How the asset becomes 3D Gaussians."""

from dataclasses import dataclass
from typing import Annotated, Literal

from msgspec import Meta

from efficientnerf.settings import Auto, Count, Off, Seconds, Seed, setting
from pipeline.stage import ByName, Stage

MAX_COUNT = 5_000_000  # Gaussians: beyond that no program opens them


@dataclass(frozen=True)
class SplatsSettings:
    """How the asset becomes 3D Gaussians."""

    make: Literal["auto", "on", "off"] = setting(
        "auto",
        "Whether the run makes 3D Gaussians from its asset; auto: if there is enough memory and the asset shows something; 'enerf export RUN --splats'"
        " always makes them.",
        advanced=True,
    )
    region: Literal["foreground", "all"] = setting(
        "all", "What becomes Gaussians: the whole scene with its surroundings (all), or the subject and what it stands on (foreground).", advanced=True
    )
    count: Annotated[int, Meta(ge=1, le=MAX_COUNT)] = setting(280_000, "Maximum number of Gaussians; no more are made than an image has pixels.", advanced=True)
    sh_degree: Annotated[int, Meta(ge=0, le=3)] = setting(2, "Degree of the spherical harmonics of their colours.", advanced=True)
    iterations: Count | Auto = setting(
        "auto",
        "Number of training steps, each on an image or on rows of a large one; 0: none; auto: sixteen passes over all pixels and 30"
        " steps an image at least, 1080 to 3600; with time_budget up to three times as many, at most 8000, if they fit.",
        advanced=True,
    )
    time_budget: Seconds | Off = setting(
        "off",
        "Time for the stage, but for a few seconds of writing: fewer steps than iterations are taken where these take longer; off: all are taken.",
        unit="seconds",
        advanced=True,
    )
    pictures: Literal["photographs", "asset"] = setting(
        "photographs",
        "Images that they are trained on: the training photographs (photographs), or renders of the asset (asset), which are always used if region is"
        " foreground.",
        advanced=True,
    )
    seed: Seed = setting(0, "Seed of the order of the images.", advanced=True)


STAGE = Stage(
    name="splats", version=19, settings=SplatsSettings, needs=("bake", "train", "poses"), run=ByName("stages.splats.run:run"), uses_device=True,
)  # fmt: skip
