"""Write docs/still_life_viewer.html, the viewer's page of the example: a small asset of its subject, fitted to the photographs at that size.

    make viewer-page
    python docs/make_viewer_page.py RUN     # a run of examples/still_life with bake.resolution=RESOLUTION
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from efficientnerf.asset.captured import captured_of
from efficientnerf.asset.cascades import subset
from efficientnerf.asset.format import load, serialize
from efficientnerf.asset.region import voxel_centres
from efficientnerf.asset.tree import NerfTree
from efficientnerf.geometry.cameras import Camera
from efficientnerf.rendering.harmonics import C0, basis_numpy
from efficientnerf.splats.merging import greatest_weights
from pipeline.files import write_atomically
from stages.artifacts import BakeOutputs
from stages.framing.restriction import restricted
from stages.viewer.page import viewer_page

TARGET = Path(__file__).parent / "still_life_viewer.html"
RESOLUTION = 112  # voxels along the longest side
REGION = "foreground"
LEAST_WEIGHT = 0.1  # of a voxel in the pixel that shows it most
MOST_BYTES = 400_000


def small(tree: NerfTree) -> NerfTree:
    """What the page shows of the run's asset."""
    if max(tree.resolution) > RESOLUTION + tree.brick:
        raise SystemExit(f"an asset of {max(tree.resolution)} voxels along its longest side; expected {RESOLUTION}: --set bake.resolution={RESOLUTION}")
    captured = captured_of(tree.metadata)
    if captured is None:
        raise SystemExit("an asset without its captured cameras")
    lens = (captured.focal, captured.focal, captured.width / 2, captured.height / 2)
    cameras = [Camera(str(n), int(captured.width), int(captured.height), "PINHOLE", lens, pose) for n, pose in enumerate(captured.poses)]
    made = of_one_colour_each(restricted(tree, REGION), cameras)
    settings = {"bake.resolution": RESOLUTION, "region": REGION, "sh_degree": 0}
    return replace(made, background=(1.0, 1.0, 1.0)).with_metadata(provenance={**tree.metadata["provenance"], "settings": settings}, captured_path=None)


def of_one_colour_each(tree: NerfTree, cameras: Sequence[Camera]) -> NerfTree:
    """The voxels that show in some camera, each of the mean colour that cameras see of it. (The first harmonic alone is the mean over all directions, also
    over those from which there is no photograph, and pale.)"""
    centres = voxel_centres(tree)
    colour, total, greatest = np.zeros((len(centres), 3)), np.full(len(centres), 1e-9), np.zeros(len(centres))
    for camera in cameras:
        weight = greatest_weights(tree, [camera], camera.width * camera.height).astype(np.float64)
        towards = centres - camera.centre
        values = basis_numpy(towards / np.linalg.norm(towards, axis=1, keepdims=True), tree.degree)  # (N, K)
        colour += weight[:, None] / (1 + np.exp(-np.einsum("nk,nkc->nc", values, tree.coefficients(slice(None)))))
        total += weight
        greatest = np.maximum(greatest, weight)
    colour = np.clip(colour / total[:, None], 0.002, 0.998)
    one = replace(tree, harmonics=(np.log(colour / (1 - colour)) / C0).astype(np.float32)[:, None])
    return subset(one, greatest > LEAST_WEIGHT)


def main() -> None:
    page = viewer_page(serialize(small(load(BakeOutputs.of_run(Path(sys.argv[1])).asset)), "compact"), title="Still life")
    if len(page) > MOST_BYTES:
        raise SystemExit(f"{TARGET}: {len(page):,} bytes, more than {MOST_BYTES:,}")
    write_atomically(TARGET, page)
    print(f"{TARGET}: {len(page):,} bytes")


if __name__ == "__main__":
    main()
