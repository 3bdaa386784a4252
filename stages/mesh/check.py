"""The check of a mesh against the asset that it was made of: from captured cameras and from a turntable's."""

from collections.abc import Callable, Iterator
from dataclasses import asdict
from typing import Any

import numpy as np

from efficientnerf.asset.camera_paths import turntable_cameras
from efficientnerf.asset.captured import captured_of
from efficientnerf.asset.tree import NerfTree
from efficientnerf.geometry.cameras import Camera
from efficientnerf.surface.agreement import AssetView, agreement, asset_view, differences, shown_pixels
from efficientnerf.surface.isosurface import automatic_threshold
from efficientnerf.surface.level import silhouette_level
from efficientnerf.surface.mesh import Mesh
from efficientnerf.surface.rasteriser import mesh_image
from efficientnerf.surface.volume import volume_of
from stages.figures.shading import difference_row

CAPTURED, ORBIT = 12, 12  # cameras
FUSED = 24  # further cameras, whose depths are fused too
LONGER_SIDE, PIXELS_PER_VOXEL = 400, 2  # of the images, pixels, at most; and for each voxel along the longest side
WARNED = 0.03  # share of pixels missed or added, from which the stage says so
PICTURED = 3  # views in the picture: those that agree least


def check_cameras(tree: NerfTree) -> tuple[list[Camera], list[Camera]]:
    """The cameras of the check: some of the captured ones, where the asset keeps any, and a turntable's. And others, whose depths are fused too: captured ones,
    or of a turntable between those."""
    captured, longer = captured_of(tree.metadata), min(LONGER_SIDE, PIXELS_PER_VOXEL * max(tree.resolution))
    if captured is None:
        few, many = (turntable_cameras(tree, frames=count, width=longer, height=max(1, 3 * longer // 4)) for count in (ORBIT, 2 * ORBIT))
        return few, many[1::2]
    cameras = captured.cameras(longer / max(captured.width, captured.height))
    chosen = np.unique(np.linspace(0, len(cameras) - 1, CAPTURED).round().astype(int))
    left = np.setdiff1d(np.arange(len(cameras)), chosen)
    others = left[np.unique(np.linspace(0, len(left) - 1, min(FUSED, len(left))).round().astype(int))]
    orbit = turntable_cameras(tree, frames=ORBIT, width=cameras[0].width, height=cameras[0].height)
    return [cameras[n] for n in chosen] + orbit, [cameras[n] for n in others]


def asset_views(tree: NerfTree, progress: Callable[[int, int, str], None]) -> tuple[list[AssetView], list[AssetView]]:
    """What the cameras of the check see of the asset; and these with others, whose depths are fused."""
    checking, others = check_cameras(tree)
    cameras, out = [*checking, *others], []
    for number, camera in enumerate(cameras):
        out.append(asset_view(tree, camera))
        progress(number + 1, len(cameras), "views of the asset")
    return out[: len(checking)], out


def checked(mesh: Mesh, views: list[AssetView], tick: Callable[[], None]) -> tuple[dict[str, Any], np.ndarray]:
    """How a mesh of the training frame agrees with the asset, for its report, and a picture (H, W, 3) uint8. `tick` is called after each view."""
    images = []
    for view in views:
        images.append(mesh_image(mesh.vertices, mesh.faces, view.camera))
        tick()
    wrong = [sum(int(part.sum()) for part in differences(view, image)) for view, image in zip(views, images, strict=True)]
    worst = np.argsort(-np.array(wrong), kind="stable")[:PICTURED]
    picture = np.concatenate([difference_row(mesh, views[n], images[n]) for n in worst])
    found = {name: float(f"{value:.4g}") for name, value in asdict(agreement(views, images)).items()}
    return {"silhouette_iou": found["iou"], "pixels_missed": found["missed"], "pixels_added": found["added"], "depth_difference": found["depth"],
            "views_checked": len(views)}, picture  # fmt: skip


def warning_of(report: dict[str, Any]) -> str | None:
    """The warning, if any."""
    if max(report["pixels_missed"], report["pixels_added"]) <= WARNED:
        return None
    shares = f"{100 * report['pixels_missed']:.1f} % of what the asset shows is missing from the mesh, {100 * report['pixels_added']:.1f} % of the mesh is"
    return f"{shares} beyond it (check.png). Raise mesh.max_faces, or set mesh.density_threshold by hand."


def shown_by(views: list[AssetView], voxel: float, tick: Callable[[], None]) -> Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]:
    """(vertices, faces, component of each face) -> how much of each component the views show; see `efficientnerf.surface.agreement.shown_pixels`. `tick` is
    called before each view; what it raises stops the work."""
    def ticking() -> Iterator[AssetView]:
        for view in views:
            tick()
            yield view

    return lambda vertices, faces, component: shown_pixels(vertices, faces, component, ticking(), voxel)


def level_of(tree: NerfTree, threshold: float | None, views: list[AssetView], tick: Callable[[], None]) -> float | None:
    """The density of the surface: what is given, else that which has the asset's silhouettes; None for nested grids, each of which has its own. Raises
    NoSurface."""
    if threshold is not None or tree.outer:
        return threshold
    return silhouette_level(tree, views[::2], automatic_threshold(volume_of(tree)), tick)
