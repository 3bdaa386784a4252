"""The base of fields whose values depend on the position alone, so that they can be baked."""

from torch import Tensor, nn

from efficientnerf.backends import dispatch
from efficientnerf.fields.gradient_buffer import GradientBuffer


class BakeableField(nn.Module):
    """A field (`efficientnerf.fields.field`) whose `forward` takes points (N, 3) alone."""

    degree: int

    @property
    def gradient_buffers(self) -> dict[str, GradientBuffer]:
        return {}

    def along_rays(self, points: Tensor, directions: Tensor, first: Tensor) -> Tensor:
        out: Tensor = self(points)
        return out

    def harmonics(self, directions: Tensor) -> Tensor:
        return dispatch.basis(directions, self.degree)
