"""The part of an asset to show or export: its foreground, all of it, or a box of the capture's frame."""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from efficientnerf.asset.camera_paths import similarity_of
from efficientnerf.asset.region import cropped, foreground, voxel_centres
from efficientnerf.asset.tree import NerfTree, Region
from efficientnerf.geometry.cameras import Similarity
from pipeline.errors import UsageError


def restricted(tree: NerfTree, region: str, crop: Sequence[float] | None = None) -> NerfTree:
    """The tree with its foreground alone, or with all, and of that what lies in a box.

    region  "foreground" or "all"; a tree without a region is foreground throughout
    crop    six numbers in the capture's frame, x y z of one corner and of the opposite one

    Raises UsageError for a box without volume, and where the box or the region leaves nothing of an asset that holds something.
    """
    out = foreground(tree) if region == "foreground" else tree
    if not len(out.density_values) and len(tree.density_values):
        raise UsageError("nothing of the asset lies in its foreground region. Choose the region all.")
    if crop is None:
        return out
    whole, similarity = out, similarity_of(tree)
    try:
        out = cropped(whole, np.array(crop, np.float64).reshape(2, 3), similarity)
    except ValueError as error:
        raise UsageError(f"--crop: {error}") from error
    if len(whole.density_values) and not len(out.density_values):
        raise UsageError(f"--crop {_numbers(crop)}: nothing of the asset lies in this box of the capture's frame{_reach(whole, similarity)}.")
    return out


def _reach(tree: NerfTree, world_from_capture: Similarity) -> str:
    """Where a tree's voxels are in the capture's frame, in words; nothing where some are at infinity."""
    places = voxel_centres(tree)
    with np.errstate(all="ignore"):
        places = world_from_capture.inverse().points(places if tree.ndc is None else np.asarray(tree.ndc.world(places)))
    if not np.isfinite(places).all():
        return ""
    return f", where it reaches from {_numbers(places.min(axis=0))} to {_numbers(places.max(axis=0))}"


def _numbers(values: Iterable[float]) -> str:
    return " ".join(f"{value:g}" for value in values)


def with_region(tree: NerfTree) -> NerfTree:
    """The tree with a region round all that it holds, so that camera paths frame that."""
    if tree.ndc is not None or not len(tree.density_values):
        return tree
    places, side = voxel_centres(tree), tree.voxel
    return replace(tree, region=Region(np.stack([places.min(axis=0) - side, places.max(axis=0) + side])))
