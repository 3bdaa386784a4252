"""What the sparse depth loss is a mean of, in plain torch. R rays, A of them aimed at sparse points, N samples."""

import torch
from torch import Tensor

from efficientnerf.backends import transfer
from efficientnerf.rendering.compositing import ray_of_sample

LEAST_LIGHT = 0.05  # that reaches a support, below which what stands before it hides it


def sparse_depth_errors(weight: Tensor, start: Tensor, extent: Tensor, first: Tensor, distance: Tensor, on_support: Tensor, width: float) -> Tensor:
    """(A,) of the last A rays of a bundle: the weight that does not lie close to their points, or the light that passes a support, see
    `efficientnerf.training.sparse_depth.sparse_depth_loss`; differentiable in the weights.

    weight, start, extent  (N,) of packed samples
    first                  (R + 1,) offsets
    distance, on_support   (A,) of the points
    width                  extents on either side of a point that count as at it
    """
    count = len(distance)
    before = len(first) - 1 - count
    if transfer.is_on_device(first):  # whose host would wait for the number of the last rays' samples: the others get a weight of zero
        ray = ray_of_sample(first, len(start)) - before
        weight, ray = torch.where(ray >= 0, weight, 0), ray.clamp(min=0)
    else:
        begin = int(first[before])
        start, extent, weight = start[begin:], extent[begin:], weight[begin:]
        ray = ray_of_sample(first[before:] - begin, len(start))
    past = (start + extent / 2 - distance[ray]) / (width * extent).clamp(min=1e-12)
    zero = weight.new_zeros(count)
    near = zero.index_add(0, ray, weight * (1 - past.abs()).clamp(min=0))
    reaching, ending = 1 - zero.index_add(0, ray, weight * (past <= -1)), zero.index_add(0, ray, weight * (past.abs() < 1))
    passing = reaching.detach().clamp(min=0) * (1 - ending / reaching.clamp(min=LEAST_LIGHT))
    return torch.where(on_support, passing, 1 - near)
