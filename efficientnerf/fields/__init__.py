"""Fields: position in; density (before its activation) and harmonics out. One contract, one file per field.

    field(points)          (N, 3) grid coordinates -> (N, 1 + 3K)
    field.density(points)  (N, 3) -> (N,) the density alone, before its activation
    field.activation       "exp" or "softplus"
    field.degree           of the harmonics

The original NeRF's field alone is asked with directions beside the points, has K = 1 and cannot be baked.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from torch import Tensor


class Field(Protocol):
    activation: str
    degree: int

    def __call__(self, points: Tensor) -> Tensor: ...

    def density(self, points: Tensor) -> Tensor: ...

    def parameters(self) -> object: ...
