"""The volume that fields are evaluated in, one type for each kind of scene, with the defaults that suit it: the only statement of world to grid.

    BoundedSpace     the box (`aabb`) alone; beyond it lies a background without depth
    ContractedSpace  the box, and an unbounded scene around it, contracted into a shell
    NdcSpace         a box in normalised device coordinates, which reaches to infinity (`efficientnerf.geometry.ndc`)

The box becomes [-1, 1]^3 ("unit coordinates" u). The contraction is that of Barron et al. 2022, "Mip-NeRF 360", equation 10, with the maximum norm,
so that the shell of a box is a box:

    c(u) = u                             |u|_inf <= 1
    c(u) = (2 - 1 / |u|_inf) u / |u|_inf   otherwise

Grid coordinates g run over [0, 1]^3: the box alone, or box and shell. A space's frame is the world, or the normalised device coordinates.

R rays, N points.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor

from efficientnerf.backends.transfer import constant
from efficientnerf.geometry.ndc import Ndc, ndc_distance, world_distance

FARTHEST = 1.0 / 64  # 1 / |u|_inf at which a ray in contracted space ends


class RayBundle(NamedTuple):
    """Rays in a space's frame."""

    # origins, directions, near, far: (R, 3), (R, 3) unit, (R,), (R,) in units of the frame
    origins: Tensor
    directions: Tensor
    near: Tensor
    far: Tensor
    warp: tuple[Tensor, Tensor, Tensor] | None  # begin, ds_dt, dlogz_dt of `efficientnerf.geometry.ndc`, (R,) each; None where the frame is the world

    def last(self, count: int) -> RayBundle:
        """The last of the rays."""
        warp = None if self.warp is None else (self.warp[0][-count:], self.warp[1][-count:], self.warp[2][-count:])
        return RayBundle(self.origins[-count:], self.directions[-count:], self.near[-count:], self.far[-count:], warp)

    def world_distance(self, along: Tensor, ray: Tensor) -> Tensor:
        """Distances (N,) in the frame along the rays `ray` (N,) to distances in the world."""
        return along if self.warp is None else world_distance(along, *(part[ray] for part in self.warp))

    def frame_distance(self, distance: Tensor) -> Tensor:
        """World distances (R,), one to a ray, to distances in the frame."""
        return distance if self.warp is None else ndc_distance(distance, *self.warp)


@dataclass(frozen=True, eq=False)
class Box:
    """An axis-aligned box: bounds (2, 3), least and greatest corner."""

    bounds: np.ndarray

    @cached_property
    def centre(self) -> np.ndarray:
        return np.asarray(self.bounds, np.float64).mean(axis=0)

    @cached_property
    def half(self) -> np.ndarray:
        """(3,) half extents."""
        return np.asarray(self.bounds[1] - self.bounds[0], np.float64) / 2

    @cached_property
    def diagonal(self) -> float:
        return 2 * float(np.linalg.norm(self.half))

    def unit(self, points: Tensor) -> Tensor:
        """Points (..., 3) to unit coordinates."""
        return (points - constant(self.centre, points)) / constant(self.half, points)

    def intersect(self, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Distances (R,) at which rays enter and leave the box by the slab test; leave <= enter where they miss it, and negative behind the origin."""
        u, du = self.unit(origins), directions / constant(self.half, directions)
        du = torch.where(du.abs() < 1e-12, torch.full_like(du, 1e-12), du)
        one, other = (-1 - u) / du, (1 - u) / du
        return torch.minimum(one, other).amax(dim=-1), torch.maximum(one, other).amin(dim=-1)


@dataclass(frozen=True, eq=False)
class BoundedSpace(Box):
    """The box alone, in the world.

    Defaults, of settings left to be chosen: num_coarse_samples (N_c), occupancy_resolution, occupancy_alpha_threshold, distortion_loss_weight;
    voxel_depth, depth over width of a baked voxel.
    """

    contracted: ClassVar[bool] = False  # whether space beyond the box is contracted into a shell
    unbounded: ClassVar[bool] = False  # whether the space has no end, so that densities spread along rays and the distortion loss is needed
    reaches_infinity: ClassVar[bool] = False  # whether the box itself reaches to infinity, so that nothing can lie behind it
    reach: ClassVar[float] = 1.0  # the largest contracted coordinate
    num_coarse_samples: ClassVar[int] = 128
    occupancy_resolution: ClassVar[int] = 128
    occupancy_alpha_threshold: ClassVar[float] = 0.01
    distortion_loss_weight: ClassVar[float] = 0.01
    voxel_depth: ClassVar[float] = 1.0

    @property
    def ndc(self) -> Ndc | None:
        """The reference camera of the frame; None: the frame is the world."""
        return None

    def distortion_schedule(self, progress: float) -> float:
        """Factor of the distortion loss at a share of the schedule, 0 to 1."""
        return 1.0

    def rays(self, origins: Tensor, directions: Tensor, near: Tensor, far: Tensor) -> RayBundle:
        """World rays (R, 3), unit directions, between distances near and far (R,), in the space's frame."""
        return RayBundle(origins, directions, near, far, None)

    def clip(self, origins: Tensor, directions: Tensor, near: Tensor, far: Tensor) -> tuple[Tensor, Tensor]:
        """Distances (R,) at which rays of the frame enter and leave the space, within near and far; leave <= enter where they miss it."""
        enter, leave = self.intersect(origins, directions)
        return torch.maximum(enter, near), torch.minimum(leave, far)

    def sampled_length(self, span: tuple[float, float] | None) -> float:
        """What N_c intervals cover: the box's diagonal, or near to far where these are given."""
        return self.diagonal if span is None else span[1] - span[0]

    def max_intervals(self, step: float) -> int:
        """Intervals of length `step` in the box on a ray, at most."""
        return math.ceil(self.diagonal / step) + 1

    def grid(self, points: Tensor) -> Tensor:
        """Points (..., 3) of the frame to grid coordinates, in [0, 1] wherever the space reaches."""
        return (self.unit(points) + self.reach) / (2 * self.reach)

    def world(self, grid: Tensor) -> Tensor:
        """Grid coordinates (..., 3) to points of the frame: the inverse of `grid`."""
        c = grid * (2 * self.reach) - self.reach
        return c * constant(self.half, grid) + constant(self.centre, grid)


@dataclass(frozen=True, eq=False)
class ContractedSpace(BoundedSpace):
    """The box and an unbounded scene around it, in the world; attributes and methods as for `BoundedSpace`."""

    contracted: ClassVar[bool] = True
    unbounded: ClassVar[bool] = True
    reach: ClassVar[float] = 2.0
    occupancy_resolution: ClassVar[int] = 192

    def clip(self, origins: Tensor, directions: Tensor, near: Tensor, far: Tensor) -> tuple[Tensor, Tensor]:
        return near, far

    def max_intervals(self, step: float) -> int:
        # In front of the box and behind it: the contracted distance from the edge of space to the box and back, in steps, with some more
        # for rays that run slantwise through the shell.
        return super().max_intervals(step) + math.ceil(4 * (1 - FARTHEST) * float(self.half.max()) * math.sqrt(3) / step)

    def grid(self, points: Tensor) -> Tensor:
        return (contract(self.unit(points)) + self.reach) / (2 * self.reach)

    def world(self, grid: Tensor) -> Tensor:
        c = uncontract(grid * (2 * self.reach) - self.reach)
        return c * constant(self.half, grid) + constant(self.centre, grid)


@dataclass(frozen=True, eq=False)
class NdcSpace(BoundedSpace):
    """A box in the normalised device coordinates of the reference camera `frame`; attributes and methods as for `BoundedSpace`."""

    frame: Ndc

    unbounded: ClassVar[bool] = True
    reaches_infinity: ClassVar[bool] = True
    num_coarse_samples: ClassVar[int] = 96  # docs/experiments/ndc.md
    occupancy_alpha_threshold: ClassVar[float] = 0.05  # docs/experiments/ndc.md
    distortion_loss_weight: ClassVar[float] = 0.002  # docs/experiments/ndc.md
    voxel_depth: ClassVar[float] = 2.0  # docs/experiments/ndc.md

    @property
    def ndc(self) -> Ndc:
        return self.frame

    def distortion_schedule(self, progress: float) -> float:
        # Grows from nothing: at full weight from the beginning, density would gather on the near plane, where cameras overlap least.
        return progress

    def rays(self, origins: Tensor, directions: Tensor, near: Tensor, far: Tensor) -> RayBundle:
        """World rays, warped: they run from the near plane to infinity, whatever near and far say."""
        start, along, begin, ds_dt, dlogz_dt = self.frame.rays(origins, directions)
        return RayBundle(start, along, torch.zeros_like(near), torch.full_like(far, 1e6), (begin, ds_dt, dlogz_dt))

    def sampled_length(self, span: tuple[float, float] | None) -> float:
        """The diagonal of a cube as deep as the box: depth, not width, is what is sampled."""
        return 2 * math.sqrt(3) * float(self.half[2])

    def with_voxel_depth(self, depth: float) -> NdcSpace:
        """The same space in a frame scaled along x and y, so that cubes there are `depth` times as deep as they are wide here.

        Grid coordinates are the same in both. So are lengths along z', which rays nearly run along, and with them densities; what slanted rays meet
        more of is left to the refinement.
        """
        frame = replace(self.frame, width=self.frame.width / depth, height=self.frame.height / depth)
        return NdcSpace(np.asarray(self.bounds, np.float64) * (depth, depth, 1.0), frame)


Space = BoundedSpace | ContractedSpace | NdcSpace


def space_from(bounds: np.ndarray, *, contracted: bool = False, ndc: Ndc | None = None) -> Space:
    """The space that a file describes.

    bounds      (2, 3) the box, in the frame
    contracted  whether the scene is unbounded, and lies in the world
    ndc         the reference camera of the frame; None: the world
    """
    if ndc is None:
        return ContractedSpace(bounds) if contracted else BoundedSpace(bounds)
    if contracted:
        raise ValueError("a space in normalised device coordinates reaches to infinity by itself; it cannot be contracted")
    return NdcSpace(bounds, ndc)


def voxel_centres(space: Space, points: Tensor, resolution: int) -> Tensor:
    """Grid coordinates (N, 3) of the centres of the voxels that hold points in grid coordinates (N, 3).

    The voxels are those of a baked tree: cubes, `resolution` of them along the longest side of the box, from its least corner on. Points
    beyond the box, where nothing is baked, stay as they are.

    The paper's alternative to linear interpolation (EfficientNeRF, section 4.1): a field that is only evaluated at discrete coordinates loses
    nothing when its values there are all that is kept. docs/experiments/discretise.md
    """
    extent = 2 * space.half
    side = float(extent.max()) / resolution
    low, last = constant(space.bounds[0], points), constant(np.ceil(np.round(extent / side, 6)) - 1, points)
    voxel = torch.floor((space.world(points) - low) / side)
    centre = space.grid((torch.minimum(voxel.clamp(min=0), last) + 0.5) * side + low)
    inside = (space.unit(space.world(points)).abs() <= 1 + 1e-5).all(dim=-1, keepdim=True)
    return torch.where(inside, centre, points)


def contract(u: Tensor) -> Tensor:
    """All of space into [-2, 2]^3; the identity inside [-1, 1]^3."""
    m = u.abs().amax(dim=-1, keepdim=True)
    far = m.clamp(min=1)
    return u * (2 - 1 / far) / far


def uncontract(c: Tensor) -> Tensor:
    """The inverse of `contract`, for points short of the outer face."""
    m = c.abs().amax(dim=-1, keepdim=True)
    near = m.clamp(min=1)
    return c / (near * (2 - near).clamp(min=1e-6))
