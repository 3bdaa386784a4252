"""Fields: position in; density (before its activation) and harmonics out. One contract, one file per field.

    field(points)          (N, 3) grid coordinates -> (N, 1 + 3K)
    field.density(points)  (N, 3) -> (N,) the density alone, before its activation
    field.basis(dirs)      (R, 3) unit directions -> (R, K): what a colour's K coefficients are weighted with
    field.activation       "exp" or "softplus"
    field.degree           of the harmonics
    field.directional      whether it is asked field(points, directions) instead, K = 1: such a field cannot be baked
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    from torch import Tensor


class Field(Protocol):
    activation: str
    degree: int
    directional: bool

    def __call__(self, points: Tensor, *directions: Tensor) -> Tensor: ...

    def density(self, points: Tensor) -> Tensor: ...

    def basis(self, directions: Tensor) -> Tensor: ...

    def parameters(self) -> Any: ...
