"""MVSNeRF (Chen et al., ICCV 2021): a neural encoding volume from the cost volume of three views, and an MLP from it to density and colour.

    cost        variance over three views of their features where a voxel projects (equation 1), and their mean colour
    volume      S = B(cost), B a three-dimensional U-Net (equation 2)
    sigma, r    = A(f, c, d): f of S at the sample, c its colours in the three source views nearest to the ray, d their directions (equations 3 and 4)

Adapted to scenes that are seen from all round, to valid and pivotal sampling (EfficientNeRF, section 3), and to two cores:

- The planes are swept through the scene's box rather than through the frustum of one view, so that the volume has grid coordinates like all fields and
  density voxels. On a whole scene it is a mean of the volumes of several reference views, each with the two views nearest to it. Each counts in a voxel by
  a confidence that the network gives with the encoding: what is hidden from three views would else drown what three others see.
- The colour is a blend of the three views' plus a correction by the MLP, before the sigmoid, in place of the MLP's alone: it needs less training.
- Valid samples alone go through the coarse field, a light MLP; pivotal ones alone through the fine one. The coarse field does not train the volume.
- Density depends on the views' colours, hence on the ray. Density voxels take the momentum over many rays: `SourceViewField.density`.
- Finetuning on a scene trains the volume and both MLPs, as in the paper's section 3.4.
"""

from typing import ClassVar

import torch
from torch import Tensor, nn

from benchmarks.paper.encoders import FeatureNetwork, VolumeNetwork
from benchmarks.paper.ibrnet import INITIAL, layers
from benchmarks.paper.source_views import SourceViewField, SourceViews, as_logit, bilinear, look_up, projected, trilinear

FEATURES = 8  # of a photograph
ENCODING = 8  # of a voxel
SIDE = 24
VIEWS = 3


def cost_volume(views: SourceViews, maps: Tensor, side: int) -> Tensor:
    """(D, D, D, C + 7): variance of features (V, h, w, C) at half size and of colours over the views that see a voxel, mean colour, share of them that do."""
    middles = (torch.arange(side, device=maps.device) + 0.5) / side
    points = views.world(torch.stack(torch.meshgrid(middles, middles, middles, indexing="ij"), -1).reshape(-1, 3))
    matrix = views.pixels_from_world
    pixel, seen = projected(views, torch.einsum("vij,nj->nvi", matrix[..., :3], points) + matrix[..., 3])
    values = torch.cat([_bilinear_of_all(maps, pixel / 2), _bilinear_of_all(views.colour, pixel)], -1)  # (N, V, C + 3)
    weight = seen.to(values.dtype)[..., None]
    mean = (values * weight).sum(1) / weight.sum(1).clamp(min=1)
    variance = ((values - mean[:, None]) ** 2 * weight).sum(1) / weight.sum(1).clamp(min=1)
    return torch.cat([variance, mean[:, -3:], weight.mean(1)], -1).reshape(side, side, side, -1)


def _bilinear_of_all(maps: Tensor, place: Tensor) -> Tensor:
    """`bilinear` at places (N, V, 2) of each of the maps (V, h, w, C): its backward pass is faster here."""
    size = torch.tensor([maps.shape[2], maps.shape[1]], device=maps.device)
    grid = (place / size * 2 - 1).clamp(-4, 4).transpose(0, 1)[:, None]  # (V, 1, N, 2)
    found = nn.functional.grid_sample(maps.permute(0, 3, 1, 2), grid, padding_mode="border", align_corners=False)
    return found[:, :, 0].permute(2, 0, 1)


class MvsNerfField(SourceViewField):
    """The MLP A: `count` hidden layers of `hidden` units. `volume` (D, D, D, ENCODING) is set with the source views."""

    volume: Tensor

    def __init__(self, hidden: int, count: int) -> None:
        super().__init__()
        self.network = layers(ENCODING + 8 * VIEWS, *[hidden] * count, 4 + VIEWS)
        last = self.network[-1]
        assert isinstance(last, nn.Linear)
        with torch.no_grad():
            last.bias[0] = INITIAL

    def encoding(self) -> Tensor:
        """The volume that the field reads."""
        return self.volume

    def along_rays(self, points: Tensor, directions: Tensor, first: Tensor) -> Tensor:
        if not len(points):
            return points.new_zeros(0, 4)
        at = look_up(self.views, points, directions, first, VIEWS)
        colour = bilinear(self.views.colour, at.view, at.pixel)  # (N, 3, 3)
        seen = at.seen[..., None].to(colour.dtype)
        inputs = torch.cat([colour * seen, seen, at.angles], -1).flatten(1)
        out = self.network(torch.cat([trilinear(self.encoding(), points), inputs], -1))
        weight = torch.softmax(out[:, 4:].masked_fill(~at.seen, -1e4), 1)[..., None]
        return torch.cat([out[:, :1], as_logit((weight * colour).sum(1)) + out[:, 1:4]], -1)


class CoarseMvsNerfField(MvsNerfField):
    """A light one that reads the volume of another."""

    def __init__(self, fine: MvsNerfField, hidden: int, count: int) -> None:
        super().__init__(hidden, count)
        self.of = (fine,)  # a tuple: its parameters are not this field's

    def encoding(self) -> Tensor:
        return self.of[0].volume.detach()


class MvsNerf(nn.Module):
    """The network for all scenes: features, cost volume's encoding, and both fields."""

    most_elsewhere: ClassVar[int] = 2  # reference views far from the target in training over scenes, at most

    def __init__(self) -> None:
        super().__init__()
        self.features = FeatureNetwork(FEATURES)
        self.encoder = VolumeNetwork(FEATURES + 7, ENCODING + 1)
        self.fine = MvsNerfField(64, 4)
        self.coarse = CoarseMvsNerfField(self.fine, 32, 2)

    def observe(self, views: SourceViews, references: Tensor) -> None:
        """Let both fields look up these source views, and the weighted mean of the volumes of some of them (T,), each with the two nearest to it."""
        volumes = []
        for reference in references:
            near = views.chosen(views.nearest(views.centre[reference], VIEWS))
            volumes.append(self.encoder(cost_volume(near, self.features(near.colour), SIDE)))
        self.fine.views = self.coarse.views = views
        encoding, confidence = torch.stack(volumes).split([ENCODING, 1], -1)
        self.fine.volume = (torch.softmax(confidence, 0) * encoding).sum(0)

    def settle(self) -> None:
        """After `observe`, before finetuning: the volume becomes a parameter."""
        volume = self.fine.volume.detach()
        del self.fine.volume
        self.fine.volume = nn.Parameter(volume)
