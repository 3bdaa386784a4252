"""Images of trees: cameras to rays to pixels. `render` and `render_rays` use the kernels of the tree's device. R rays, N stored voxels, K harmonics."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from efficientnerf.asset.cascades import cascades_of
from efficientnerf.asset.tree import NerfTree
from efficientnerf.backends import dispatch
from efficientnerf.backends.numba import rays as kernels
from efficientnerf.backends.numba.tree.rendering import render_image
from efficientnerf.backends.numba.tree.surroundings import over_environment
from efficientnerf.geometry.cameras import Camera, rays

RAYS_PER_BAND = 2**20  # of supersampled images at once
MOST_PIXELS = 2**27  # 4 GiB of colours, opacities, depths and normals


@dataclass(frozen=True)
class Rendering:
    """The image of a scene that a camera takes, or the same along a bundle of rays.

    colour   (..., 3) float32, sRGB, over the background that was given; else over the tree's environment, where it has one; else premultiplied by the opacity
    opacity  (...)    float32, 0 to 1, of the voxels alone
    depth    (...)    float32, world units, along the view axis for cameras and along the ray for rays; where half of the light is
                      absorbed, infinity where less than half ever is
    normal   (..., 3) float32, unit, world frame, out of the surface; zero where nothing is hit; (0, 0, 3) where it was not wanted
    """

    colour: np.ndarray
    opacity: np.ndarray
    depth: np.ndarray
    normal: np.ndarray


def render(
    tree: NerfTree, camera: Camera, *, background: tuple[float, float, float] | None = None, supersample: int = 1, normals: bool = True,
    rays_per_band: int = RAYS_PER_BAND,
) -> Rendering:  # fmt: skip
    """The image that a camera in the training frame takes.

    background     sRGB colour to composite over; None: the tree's environment; without one the colour is premultiplied
    supersample    rays along each side of a pixel
    normals        whether they are wanted; else they are (0, 0, 3), and most images take less time
    rays_per_band  of supersampled images at once; changes memory alone

    Raises ValueError for a camera without an image: of no size or of more than MOST_PIXELS, without a focal length, or with numbers that are not finite.
    """
    _check_camera(camera, supersample)
    behind = _background(background)
    on_device = dispatch.tree_backend(tree) == "triton"
    if on_device and tree.ndc is None:
        from efficientnerf.backends.triton import tree as cuda_tree  # needs Triton, which is there on CUDA alone

        parts = cuda_tree.render_image(cuda_tree.device_tree_of(tree), camera, background=background, supersample=supersample)
        rendering = Rendering(*(part.cpu().numpy() for part in parts))
    elif on_device or tree.lookup == "nearest":
        rendering = _render_by_rays(tree, camera, background, supersample, rays_per_band)
    else:
        return Rendering(*render_image(tree, camera, supersample, behind, normals=normals, rays_per_band=rays_per_band))
    return rendering if normals else replace(rendering, normal=np.zeros((0, 0, 3), np.float32))


def _background(background: tuple[float, float, float] | None) -> np.ndarray | None:
    """A background as (3,) float32."""
    if background is None:
        return None
    behind = np.asarray(background, np.float32)
    if behind.shape != (3,):
        raise ValueError(f"background {background}: expected three numbers, red, green and blue")
    return behind


def _check_camera(camera: Camera, supersample: int) -> None:
    """Raises ValueError, see `render`."""
    if supersample < 1:
        raise ValueError(f"supersample {supersample}: expected at least 1")
    if camera.width < 1 or camera.height < 1 or camera.width * camera.height > MOST_PIXELS:
        raise ValueError(f"{camera.name}: {camera.width} x {camera.height} pixels; expected 1 to {MOST_PIXELS}")
    if not (np.isfinite(camera.world_from_camera).all() and np.isfinite(camera.params).all()):
        raise ValueError(f"{camera.name}: its pose or its lens holds a number that is not finite")
    focal = camera.intrinsics["fx"], camera.intrinsics["fy"]
    if min(focal) <= 0:
        raise ValueError(f"{camera.name}: focal length {min(focal):g}; expected a positive one")


def render_rays(
    tree: NerfTree, origins: np.ndarray, directions: np.ndarray, *, eye: np.ndarray | None = None, columns: int | None = None,
    background: tuple[float, float, float] | None = None,
) -> Rendering:  # fmt: skip
    """The same along rays: origins (R, 3), unit directions (R, 3), world frame; depth is the distance along the ray. `background` is as in `render`.

    Hints on all rays make them faster on the CPU, and change colours by less than 1e-3 (2e-3 in normalised device coordinates):

    eye      (3,) the point that all come from
    columns  how many make a row, where they are the rows of an image
    """
    behind = _background(background)
    if tree.ndc is None:
        outputs = Rendering(*dispatch.tree_rays(tree, origins, directions, None, eye, columns))
    else:
        warped = kernels.warp_rays(tree.ndc, origins, directions)
        colour, opacity, along, normal = dispatch.tree_rays(tree, warped.origins, warped.directions, np.asarray(directions), eye, columns)
        outputs = Rendering(colour, opacity, *kernels.unwarp_hits(tree.ndc, warped, along, normal))
    if behind is not None:
        return replace(outputs, colour=outputs.colour + (1 - outputs.opacity[:, None]) * behind)
    if tree.environment is not None:
        return replace(outputs, colour=over_environment(tree.environment, directions, outputs.opacity, outputs.colour))
    return outputs


def _render_by_rays(tree: NerfTree, camera: Camera, background: tuple[float, float, float] | None, supersample: int, rays_per_band: int) -> Rendering:
    """An image band by band of `render_rays`: of a tree that is not interpolated, or on a device of one whose frame is not the world, where rays diverge."""
    height, width, n = camera.height, camera.width, supersample
    out = Rendering(*(np.empty((height, width, *channels), np.float32) for channels in ((3,), (), (), (3,))))
    behind = np.zeros(3, np.float32) if background is None else np.asarray(background, np.float32)
    step = max(1, rays_per_band // 2 // (width * n**2))
    for top in range(0, height, step):
        y, x = np.mgrid[top * n : min(height, top + step) * n, 0 : width * n]
        origins, directions = rays(camera, (np.stack([x.ravel(), y.ravel()], axis=-1) + 0.5) / n)
        before = background if n == 1 or background is None else (0, 0, 0)
        part = render_rays(tree, origins, directions, eye=camera.centre, columns=width * n, background=before)
        along = (part.depth * (directions @ camera.forward)).astype(np.float32)
        rows = len(y) // n
        if n == 1:
            hit = part.opacity >= 0.5
            band = part.colour, part.opacity, np.where(hit, along, np.float32(np.inf)), part.normal * hit[:, None]
        else:
            values = np.concatenate([part.colour, part.opacity[:, None], along[:, None], part.normal], axis=1, dtype=np.float32)
            band = _merged(values.reshape(rows, n, width, n, 8).swapaxes(1, 2).reshape(rows, width, n * n, 8), behind)
        for whole, piece in zip(vars(out).values(), band, strict=True):
            whole[top : top + rows] = piece.reshape(rows, width, *whole.shape[2:])
    return out


def _merged(samples: np.ndarray, behind: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The fields of a Rendering from the samples of its pixels, (H, W, n^2, 8): colour, opacity, depth and normal of each."""
    count = samples.shape[2]
    colour, opacity = samples[..., :3].mean(axis=2), samples[..., 3].mean(axis=2)
    # The nearest half of the samples decides; the mean of a near and a far surface would lie on neither.
    near = np.sort(samples[..., 4], axis=2)
    middle = np.clip(np.isfinite(near).sum(axis=2, keepdims=True) - 1, 0, (count - 1) // 2)  # less than half may do, where others are half transparent
    depth = np.take_along_axis(near, middle, axis=2)[..., 0]
    facing = samples[..., 5:].sum(axis=2)
    normal = facing / np.maximum(np.linalg.norm(facing, axis=-1, keepdims=True), 1e-12)
    depth[opacity < 0.5] = np.inf
    normal[opacity < 0.5] = 0
    return colour + (1 - opacity[..., None]) * behind, opacity, depth, normal


def ray_parts(tree: NerfTree, origins: Tensor, directions: Tensor) -> list[tuple[int, Tensor, Tensor]]:
    """The parts of rays (R, 3) of the tree's frame in each cascade, from front to back: the cascade, and the distances (R,) at which a part of each ray begins
    and ends, units of the frame; a part that ends before it begins is none. The box of the cascade before is cut out of each, so that a ray may have two parts
    in one."""
    bounds = [torch.as_tensor(cascade.bounds(tree.brick), device=origins.device, dtype=origins.dtype) for cascade in cascades_of(tree)]
    met = []
    for low, high in bounds:
        one, other = (low - origins) / directions, (high - origins) / directions
        enter, leave = torch.minimum(one, other).nan_to_num(-1e30, 1e30, -1e30), torch.maximum(one, other).nan_to_num(1e30, 1e30, -1e30)
        met.append((enter.amax(dim=-1).clamp(min=0), leave.amin(dim=-1)))
    front, back = [], []
    for n in range(1, len(met)):
        (enter, leave), (inner_enter, inner_leave) = met[n], met[n - 1]
        meets = inner_leave > inner_enter
        front.append((n, enter, torch.where(meets, inner_enter, leave)))
        back.append((n, torch.where(meets, inner_leave, leave), leave))
    return [*reversed(front), (0, *met[0]), *back]
