"""Fields of settings dataclasses: their types with limits, and their descriptions.

`auto` leaves a value to be chosen, `off` switches something off. A limit is a `msgspec.Meta` in the annotation, which the engine checks when it decodes
settings (`pipeline.stage.settings_from`). Every number has a lowest and a highest value, and a stage can work with both. Imports nothing heavy.
"""

import dataclasses
from typing import Annotated, Any, Literal, TypeVar

from msgspec import Meta

T = TypeVar("T")

LEAST_RESOLUTION = 8  # voxels along the longest side of what is baked: two coarse cells of the default brick; of fewer there is no surface to put points on

Auto = Literal["auto"]
Off = Literal["off"]
Count = Annotated[int, Meta(ge=0, le=10**9)]
Seed = Annotated[int, Meta(ge=0, le=2**63 - 1)]
PositiveInt = Annotated[int, Meta(ge=1, le=10**9)]
NonNegative = Annotated[float, Meta(ge=0.0, le=1e6)]
Seconds = Annotated[float, Meta(ge=0.001, le=1e7)]
Density = Annotated[float, Meta(ge=1e-6, le=1e6)]
Fraction = Annotated[float, Meta(ge=0.0, le=1.0)]


def setting(default: Any, doc: str, *, unit: str | None = None, advanced: bool = False) -> Any:
    """A field of a settings dataclass.

    default   an immutable value
    doc       one sentence: what the setting does
    unit      of the number, as printed in the documentation
    advanced  listed apart from the settings that most users want
    """
    return dataclasses.field(default=default, metadata={"doc": doc, "unit": unit, "advanced": advanced})


def resolved(value: T | Literal["auto", "off"]) -> T | None:
    """The value, or None where it is `auto` or `off`."""
    return None if value in ("auto", "off") else value  # type: ignore[return-value]
