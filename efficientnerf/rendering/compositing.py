"""From densities and colours of samples to the colours of rays: volume rendering (Max 1995), in plain torch.

Samples of all rays lie end to end, those of one ray together and in order of distance ("packed"); `first` says where each ray begins.
R rays, N samples, K harmonics.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from efficientnerf.backends import transfer

LARGEST_LOGIT = 15.0


def activate(raw: Tensor, activation: str) -> Tensor:
    """Density, >= 0, from a field's output before its activation ("exp" or "softplus").

    exp is capped at e^15, far beyond opaque. softplus is shifted by one so that an untrained field is thin: with it, and a density that never
    dies, thin scenes do not collapse to the background as they do with ReLU.
    """
    if activation == "exp":
        return torch.exp(raw.clamp(max=LARGEST_LOGIT))
    if activation == "softplus":
        return torch.nn.functional.softplus(raw - 1)
    raise ValueError(f"activation {activation!r}: expected 'exp' or 'softplus'")


def ray_of_sample(first: Tensor, samples: int) -> Tensor:
    """(N,) which ray each packed sample belongs to; first (R + 1,) offsets. Padding, beyond the last offset, counts for the last ray."""
    if transfer.is_on_device(first) or int(first[-1]) != samples:
        at = torch.arange(samples, device=first.device)
        return (torch.searchsorted(first, at, right=True) - 1).clamp(max=len(first) - 2)
    counts = first[1:] - first[:-1]
    return torch.repeat_interleave(torch.arange(len(counts), device=first.device), counts, output_size=samples)


def scaled_by_distance(values: Tensor, start: Tensor, first: Tensor, subject: Tensor) -> Tensor:
    """Values (N, C) of samples times the square of their distance `start` (N,), measured in their ray's `subject` (R,), at most 1."""
    return values * ((start / subject[ray_of_sample(first, len(start))]).clamp(max=1) ** 2)[:, None]


def sample_weights(depth: Tensor, first: Tensor) -> Tensor:
    """How much each sample contributes to its ray's colour.

        w_i = T_i (1 - exp(-d_i)),  T_i = exp(-sum_{j<i} d_j)

    depth   (N,)    optical depth of each sample: density times length, >= 0
    first   (R + 1,) offsets of the rays
    returns (N,)    the weights of one ray sum to at most 1

    EfficientNeRF, equations 2 and 3.
    """
    ray = ray_of_sample(first, len(depth))
    # Summed in float64: the running sum goes on over all rays, and a ray's own part is a small difference of large numbers.
    total = torch.cumsum(depth.double(), dim=0)
    before = torch.cat([total.new_zeros(1), total])[first[:-1]]
    passed = total - depth.double() - before[ray]
    return (torch.exp(-passed) * -torch.expm1(-depth.double())).to(depth.dtype)


class Composite(NamedTuple):
    """colour (R, 3) over the background, opacity (R,), distortion (R,), weight (N,), sample_colour (N, 3)."""

    colour: Tensor
    opacity: Tensor
    distortion: Tensor
    weight: Tensor
    sample_colour: Tensor


def ray_distortion(weight: Tensor, length: Tensor, first: Tensor) -> Tensor:
    """How far a ray's weights are spread along it: large for semi-transparent volumes, small for one thin surface.

        sum_i sum_j w_i w_j |s_i - s_j| + 1/3 sum_i w_i^2 l_i

    weight, length (N,), first (R + 1,); s is the running sum of the lengths, up to the middle of each sample; returns (R,), the lengths' unit

    Barron et al. 2022, "Mip-NeRF 360", equation 15.
    """
    ray = ray_of_sample(first, len(weight))
    weight, length = weight.double(), length.double()

    def before(values: Tensor) -> Tensor:
        total = torch.cumsum(values, dim=0) - values
        return total - total[first[:-1].clamp(max=len(total) - 1)][ray] if len(total) else total

    s = before(length) + length / 2
    pairs = 2 * weight * (s * before(weight) - before(weight * s))
    return weight.new_zeros(len(first) - 1).index_add(0, ray, pairs + weight * weight * length / 3)


def composite(raw: Tensor, length: Tensor, first: Tensor, harmonics: Tensor, background: Tensor, activation: str) -> Composite:
    """Colours of rays from a field's output at their samples.

    raw         (N, 1 + 3K) density before its activation, then K coefficients for red, green and blue each
    length      (N,) extent of each sample
    first       (R + 1,) int64 offsets
    harmonics   (R, K) basis at the rays' directions
    background  (R, 3) what lies behind each ray
    """
    ray = ray_of_sample(first, len(raw))
    k = harmonics.shape[1]
    weight = sample_weights(activate(raw[:, 0], activation) * length, first)
    sh = raw[:, 1:].reshape(len(raw), 3, k)
    rgb = torch.sigmoid((sh * harmonics[ray][:, None]).sum(dim=-1))  # (N, 3)
    rays = len(first) - 1
    opacity = raw.new_zeros(rays).index_add(0, ray, weight)
    colour = raw.new_zeros(rays, 3).index_add(0, ray, weight[:, None] * rgb)
    distortion = ray_distortion(weight, length, first).to(raw.dtype)
    return Composite(colour + (1 - opacity)[:, None] * background, opacity, distortion, weight, rgb)
