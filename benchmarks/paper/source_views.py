"""Source views: photographs that fields look points up in (IBRNet, MVSNeRF), and what such fields share.

N points, R rays, V source views, K views of a ray, W x H pixels of a view.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from efficientnerf.fields.field import Field
from efficientnerf.geometry.cameras import Camera
from efficientnerf.geometry.spaces import BoundedSpace
from efficientnerf.rendering.compositing import ray_of_sample

OWN = 1e-3  # world units: a source view whose centre a ray passes nearer than this is the photograph that the ray is of
DARKEST = 1e-3  # least distance of a colour from 0 and 1 before it becomes a logit


@dataclass(frozen=True)
class SourceViews:
    """colour (V, H, W, 3) in 0-1; pixels_from_world (V, 3, 4), homogeneous; centre (V, 3); low, extent (3,) world corner and size of the grid."""

    colour: Tensor
    pixels_from_world: Tensor
    centre: Tensor
    low: Tensor
    extent: Tensor

    def world(self, grid: Tensor) -> Tensor:
        """Grid coordinates (..., 3) in the world."""
        return self.low + grid * self.extent

    def chosen(self, index: Tensor) -> "SourceViews":
        """Some of the views."""
        return SourceViews(self.colour[index], self.pixels_from_world[index], self.centre[index], self.low, self.extent)

    def nearest(self, centre: Tensor, count: int) -> Tensor:
        """(count,) the views that see the middle of the grid from the directions closest to that of a camera at `centre` (3,), the closest first."""
        middle = self.low + self.extent / 2
        directions = torch.nn.functional.normalize(self.centre - middle, dim=-1)
        return (directions @ torch.nn.functional.normalize(centre - middle, dim=0)).topk(count).indices


def source_views(space: BoundedSpace, cameras: Sequence[Camera], images: np.ndarray) -> SourceViews:
    """Images (V, H, W, 3) float32 in 0-1 of cameras in a box. ValueError where a camera has lens distortion or the space is more than its box."""
    if space.reach != 1 or space.ndc is not None:
        raise ValueError("source views need a bounded scene: a space of more than its box has no corner")
    matrices = []
    for camera in cameras:
        k = camera.intrinsics
        if camera.model not in ("PINHOLE", "SIMPLE_PINHOLE"):
            raise ValueError(f"{camera.name}: a camera of model {camera.model}; source views need PINHOLE. Undistort the photographs.")
        lens = np.array([[k["fx"], 0, k["cx"]], [0, k["fy"], k["cy"]], [0, 0, 1]])
        turned = camera.world_from_camera[:3, :3].T
        matrices.append(lens @ np.column_stack([turned, -turned @ camera.centre]))
    of = [np.stack(matrices), np.stack([camera.centre for camera in cameras]), space.bounds[0], space.bounds[1] - space.bounds[0]]
    return SourceViews(torch.as_tensor(images), *(torch.as_tensor(np.asarray(values), dtype=torch.float32) for values in of))


def views_of_rays(views: SourceViews, at: Tensor, directions: Tensor, count: int) -> Tensor:
    """(R, count) the source views of rays: those that see the place where it is nearest to the scene's middle at the least angle to it, but never its own
    photograph. IBRNet chooses by the target camera, of which a step's rays have many.

    at (R, 3) any point of each ray, world; directions (R, 3)
    """
    # Distances along the ray, and to its point nearest to the middle, by products of matrices: rays times views times 3 numbers are slow where each point has
    # a ray of its own.
    middle = views.low + views.extent / 2
    at, centre = at - middle, views.centre - middle
    at = at - (at * directions).sum(-1, keepdim=True) * directions
    along = -directions @ centre.T  # (R, V)
    squared = (at**2).sum(-1, keepdim=True) - 2 * at @ centre.T + (centre**2).sum(-1)
    own = (squared - along**2 < OWN**2 * squared.clamp(min=1)) & (along > 0)
    cosine = torch.where(own, -2.0, along / squared.sqrt().clamp(min=1e-9))
    return cosine.topk(count, dim=1).indices


def projected(views: SourceViews, h: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels (N, K, 2) of homogeneous ones (N, K, 3), and whether they are in the image (N, K)."""
    pixel = h[..., :2] / h[..., 2:].clamp(min=1e-6)
    height, width = views.colour.shape[1:3]
    seen = (h[..., 2] > 1e-6) & (pixel >= 0).all(-1) & (pixel[..., 0] <= width) & (pixel[..., 1] <= height)
    return pixel, seen


def bilinear(maps: Tensor, view: Tensor, place: Tensor) -> Tensor:
    """(N, K, C) of maps (V, h, w, C) in views (N, K) at places (N, K, 2) that run over [0, w] x [0, h]; clamped to the middles of the outermost pixels."""
    height, width, channels = maps.shape[1:]
    x, y = (place[..., 0] - 0.5).clamp(0, width - 1), (place[..., 1] - 0.5).clamp(0, height - 1)
    x0, y0 = x.floor().clamp(max=max(width - 2, 0)), y.floor().clamp(max=max(height - 2, 0))
    fx, fy = x - x0, y - y0
    corner = (view * height + y0.long()) * width + x0.long()
    right, below = min(1, width - 1), width * min(1, height - 1)
    index = torch.stack([corner, corner + right, corner + below, corner + right + below], -1).reshape(-1, 4)
    weight = torch.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy], -1).reshape(-1, 4)
    found = nn.functional.embedding_bag(index, maps.reshape(-1, channels), mode="sum", per_sample_weights=weight)
    return found.reshape(*view.shape, channels)


def trilinear(volume: Tensor, grid: Tensor) -> Tensor:
    """(N, C) of a volume (D, D, D, C), x slowest, whose values lie in the middles of voxels, at grid coordinates (N, 3)."""
    side, channels = volume.shape[0], volume.shape[-1]
    at = (grid * side - 0.5).clamp(0, side - 1)
    low = at.floor().clamp(max=side - 2)
    f, cell = at - low, low.long()
    corners = torch.tensor([[n >> 2 & 1, n >> 1 & 1, n & 1] for n in range(8)], device=grid.device)
    place = cell[:, None] + corners  # (N, 8, 3)
    index = (place[..., 0] * side + place[..., 1]) * side + place[..., 2]
    weight = torch.where(corners == 1, f[:, None], 1 - f[:, None]).prod(-1)
    return nn.functional.embedding_bag(index, volume.reshape(-1, channels), mode="sum", per_sample_weights=weight)


def angles(views: SourceViews, points: Tensor, directions: Tensor, view: Tensor) -> Tensor:
    """(N, K, 4) unit directions (N, 3) of rays less those from views (N, K) to world points (N, 3), and the cosines between them."""
    towards = nn.functional.normalize(points[:, None] - views.centre[view], dim=-1)
    return torch.cat([directions[:, None] - towards, (directions[:, None] * towards).sum(-1, keepdim=True)], -1)


def as_logit(colour: Tensor) -> Tensor:
    """What a sigmoid turns back into the colour: fields give colours before theirs."""
    return torch.logit(colour.clamp(DARKEST, 1 - DARKEST))


class SourceViewField(Field):
    """A field (`efficientnerf.fields.field`) whose density and colour depend on the source views, which are chosen for each ray."""

    activation = "exp"
    views: SourceViews

    def density(self, points: Tensor) -> Tensor:
        """As seen from any source view, another one for each point: the density depends on who looks, and density voxels average over it.

        Each point is a ray of its own here. The view follows from the point's digits, so that the same points have the same densities.
        """
        view = (points.double() * 1e6).long().sum(-1) % len(self.views.centre)
        directions = nn.functional.normalize(self.views.world(points) - self.views.centre[view], dim=-1)
        return self.along_rays(points, directions, torch.arange(len(points) + 1, device=points.device))[:, 0]


@dataclass(frozen=True)
class Lookup:
    """Samples of rays in their source views: world points (N, 3), directions (N, 3), view, pixel, seen (N, K, ...) and angles (N, K, 4)."""

    points: Tensor
    directions: Tensor
    view: Tensor
    pixel: Tensor
    seen: Tensor
    angles: Tensor


def look_up(views: SourceViews, points: Tensor, directions: Tensor, first: Tensor, count: int) -> Lookup:
    """Of N > 0 samples (N, 3) in grid coordinates along rays (R, 3), which own first[r] to first[r + 1], in `count` source views each, or all where fewer."""
    points, ray = views.world(points), ray_of_sample(first, len(points))
    begin = points[first[:-1].clamp(max=len(points) - 1)]  # (R, 3)
    chosen = views_of_rays(views, begin, directions, min(count, len(views.centre)))  # (R, K)
    # Homogeneous pixels change evenly along a ray.
    matrix = views.pixels_from_world[chosen]  # (R, K, 3, 4)
    at, change = (matrix[..., :3] @ part[:, None, :, None] for part in (begin, directions))
    view, along = chosen[ray], directions[ray]
    distance = ((points - begin[ray]) * along).sum(-1)
    pixel, seen = projected(views, (at[..., 0] + matrix[..., 3])[ray] + distance[:, None, None] * change[..., 0][ray])
    return Lookup(points, along, view, pixel, seen, angles(views, points, along, view))
