"""Fields: from a point of space to density and colour. One contract, one module a field.

hash  multiresolution hash grid        mlp  the paper's networks        nerf  the original NeRF's, for comparison

`train.field` names the module, whose coarse_and_fine(settings, generator) makes both fields of a model, untrained.
"""

from collections.abc import Iterator
from typing import Any, Protocol

import torch
from torch import Tensor, nn

from efficientnerf.fields.gradient_buffer import GradientBuffer


class Field(Protocol):
    """The interface of a field. N points in grid coordinates, R rays, K spherical harmonics.

    activation         "exp" or "softplus": from a raw density to a density >= 0 (`efficientnerf.rendering.compositing.activate`)
    degree             of the spherical harmonics
    gradient_buffers   of tables whose gradient is summed outside of autograd, by the parameter's name
    field(points)      (N, 3) to (N, 1 + 3K): raw density and coefficients. Fields whose colour depends on the direction otherwise have none, and
                       cannot be baked
    """

    activation: str
    degree: int

    @property
    def gradient_buffers(self) -> dict[str, GradientBuffer]: ...

    def __call__(self, *args: Any) -> Tensor: ...

    def density(self, points: Tensor) -> Tensor:
        """Raw density (N,) at points (N, 3)."""

    def along_rays(self, points: Tensor, directions: Tensor, first: Tensor) -> Tensor:
        """(N, 1 + 3K) at points (N, 3) of rays along unit directions (R, 3); ray r owns points first[r] to first[r + 1]."""

    def harmonics(self, directions: Tensor) -> Tensor:
        """(R, K) factors of the coefficients along unit directions (R, 3)."""

    def named_parameters(self) -> Iterator[tuple[str, nn.Parameter]]: ...

    def to(self, device: str | torch.device) -> Any: ...
