"""A signed distance from the depths that views of an asset show, joined with the asset's densities. docs/experiments/surface.md

Median depths (half of the light absorbed) of many views are planes of pixels; a voxel's distance from them is averaged over the views, each by its confidence:
opacity, how well a plane fits the depths around the pixel, how steeply it is seen. Views that see through a voxel carve it. Curless and Levoy, "A volumetric
method for building complex models from range images", SIGGRAPH 1996; Newcombe et al., "KinectFusion", ISMAR 2011.

C cameras, H x W pixels.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter, maximum_filter, minimum_filter

from efficientnerf.asset.tree import NerfTree
from efficientnerf.backends.numba.mesh.fusion import CHANNELS, FILLED, fit_planes, fuse
from efficientnerf.backends.numba.tree.queries import distance_back
from efficientnerf.backends.pieces import pieces
from efficientnerf.geometry.cameras import rays
from efficientnerf.geometry.ndc import world_distance
from efficientnerf.surface.agreement import AssetView

# docs/experiments/surface.md
ABSORBED = 0.15  # share of the light that is gone at the depths that are fused: half is gone well inside of soft parts
LONGEST = 8.0  # voxels that this may lie before the median depth
RADIUS = 4  # pixels around, that a plane is fitted to
BAND = 3.0  # voxels off its plane that a pixel may be
TRUNCATION = 3.0  # voxels
EMPTY, HAZE = 0.01, 0.1  # opacities: nothing is fused a voxel beyond the first; from the second on, voxels that views place behind a surface are solid
DENSITY_WEIGHT = 0.5  # of the densities, in views
BLUR = 0.8  # voxels, standard deviation
THIN = (-1.2, -0.5)  # least distance around a voxel: up to the first it is a part of something thick, from the second on of something thin
CARVED = (0.5, 0.8)  # mean distance over the truncation: from the second on views see through a voxel, and it is no part of anything thin
AROUND = 2  # voxels on either side that this is looked for in
NEAR = 2  # voxels beyond a block whose fused values its own depend on: AROUND, and as many of BLUR
MARGIN = NEAR + 1  # whose densities
_INNER = (slice(MARGIN - NEAR, NEAR - MARGIN),) * 3


@dataclass(frozen=True, eq=False)
class Fusion:
    """Views as `efficientnerf.backends.numba.mesh.fusion` reads them."""

    planes: np.ndarray  # (C, H, W, CHANNELS) float32
    cameras: np.ndarray  # (C, 4, 4) float64 camera from the tree's frame
    lenses: np.ndarray  # (C, 4) float64 fx, fy, cx, cy
    depth_scale: float = 1.0  # of a voxel's depth


def front_depth(tree: NerfTree, view: AssetView) -> np.ndarray:
    """(H, W) float32 depth at which ABSORBED of the light is gone, along the view axis, of the pixels that have a median depth."""
    hit = np.isfinite(view.depth)
    y, x = np.nonzero(hit)
    origins, directions = rays(view.camera, np.stack([x, y], -1) + 0.5)
    cosine = directions @ view.camera.forward
    points = origins + (view.depth[hit] / cosine)[:, None] * directions
    out = view.depth.copy()
    for part in pieces(len(points), first=2**14):
        out[y[part], x[part]] -= _back(tree, points[part], directions[part]) * cosine[part]
    return out


def _back(tree: NerfTree, points: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """(N,) from median depths back to where ABSORBED of the light is gone, world units."""
    optical_depth, longest = np.log(2) + np.log1p(-ABSORBED), LONGEST * float(tree.voxel)
    if tree.ndc is None:
        return distance_back(tree, points, directions, optical_depth, longest)
    warped = tree.ndc.rays(points, directions)
    back = distance_back(tree, warped.origins, warped.directions, optical_depth, longest)
    return np.asarray(-world_distance(-back, 0.0 * back, warped.ds_dt, warped.dlogz_dt))


def fusion_of(tree: NerfTree, views: Sequence[AssetView], tick: Callable[[], None]) -> Fusion:
    """Views of a tree by pinhole cameras with images of one size, for its inmost cascade. `tick` is called before each; an exception from it stops the work."""
    height, width = views[0].depth.shape
    voxel = float(tree.voxel)
    scale = 1.0 if tree.ndc is None else 0.5 / tree.ndc.near
    planes = np.empty((len(views), height, width, CHANNELS), np.float32)
    lenses = np.array([[view.camera.intrinsics[name] for name in ("fx", "fy", "cx", "cy")] for view in views])
    for view, lens, out in zip(views, lenses, planes, strict=True):
        tick()
        depth = front_depth(tree, view)
        for part in pieces(height, first=16):
            fit_planes(depth, view.opacity, lens, part.start, part.stop, RADIUS, BAND * voxel * scale, tree.ndc is not None, out)
    frame = np.eye(4) if tree.ndc is None else tree.ndc.world_from_ndc
    cameras = np.array([np.linalg.inv(view.camera.world_from_camera) @ frame for view in views])
    return Fusion(planes, cameras, lenses, scale)


def fused_opacity(fusion: Fusion, opacity: np.ndarray, low: np.ndarray, bounds_min: np.ndarray, voxel: float) -> np.ndarray:
    """(X, Y, Z) float32 values whose level 1/2 is the surface, from those of the densities, for voxels from `low` on. The outermost MARGIN are of no use."""
    wanted = maximum_filter(opacity > EMPTY, size=3).astype(np.uint8)
    wanted[opacity >= HAZE] = FILLED
    wanted = np.pad(wanted[_INNER], MARGIN - NEAR)
    distance, weight = (np.zeros(opacity.shape, np.float32) for _ in range(2))
    for part in pieces(len(opacity), first=8):
        at = np.array([low[0] + part.start, low[1], low[2]], np.int64)
        fuse(
            np.asarray(bounds_min, np.float64), at, float(voxel), fusion.depth_scale, wanted[part], fusion.planes, fusion.cameras, fusion.lenses, TRUNCATION,
            distance[part], weight[part],
        )  # fmt: skip
    density = (TRUNCATION * (1 - 2 * opacity)).astype(np.float32)
    mixed = np.where(wanted > 0, (distance * weight + DENSITY_WEIGHT * density) / (weight + DENSITY_WEIGHT), density).astype(np.float32)
    smooth = gaussian_filter(mixed, BLUR, truncate=2.0)
    least = minimum_filter(mixed, size=2 * AROUND + 1)
    thin = np.clip((least - THIN[0]) / (THIN[1] - THIN[0]), 0, 1)
    through = np.where(weight >= 1, distance / TRUNCATION, 0)
    thin *= np.clip((CARVED[1] - through) / (CARVED[1] - CARVED[0]), 0, 1)
    smooth += thin * (np.minimum(mixed, density) - smooth)
    return np.asarray(np.clip(0.5 - smooth / (2 * TRUNCATION), 0, 1), np.float32)
