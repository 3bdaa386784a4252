"""A surface against the images of the asset that it was made of: which of its parts the asset shows, and how well silhouettes and depths agree.

H x W pixels, V vertices, F faces, C components.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from efficientnerf.asset.rendering import render
from efficientnerf.asset.tree import NerfTree
from efficientnerf.geometry.cameras import Camera
from efficientnerf.surface.rasteriser import MeshImage, mesh_image

OPAQUE = 0.5  # opacity of a pixel from which the surface has to cover it
FAINT = 0.25  # below which a pixel shows nothing
MARGIN_DEPTH, MARGIN_VOXELS = 0.03, 4.0  # of the depth, and voxels, that the surface may lie off the asset's median depth


@dataclass(frozen=True, eq=False)
class AssetView:
    """What a camera sees of an asset: opacity (H, W), depth (H, W) along the view axis, infinite where less than half of the light is absorbed; the world."""

    camera: Camera
    opacity: np.ndarray
    depth: np.ndarray


@dataclass(frozen=True)
class Agreement:
    """How far a surface and the asset show the same."""

    iou: float  # intersection over union of the surface's silhouettes and those of the asset, all views' pixels together
    missed: float  # share of the asset's opaque pixels that the surface does not cover
    added: float  # share of the surface's pixels that are beyond the asset's silhouettes
    depth: float  # median difference of the depths where both are, over the depth


def asset_view(tree: NerfTree, camera: Camera) -> AssetView:
    """What a camera of the training frame sees."""
    seen = render(tree, camera, normals=False)
    return AssetView(camera, seen.opacity, seen.depth)


def shown_pixels(vertices: np.ndarray, faces: np.ndarray, component: np.ndarray, views: Iterable[AssetView], voxel: float) -> np.ndarray:
    """(C,) how much of each component the asset shows: pixels of all views in which it is in front, and where the asset has a surface near its depth, each
    weighted by the asset's opacity.

    vertices, faces  of the world
    component        (F,) number of each face's component
    voxel            the side of a voxel, world units
    """
    out = np.zeros(int(component.max(initial=-1)) + 1)
    for view in views:
        image = mesh_image(vertices, faces, view.camera)
        own = np.where(image.covered, image.depth, 0)
        other = np.where(np.isfinite(view.depth), view.depth, own)  # its own, where less than half of the light is absorbed
        here = image.covered & (view.opacity >= FAINT) & (np.abs(own - other) <= MARGIN_DEPTH * own + MARGIN_VOXELS * voxel)
        out += np.bincount(component[image.face[here]], view.opacity[here], minlength=len(out))
    return out


def differences(view: AssetView, image: MeshImage) -> tuple[np.ndarray, np.ndarray]:
    """(H, W) bool each: pixels where the asset is opaque and the surface is not; and the other way round."""
    opaque = view.opacity >= OPAQUE
    return opaque & ~image.covered, image.covered & ~opaque


def agreement(views: Sequence[AssetView], images: Sequence[MeshImage]) -> Agreement:
    """Agreement of a surface's images from the views' cameras with the views."""
    both = either = opaque = covered = 0
    errors = [np.zeros(0)]
    for view, image in zip(views, images, strict=True):
        missed, added = differences(view, image)
        common = image.covered & ~added
        both, either = both + int(common.sum()), either + int((common | missed | added).sum())
        opaque, covered = opaque + int((common | missed).sum()), covered + int(image.covered.sum())
        known = common & np.isfinite(view.depth)
        errors.append(np.abs(image.depth[known] - view.depth[known]) / view.depth[known])
    error = np.concatenate(errors)
    iou = both / either if either else 1.0
    return Agreement(iou, (opaque - both) / max(opaque, 1), (covered - both) / max(covered, 1), float(np.median(error)) if len(error) else 0.0)
