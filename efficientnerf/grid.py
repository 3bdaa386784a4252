"""World to grid: the only statement of where a point of the world lies in the density voxels and in the fields.

The box of the scene becomes [-1, 1]^3 ("unit coordinates" u). Where the photographs show surroundings, space beyond the box is contracted
into a shell (Barron et al. 2022, "Mip-NeRF 360", equation 10, with the maximum norm so that the shell of a box is a box):

    c(u) = u                             |u|_inf <= 1
    c(u) = (2 - 1 / |u|_inf) u / |u|_inf   otherwise

Grid coordinates g run over [0, 1]^3: the box alone, or box and shell.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Space:
    """The volume that a field is asked about.

    bounds      (2, 3) the box, world units
    contracted  whether space beyond the box belongs to it
    """

    bounds: np.ndarray
    contracted: bool

    @cached_property
    def centre(self) -> np.ndarray:
        return np.asarray(self.bounds, np.float64).mean(axis=0)

    @cached_property
    def half(self) -> np.ndarray:
        """(3,) half extents, world units."""
        return np.asarray(self.bounds[1] - self.bounds[0], np.float64) / 2

    @cached_property
    def reach(self) -> float:
        """Largest contracted coordinate."""
        return 2.0 if self.contracted else 1.0

    def unit(self, points: Tensor) -> Tensor:
        """World points (..., 3) to unit coordinates."""
        centre = torch.as_tensor(self.centre, dtype=points.dtype, device=points.device)
        half = torch.as_tensor(self.half, dtype=points.dtype, device=points.device)
        return (points - centre) / half

    def grid(self, points: Tensor) -> Tensor:
        """World points (..., 3) to grid coordinates, in [0, 1] wherever the space reaches."""
        u = self.unit(points)
        if self.contracted:
            u = contract(u)
        return (u + self.reach) / (2 * self.reach)

    def world(self, grid: Tensor) -> Tensor:
        """Grid coordinates (..., 3) to world points: the inverse of `grid`."""
        c = grid * (2 * self.reach) - self.reach
        if self.contracted:
            c = uncontract(c)
        half = torch.as_tensor(self.half, dtype=grid.dtype, device=grid.device)
        return c * half + torch.as_tensor(self.centre, dtype=grid.dtype, device=grid.device)


def contract(u: Tensor) -> Tensor:
    """All of space into [-2, 2]^3; the identity inside [-1, 1]^3."""
    m = u.abs().amax(dim=-1, keepdim=True)
    far = m.clamp(min=1)
    return u * (2 - 1 / far) / far


def uncontract(c: Tensor) -> Tensor:
    """The inverse of `contract`, for points short of the outer face."""
    m = c.abs().amax(dim=-1, keepdim=True)
    near = m.clamp(min=1)
    return c / (near * (2 - near).clamp(min=1e-6))
