"""How points are sampled on the mesh."""

from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from efficientnerf.settings import Seed, setting
from pipeline.stage import ByName, Stage


@dataclass(frozen=True)
class PointsSettings:
    """How points are sampled on the mesh."""

    num_points: Annotated[int, Meta(ge=1, le=10**8)] = setting(200_000, "Number of points.")
    seed: Seed = setting(0, "Seed of the points' positions on the mesh.", advanced=True)


STAGE = Stage(name="points", version=6, settings=PointsSettings, needs=("mesh", "bake"), run=ByName("stages.points.run:run"))
