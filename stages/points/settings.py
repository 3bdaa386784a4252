"""How points are spread over the surface."""

from __future__ import annotations

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
        "foreground", "What gets points: the subject with what supports it, its edge clipped (foreground), or the whole scene (all).", advanced=True
    )
    num_points: Annotated[int, Meta(ge=1, le=10**8)] = setting(200_000, "Number of points.")
    density_threshold: Density | Auto = setting(
        "auto",
        "Density at which the surface lies, per unit of the training frame; auto: where views agree on its depth, else where it has their silhouettes.",
        advanced=True,
    )
    min_component: Fraction = setting(
        0.0, "Area below which connected components get no points, as a fraction of the largest one's; nor do those that no view shows.", advanced=True
    )
    smoothing_iterations: Annotated[int, Meta(ge=0, le=200)] = setting(10, "Iterations of Taubin smoothing of the surface.", advanced=True)
    seed: Seed = setting(0, "Seed of the places of the points on the surface.", advanced=True)


STAGE = Stage(name="points", version=5, settings=PointsSettings, needs=needs_of(PointsInputs), run=ByName("stages.points.run:run"))
