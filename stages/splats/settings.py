"""How the asset becomes 3D Gaussians."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from msgspec import Meta

from efficientnerf.settings import Auto, Count, Seed, setting
from pipeline.stage import ByName, Stage
from stages.artifacts import SplatsInputs, needs_of

MOST = 5_000_000  # Gaussians: beyond that no program opens them


@dataclass(frozen=True)
class SplatsSettings:
    """How the asset becomes 3D Gaussians."""

    make: Literal["auto", "on", "off"] = setting(
        "auto",
        "Whether the run makes 3D Gaussians of its asset; auto: where there is memory for it and something shows; 'enerf export RUN --splats' makes them in any"
        " case.",
        advanced=True,
    )
    region: Literal["foreground", "all"] = setting(
        "all", "What becomes Gaussians: the whole scene with its surroundings (all), or the subject with what supports it (foreground).", advanced=True
    )
    count: Annotated[int, Meta(ge=1, le=MOST)] = setting(200_000, "Most Gaussians; no more are made than a picture has pixels.", advanced=True)
    sh_degree: Annotated[int, Meta(ge=0, le=3)] = setting(2, "Degree of the spherical harmonics of their colours.", advanced=True)
    iterations: Count | Auto = setting(
        "auto",
        "Steps in which they are fitted to pictures, each of a picture or of rows of a large one; 0: none; auto: four passes over all pixels, at least 300 and"
        " at most 900.",
        advanced=True,
    )
    pictures: Literal["photographs", "asset"] = setting(
        "photographs",
        "What they are fitted to: the training photographs, or the asset's own renders, as in any case where region is foreground.",
        advanced=True,
    )
    seed: Seed = setting(0, "Seed of the order of the pictures.", advanced=True)


STAGE = Stage(name="splats", version=5, settings=SplatsSettings, needs=needs_of(SplatsInputs), run=ByName("stages.splats.run:run"))
