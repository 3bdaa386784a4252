"""Normalised device coordinates of forward-facing captures: all that lies in front of a reference camera, out to infinity, in a box.

Mildenhall et al. 2020, "NeRF", appendix C. With (x, y, z) in the reference camera (x right, y down, z forward: the project's axes, where the
appendix has y up and looks along -z), focal length f, width W, height H and near plane n:

    x' = f / (W/2)  x / z        y' = f / (H/2)  y / z        z' = 1 - 2 n / z

z' is -1 on the near plane and 1 at infinity, and even steps of z' are even steps of parallax. Straight lines stay straight. A ray o + t d that
begins at t0 (on the near plane, or at o where that lies beyond it) becomes a ray of unit direction; with p = o + t0 d, J the map's
derivative at p, g = ds/dt = |J d| and k = d(log z)/dt = d_z / p_z at t0 (z as above) the point at distance t lies, along the warped ray, at

    s(t) = g (t - t0) / (1 + k (t - t0))        t(s) = t0 + s / (g - k s)

Numpy arrays and torch tensors alike; results are of the kind, type and device of the arguments. torch is not imported.

R rays, N points.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

NUMBERS = ("focal", "width", "height", "near")
BEYOND = 3.0  # z' from which a ray that never enters the box starts, leaving it


class NdcRays(NamedTuple):
    """Rays in normalised device coordinates, and the way back to distances of the world."""

    # origins, directions: (R, 3) where the rays begin, and unit directions
    origins: Any
    directions: Any
    begin: Any  # (R,) world distance along the ray at which it begins (t0)
    # ds_dt, dlogz_dt: (R,) g and k of the module
    ds_dt: Any
    dlogz_dt: Any


def world_distance(along: Any, begin: Any, ds_dt: Any, dlogz_dt: Any) -> Any:
    """World distance from a ray's own origin of points at distance `along` its warped ray; infinity from the far plane on. Arrays of one shape."""
    rest = ds_dt - dlogz_dt * along
    finite = rest > 1e-6 * ds_dt
    return _where(finite, begin + along / _where(finite, rest, 1.0), np.inf)


def ndc_distance(distance: Any, begin: Any, ds_dt: Any, dlogz_dt: Any) -> Any:
    """The inverse of `world_distance`; 0 before the warped ray begins."""
    past = _at_least(distance - begin, 0.0)
    return ds_dt * past / _at_least(1 + dlogz_dt * past, 1e-6)


@dataclass(frozen=True, eq=False)
class Ndc:
    """The reference camera."""

    world_from_camera: np.ndarray  # (4, 4) its pose, the project's axes
    focal: float  # pixels
    # width, height: pixels; x' and y' are -1 and 1 at the borders of an image of this size
    width: float
    height: float
    near: float  # distance of the near plane from the camera, world units

    @cached_property
    def slopes(self) -> tuple[float, float]:
        """x' and y' of a point one unit to the side at a distance of one unit."""
        return 2 * self.focal / self.width, 2 * self.focal / self.height

    def to_json(self) -> dict[str, Any]:
        return {"world_from_camera": self.world_from_camera.tolist(), **{name: float(getattr(self, name)) for name in NUMBERS}}

    @staticmethod
    def from_json(data: Mapping[str, Any]) -> Ndc:
        """The inverse of `to_json`; KeyError, TypeError or ValueError for what is none."""
        ndc = Ndc(np.asarray(data["world_from_camera"], np.float64).reshape(4, 4), *(float(data[name]) for name in NUMBERS))
        rotation, row = ndc.world_from_camera[:3, :3], ndc.world_from_camera[3]
        if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4) or np.linalg.det(rotation) < 0 or (row != (0, 0, 0, 1)).any():
            raise ValueError("the reference camera's pose is no rigid motion")
        if not all(np.isfinite(x) and x > 0 for x in (ndc.focal, ndc.width, ndc.height, ndc.near)):
            raise ValueError("the reference camera's focal length, width, height and near plane must be positive")
        return ndc

    def _camera(self, vectors: Any, *, directions: bool) -> tuple[Any, Any, Any]:
        rotation = _like(self.world_from_camera[:3, :3], vectors)
        local = (vectors if directions else vectors - _like(self.world_from_camera[:3, 3], vectors)) @ rotation
        return local[..., 0], local[..., 1], local[..., 2]

    def points(self, world: Any) -> Any:
        """World points (..., 3) to normalised device coordinates. Points behind the camera get z' = BEYOND, outside of any box."""
        x, y, z = self._camera(world, directions=False)
        a, b = self.slopes
        ahead = z > 1e-6 * self.near
        z = _where(ahead, z, 1.0)
        return _stack([_where(ahead, a * x / z, 0.0), _where(ahead, b * y / z, 0.0), _where(ahead, 1 - 2 * self.near / z, BEYOND)])

    def world(self, ndc: Any) -> Any:
        """The inverse of `points`, for z' < 1."""
        a, b = self.slopes
        z = 2 * self.near / _at_least(1 - ndc[..., 2], 1e-9)
        local = _stack([ndc[..., 0] * z / a, ndc[..., 1] * z / b, z])
        return local @ _like(self.world_from_camera[:3, :3].T.copy(), ndc) + _like(self.world_from_camera[:3, 3], ndc)

    def view_direction_matrix(self, eye: np.ndarray) -> np.ndarray:
        """(3, 4): takes (x', y', z', 1) to the view direction in the world, of any length, from `eye` (3,), world, to that point.

        With W = (1 - z') / (2 n) a point is R (x'/a, y'/b, 1) / W + t, for the camera's rotation R and position t; times W, less the eye, it is linear.
        """
        rotation, offset = self.world_from_camera[:3, :3], (self.world_from_camera[:3, 3] - eye) / (2 * self.near)
        a, b = self.slopes
        return np.stack([rotation[:, 0] / a, rotation[:, 1] / b, -offset, rotation[:, 2] + offset], axis=1)

    @cached_property
    def world_from_ndc(self) -> np.ndarray:
        """(4, 4): takes (x', y', z', 1) to W times (x, y, z, 1) of the world; W = (1 - z') / (2 n) is one over the depth."""
        return np.vstack([self.view_direction_matrix(np.zeros(3)), np.array([0, 0, -1, 1]) / (2 * self.near)])

    def rays(self, origins: Any, directions: Any) -> NdcRays:
        """World rays (R, 3), unit directions, to rays in normalised device coordinates.

        One that never reaches the near plane gets an origin at z' = BEYOND and points away.
        """
        a, b = self.slopes
        x, y, z = self._camera(origins, directions=False)
        dx, dy, dz = self._camera(directions, directions=True)
        ahead = dz > 1e-9
        begin = _where(z < self.near, _where(ahead, (self.near - z) / _where(ahead, dz, 1.0), np.inf), 0.0)
        meets = begin < np.inf
        begin = _where(meets, begin, 0.0)
        x, y = x + begin * dx, y + begin * dy
        z = _where(meets, _at_least(z + begin * dz, self.near), self.near)
        jx, jy, jz = a * (dx * z - x * dz) / z**2, b * (dy * z - y * dz) / z**2, 2 * self.near * dz / z**2
        ds_dt = (jx * jx + jy * jy + jz * jz) ** 0.5
        nowhere = ~meets | (ds_dt < 1e-12)
        divisor = _where(nowhere, 1.0, ds_dt)
        start = _stack([_where(nowhere, 0.0, a * x / z), _where(nowhere, 0.0, b * y / z), _where(nowhere, BEYOND, 1 - 2 * self.near / z)])
        along = _stack([_where(nowhere, 0.0, jx / divisor), _where(nowhere, 0.0, jy / divisor), _where(nowhere, 1.0, jz / divisor)])
        return NdcRays(start, along, begin, divisor, dz / z)

    def world_normals(self, ndc: Any, normals: Any) -> Any:
        """Normals (N, 3) of surfaces in normalised device coordinates, at points there (N, 3), to unit normals in the world; zero stays zero.

        A gradient is pulled back by the transposed derivative of the map, J^T.
        """
        a, b = self.slopes
        z = 2 * self.near / _at_least(1 - ndc[..., 2], 1e-9)
        x, y = ndc[..., 0] * z / a, ndc[..., 1] * z / b
        nx, ny, nz = a * normals[..., 0], b * normals[..., 1], 2 * self.near * normals[..., 2]
        # J = [[a/z, 0, -a x/z^2], [0, b/z, -b y/z^2], [0, 0, 2n/z^2]]; the common factor 1/z goes with the length.
        local = _stack([nx, ny, (nz - x * nx - y * ny) / z])
        world = local @ _like(self.world_from_camera[:3, :3].T.copy(), ndc)
        length = (world * world).sum(-1) ** 0.5
        return world / _where(length > 0, length, 1.0)[..., None]


class WorldFrame:
    """The world as the frame of a tree: the methods that `Ndc` has, doing nothing."""

    def points(self, world: Any) -> Any:
        return world

    def world(self, points: Any) -> Any:
        return points

    def rays(self, origins: Any, directions: Any) -> NdcRays:
        zero = origins[..., 0] * 0
        return NdcRays(origins, directions, zero, zero + 1, zero)

    def world_normals(self, points: Any, normals: Any) -> Any:
        return normals


WORLD = WorldFrame()
Frame = WorldFrame | Ndc


def _is_numpy(value: Any) -> bool:
    return isinstance(value, np.ndarray | np.generic)


def _like(constant: np.ndarray, value: Any) -> Any:
    """The constant in the kind, type and device of `value`."""
    if _is_numpy(value):
        return np.asarray(constant, value.dtype)
    from efficientnerf.backends import transfer  # finding cameras needs no torch

    return transfer.constant(constant, value)


def _where(condition: Any, yes: Any, no: Any) -> Any:
    if _is_numpy(condition):
        return np.where(condition, yes, no)
    import torch  # finding cameras needs none

    return torch.where(condition, yes, no)


def _at_least(value: Any, least: float) -> Any:
    return np.maximum(value, np.asarray(least, value.dtype)) if _is_numpy(value) else value.clamp(min=least)


def _stack(parts: list[Any]) -> Any:
    if _is_numpy(parts[0]):
        return np.stack(parts, axis=-1)
    import torch  # finding cameras needs none

    return torch.stack(parts, dim=-1)
