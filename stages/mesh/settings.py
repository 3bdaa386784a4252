"""How the surface is meshed and textured."""

from dataclasses import dataclass
from typing import Annotated, Literal

from msgspec import Meta

from efficientnerf.settings import Auto, Density, Fraction, setting
from pipeline.stage import ByName, Stage


@dataclass(frozen=True)
class MeshSettings:
    """How the surface is meshed."""

    region: Literal["foreground", "all"] = setting(
        "foreground",
        "What is meshed: the subject and what it stands on, clipped at the edge (foreground), or the whole scene (all).",
        advanced=True,
    )
    max_faces: Annotated[int, Meta(ge=100, le=10**8)] | Literal["20k", "100k", "500k"] = setting(
        200_000, "Maximum number of faces after decimation: 20k for the web, 100k for games, 500k for prints and renders, or a number."
    )
    density_threshold: Density | Auto = setting(
        "auto", "Density at the surface, per unit of the training frame; auto: where views agree on its depth, else where it has their silhouettes."
    )
    min_component: Fraction = setting(
        0.0, "Connected components with less than this fraction of the largest one's area are dropped; components that no view shows always are.", advanced=True
    )
    smoothing_iterations: Annotated[int, Meta(ge=0, le=200)] = setting(
        10, "Iterations of Taubin smoothing, which keeps the volume; eight times as many, up to 80, follow for normals, which keep edges,"
        " and half of these after photometric refinement.",
        advanced=True
    )
    photometric_refinement: Literal["auto", "off"] = setting(
        "auto",
        "Whether the surface is moved, by a few pixels, to where the training photographs agree on it, and its contours to their edges; auto: where three"
        " photographs show it, contours where two do, unless cameras are poor or photographs agree no better afterwards.",
        advanced=True,
    )
    texture: Literal["auto", "photographs", "asset", "off"] = setting(
        "auto",
        "Source of the texture's colours: the training photographs, blended (photographs), or the asset (asset); auto: photographs where they show the mesh;"
        " off: vertex colours only.",
    )
    texture_size: Annotated[int, Meta(ge=256, le=8192)] = setting(
        4096,
        "Maximum number of texels along a side of the texture; fewer, a power of two, where a texel is smaller than a pixel of the photographs.",
        advanced=True,
    )

    @property
    def faces(self) -> int:
        """`max_faces` as a number."""
        return int(str(self.max_faces).replace("k", "000"))


STAGE = Stage(name="mesh", version=24, settings=MeshSettings, needs=("bake", "train", "poses"), run=ByName("stages.mesh.run:run"))
