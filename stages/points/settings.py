"""How points are spread over the surface."""

from dataclasses import dataclass
from typing import Annotated, Literal

from msgspec import Meta

from efficientnerf.settings import Auto, Density, Fraction, Seed, setting
from pipeline.stage import ByName, Stage
from stages.artifacts import PointsInputs, needs_of


@dataclass(frozen=True)
class PointsSettings:
    """How points are spread over the surface."""

    region: Literal["foreground", "all"] = setting(
        "foreground", "What gets points: the subject and what it stands on, clipped at the edge (foreground), or the whole scene (all).", advanced=True
    )
    num_points: Annotated[int, Meta(ge=1, le=10**8)] = setting(200_000, "Number of points.")
    density_threshold: Density | Auto = setting(
        "auto",
        "Density at the surface, per unit of the training frame; auto: where views agree on its depth, else where it has their silhouettes.",
        advanced=True,
    )
    min_component: Fraction = setting(
        0.0, "Connected components with less than this fraction of the largest one's area get no points; components that no view shows never do.", advanced=True
    )
    smoothing_iterations: Annotated[int, Meta(ge=0, le=200)] = setting(10, "Iterations of Taubin smoothing of the surface.", advanced=True)
    seed: Seed = setting(0, "Seed of the points' positions on the surface.", advanced=True)


STAGE = Stage(name="points", version=6, settings=PointsSettings, needs=needs_of(PointsInputs), run=ByName("stages.points.run:run"))
