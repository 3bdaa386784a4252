"""The orbit of a capture's cameras, as scenes and assets keep it, and up."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from msgspec import Meta

UNIT = 1e-3  # how far from 1 the length of a unit vector may be
LARGEST = 1e15  # of any number: beyond it squares lose all that they are compared with

Number = Annotated[float, Meta(ge=-LARGEST, le=LARGEST)]
Vector = tuple[Number, Number, Number]


@dataclass(frozen=True)
class Orbit:
    """The orbit of the capture's cameras round the subject, for turntables; in the training frame."""

    centre: Vector  # point that the cameras look at
    radius: Number  # median distance of the cameras from it, world units
    elevation: Number  # median angle above the horizon, degrees
    forward_facing: bool  # whether the cameras are on one side of the subject
    heading: Number  # azimuth of the mean camera seen from the centre, degrees, anticlockwise from +x


def rotation_to_z(up: np.ndarray) -> np.ndarray:
    """(3, 3) the smallest rotation that turns the unit vector `up` to +z; exact for the axes."""
    if abs(up[2] - 1) < 1e-12:
        return np.eye(3)
    if abs(up[2] + 1) < 1e-12:
        return np.diag([1.0, -1.0, -1.0])
    x, y, z = up
    k = 1.0 / (1.0 + z)
    return np.array([[1 - x * x * k, -x * y * k, -x], [-x * y * k, 1 - y * y * k, -y], [x, y, z]])


def stated_up(given: object) -> np.ndarray | None:
    """The `up` in an asset's metadata; None for what is no unit vector: other writers may mean something else by it."""
    if not (isinstance(given, (list, tuple)) and len(given) == 3 and all(isinstance(each, (int, float)) for each in given)):
        return None
    up = np.clip(np.asarray(given, np.float64), -2, 2)
    length = np.linalg.norm(up)
    return up / length if abs(length - 1) < UNIT else None
