"""Fields: from a point of space to density and colour. One contract, one module a field.

hash  multiresolution hash grid        mlp  the paper's networks        nerf  the original NeRF's, for comparison

`train.field` names the module, whose coarse_and_fine(settings, generator) makes both fields of a model, untrained.
"""

from abc import ABC, abstractmethod

from torch import Tensor, nn

from efficientnerf.backends import dispatch
from efficientnerf.fields.gradient_buffer import GradientBuffer


class Field(nn.Module, ABC):
    """N points in grid coordinates, R rays, K spherical harmonics.

    activation  "exp" or "softplus": from a raw density to a density >= 0 (`efficientnerf.rendering.compositing.activate`)
    degree      of the spherical harmonics; 0 where the colour depends on the direction by the field itself, which then cannot be baked
    """

    activation: str
    degree: int = 0

    @property
    def gradient_buffers(self) -> dict[str, GradientBuffer]:
        """Of tables whose gradient is summed outside of autograd, by the parameter's name."""
        return {}

    @abstractmethod
    def density(self, points: Tensor) -> Tensor:
        """Raw density (N,) at points (N, 3)."""

    @abstractmethod
    def along_rays(self, points: Tensor, directions: Tensor, first: Tensor) -> Tensor:
        """(N, 1 + 3K), raw density and coefficients, at points (N, 3) of rays along unit directions (R, 3); ray r owns points first[r] to first[r + 1]."""

    def harmonics(self, directions: Tensor) -> Tensor:
        """(R, K) factors of the coefficients along unit directions (R, 3)."""
        return directions.new_ones(len(directions), 1)


class BakeableField(Field):
    """A field whose values depend on the position alone: its `forward` takes points (N, 3) to (N, 1 + 3K)."""

    def density(self, points: Tensor) -> Tensor:
        raw: Tensor = self(points)[:, 0]
        return raw

    def along_rays(self, points: Tensor, directions: Tensor, first: Tensor) -> Tensor:
        out: Tensor = self(points)
        return out

    def harmonics(self, directions: Tensor) -> Tensor:
        return dispatch.basis(directions, self.degree)
