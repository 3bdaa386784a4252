"""IBRNet (Wang et al., CVPR 2021): density and colour of a sample from the source views that see it, by one network for all scenes.

    f_k          features and colour of the sample in source view k, by a U-Net, and how the view's direction differs from the ray's
    m, v         mean and variance of the f_k (equations 1 and 2), each weighted by how well the direction agrees
    x_k, w_k     from f_k, m and v: what view k says, and how visible the sample is in it (section 3.2.1)
    sigma        from weighted mean and variance of the x_k, after attention over the samples of the ray (equation 3)
    colour       sum_k softmax_k(c_k) colour_k: blended from the source views (equation 4)

Adapted to valid and pivotal sampling (EfficientNeRF, section 3), and to two cores:

- Valid samples alone go through the light aggregation of the coarse field, which has fewer views and no attention: its density is that of a sample by itself,
  so that it also holds for a voxel. Pivotal ones alone go through the fine field.
- The attention of a ray is over its own samples and masked elsewhere. Samples are no longer evenly spaced, so that their place is encoded by the distance
  along the ray in place of their number.
- Density depends on the source views, hence on the ray. Density voxels take the momentum over many rays: `SourceViewField.density`.
- The coarse field does not train the features, and finetuning on a scene keeps them: they are computed once.
"""

import itertools
import math
from typing import ClassVar

import torch
from torch import Tensor, nn

from benchmarks.paper.encoders import FeatureNetwork
from benchmarks.paper.source_views import Lookup, SourceViewField, SourceViews, as_logit, bilinear, look_up
from efficientnerf.rendering.compositing import ray_of_sample

FEATURES = 8
DENSITY = 16  # width of the density's feature
HEADS = 4
FINE_VIEWS, COARSE_VIEWS = 4, 3
INITIAL = -1.0  # raw density of an untrained field


def layers(*widths: int) -> nn.Sequential:
    """Linear layers with ELU between them."""
    parts: list[nn.Module] = []
    for fan_in, fan_out in itertools.pairwise(widths):
        parts += [nn.Linear(fan_in, fan_out), nn.ELU()]
    return nn.Sequential(*parts[:-1])


def moments(values: Tensor, weight: Tensor) -> Tensor:
    """(N, 2C) mean and variance over K of values (N, K, C) under weights (N, K) that sum to one."""
    mean = (values * weight[..., None]).sum(1)
    return torch.cat([mean, ((values - mean[:, None]) ** 2 * weight[..., None]).sum(1)], -1)


def normalised(weight: Tensor) -> Tensor:
    """(N, K) with rows that sum to one, or to zero."""
    return weight / weight.sum(1, keepdim=True).clamp(min=1e-8)


class RayAttention(nn.Module):
    """Attention of each sample to all samples of its ray (Vaswani et al. 2017), added to the sample's feature (N, C)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.queries_keys_values = nn.Linear(channels, 3 * channels)
        self.out = nn.Linear(channels, channels)

    def forward(self, feature: Tensor, first: Tensor) -> Tensor:
        count, channels = feature.shape
        samples = first[1:] - first[:-1]
        ray = ray_of_sample(first, count)
        row, slot = ((samples > 0).cumsum(0) - 1)[ray], torch.arange(count, device=feature.device) - first[ray]  # rays without samples have no row
        rows, longest = int(row[-1]) + 1, int(samples.max())
        padded = feature.new_zeros(rows, longest, 3 * channels).index_put((row, slot), self.queries_keys_values(feature))
        q, k, v = padded.reshape(rows, longest, 3, HEADS, channels // HEADS).permute(2, 0, 3, 1, 4)  # (rows, heads, longest, C / heads) each
        sampled = torch.arange(longest, device=feature.device) < samples[samples > 0][:, None]
        found = nn.functional.scaled_dot_product_attention(q, k, v, attn_mask=sampled[:, None, None])
        out: Tensor = self.out(found.transpose(1, 2).reshape(rows, longest, channels)[row, slot])
        return feature + out


class IbrNetField(SourceViewField):
    """Aggregation of `count` views; `maps` (V, h, w, FEATURES) of the source views are set with them. With `attention`, densities see the whole ray."""

    maps: Tensor

    def __init__(self, count: int, hidden: int, *, attention: bool) -> None:
        super().__init__()
        self.count = count
        inputs = FEATURES + 3
        self.angle = layers(4, 8, inputs)
        self.sharpness = nn.Parameter(torch.tensor(3.0))
        self.view = layers(3 * inputs, hidden + 8, hidden)
        self.visible = layers(hidden, hidden, hidden + 1)
        self.global_feature = layers(2 * hidden + 1, hidden, DENSITY)
        self.attention = RayAttention(DENSITY) if attention else None
        self.raw_density = layers(DENSITY, DENSITY, 1)
        self.blend = layers(hidden + 5, 8, 1)
        nn.init.constant_(self.raw_density[-1].bias, INITIAL)  # type: ignore[arg-type]

    def along_rays(self, points: Tensor, directions: Tensor, first: Tensor) -> Tensor:
        if not len(points):
            return points.new_zeros(0, 4)
        at = look_up(self.views, points, directions, first, self.count)
        colour = bilinear(self.views.colour, at.view, at.pixel)
        seen = at.seen.to(points.dtype)
        x, visible = self.per_view(at, colour, seen)
        weight = normalised(visible)
        density = self.global_feature(torch.cat([moments(x, weight), visible.mean(1, keepdim=True)], -1))
        if self.attention is not None:
            density = self.attention(density + self.place(at), first)
        raw = self.raw_density(density) - 10 * (seen.sum(1, keepdim=True) == 0)  # what no source view sees is empty
        logit = self.blend(torch.cat([x, visible[..., None], at.angles], -1))[..., 0].masked_fill(~at.seen, -1e4)
        return torch.cat([raw, as_logit((torch.softmax(logit, 1)[..., None] * colour).sum(1))], -1)

    def per_view(self, at: Lookup, colour: Tensor, seen: Tensor) -> tuple[Tensor, Tensor]:
        """What each view says (N, K, hidden), and how visible the sample is in it (N, K)."""
        f = torch.cat([bilinear(self.maps, at.view, at.pixel / 2), colour], -1) + self.angle(at.angles)
        agreeing = normalised(torch.exp(self.sharpness * (at.angles[..., 3] - 1)) * seen)
        x = self.view(torch.cat([f, moments(f, agreeing)[:, None].expand(-1, f.shape[1], -1)], -1))
        both = self.visible(x * agreeing[..., None] * f.shape[1])
        return x + both[..., :-1], torch.sigmoid(both[..., -1]) * seen

    def place(self, at: Lookup) -> Tensor:
        """(N, DENSITY) sines and cosines of how far along its ray a sample lies, from where the ray is nearest to the middle of the scene."""
        along = ((at.points - self.views.low - self.views.extent / 2) * at.directions).sum(-1, keepdim=True)
        waves = math.pi / 2 * along * 2 ** torch.arange(DENSITY // 2, device=along.device)
        return torch.cat([torch.sin(waves), torch.cos(waves)], -1)


class IbrNet(nn.Module):
    """The network for all scenes: features, and both fields."""

    most_elsewhere: ClassVar[int] = 0  # in training over scenes: it looks at the views nearest to a ray alone

    def __init__(self) -> None:
        super().__init__()
        self.features = FeatureNetwork(FEATURES)
        self.coarse = IbrNetField(COARSE_VIEWS, 8, attention=False)
        self.fine = IbrNetField(FINE_VIEWS, 16, attention=True)

    def observe(self, views: SourceViews, references: Tensor) -> None:
        """Let both fields look up these source views; `references` (T,) are for MVSNeRF."""
        maps = self.features(views.colour)
        self.fine.views, self.fine.maps = views, maps
        self.coarse.views, self.coarse.maps = views, maps.detach()

    def settle(self) -> None:
        """After `observe`, before finetuning: the features are kept."""
        self.fine.maps = self.fine.maps.detach()
