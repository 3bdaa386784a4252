"""Memory of making 3D Gaussians."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from efficientnerf.asset.tree import NerfTree
from stages.io.refined_cameras import load_scene
from stages.io.scene import views_of
from stages.memory.forecast import Known
from stages.memory.need import MIB, Need, libraries
from stages.memory.tree import asset_of, tree_bytes
from stages.splats.pictures import render_cameras
from stages.splats.settings import SplatsSettings

# Bytes. Of a parameter: value, gradient, two moments, and one more while Gaussians are merged and written; of a stored voxel while they are merged; of a
# pixel of a picture: its colours and mask; of a pixel of the one that is drawn: colours, transmittance, gradients and the Gaussians that cover its tile.
PARAMETER, VOXEL, PIXEL, DRAWN = 20, 100, 4, 400
# On a device: of a parameter, value and two moments, twice while Gaussians are divided; of a Gaussian its records and sums, and 16 pairs while they are sorted.
DEVICE_PARAMETER, DEVICE_GAUSSIAN = 16, 2400
WRITTEN_FLOAT, SPZ, SHEET = 4, 64, MIB // 4  # bytes of a parameter in PLY; of a Gaussian in SPZ; of a picture of them


def most_gaussians(settings: SplatsSettings, pixels: Sequence[int]) -> int:
    """How many are made at most, for pictures of so many pixels each."""
    return min(settings.count, max(1, int(np.median(pixels)))) if pixels else settings.count


def parameters_of(settings: SplatsSettings) -> int:
    """Of a Gaussian."""
    return 11 + 3 * (settings.sh_degree + 1) ** 2


def needed_on_device(settings: SplatsSettings) -> int:
    """Bytes that the Gaussians take on a device where they are fitted there, about."""
    return (DEVICE_PARAMETER * parameters_of(settings) + DEVICE_GAUSSIAN) * settings.count


def needed(tree: NerfTree, settings: SplatsSettings, captured: tuple[Path, Path] | None = None, device: str = "cpu") -> Need:
    """Memory to make Gaussians of a tree and to fit them to pictures; `captured` as for `pixels_of`."""
    pixels = pixels_of(tree, settings, captured)
    return Need({
        "Gaussians": PARAMETER * parameters_of(settings) * most_gaussians(settings, pixels),
        "merging": VOXEL * len(tree.density_values),
        "pictures": PIXEL * sum(pixels) + DRAWN * max(pixels, default=0),
        "the asset": tree_bytes(tree),
        "libraries": libraries(device),
    })  # fmt: skip


def pixels_of(tree: NerfTree, settings: SplatsSettings, captured: tuple[Path, Path] | None) -> list[int]:
    """Pixels of each picture that Gaussians are fitted to.

    captured  folders of the stages poses and train, whose photographs these are; None: the tree's own renders
    """
    own = captured is None or settings.pictures == "asset" or settings.region == "foreground"
    cameras = render_cameras(tree) if own or captured is None else [view.camera for view in views_of(load_scene(*captured), "train")]
    return [camera.width * camera.height for camera in cameras]


def memory_needed(known: Known) -> Need:
    """`needed` for all of the asset."""
    if known.settings["splats"].make == "off":
        return Need({"libraries": libraries(known.device)})
    return needed(asset_of(known), known.settings["splats"], (known.run / "poses", known.run / "train"), known.device)


def space_needed(known: Known) -> int:
    """Files of the Gaussians, and a picture."""
    own = known.settings["splats"]
    if own.make == "off":
        return 0
    count = most_gaussians(own, pixels_of(asset_of(known), own, (known.run / "poses", known.run / "train")))
    return SHEET + (WRITTEN_FLOAT * (3 + parameters_of(own)) + SPZ) * count  # with a normal
