"""A mesh against DTU's scan: accuracy, completeness and their mean, in millimetres, as Jensen et al. 2014 and the papers after IDR measure.

    python -m benchmarks.dtu RUN --truth FOLDER --scan N [--mesh FILE] [--whole] [--out RESULTS.json]

RUN is of a copy of the scan with its own cameras in millimetres: as IDR prepared it (`cameras_sphere.npz`, `image/`, `mask/`), or MVSNet (`Cameras/`,
`Rectified/`). FOLDER is DTU's: `Points/stl/stl024_total.ply`, and `ObsMask/ObsMask24_10.mat` and `Plane24.mat` of its sample set; --scan 24.

Faces with a vertex that some training photograph shows outside of its mask, by more than MARGIN pixels, are left out first, where the run has masks; --whole
keeps them. The mesh is sampled evenly, no two points nearer than SPACING. accuracy: mean distance of these to the scan's points, of those in the observed
part of space; completeness: that of the scan's points above the table to the mesh's. Distances of FARTHEST and more do not count.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
import trimesh
from scipy.io import loadmat
from scipy.spatial import cKDTree

from efficientnerf.geometry.cameras import Camera, project
from efficientnerf.surface.mesh import face_areas, sample

SPACING = 0.2  # mm, of points
FARTHEST = 20.0  # mm
AROUND = 60.0  # mm, by which the box of the observed part is larger, and twice as much on its upper sides
MARGIN = 24  # pixels of a photograph of 1600, by which masks are dilated
PER_SPACING = 2  # samples in a square of SPACING, of which about every fourth stays
AT_ONCE = 50_000  # points whose neighbours are known at a time


@dataclass(frozen=True, eq=False)
class Observed:
    """What DTU's scanner and cameras saw.

    mask    (X, Y, Z) bool; low, high (3,) its box, mm; step mm between its cells
    plane   (4,) of the table: points (x, y, z, 1) above it have a positive product
    points  (N, 3) of the scan
    """

    mask: np.ndarray
    low: np.ndarray
    high: np.ndarray
    step: float
    plane: np.ndarray
    points: np.ndarray


@dataclass(frozen=True)
class Distances:
    """Millimetres."""

    accuracy: float
    completeness: float
    chamfer: float  # mean of the two


def observed(folder: Path, scan: int) -> Observed:
    """DTU's files of a scan; FileNotFoundError where one is missing."""
    mask, plane = (loadmat(str(folder / "ObsMask" / name)) for name in (f"ObsMask{scan}_10.mat", f"Plane{scan}.mat"))
    points = np.asarray(trimesh.load(folder / "Points" / "stl" / f"stl{scan:03d}_total.ply").vertices)
    low, high = np.asarray(mask["BB"], np.float64)
    return Observed(np.asarray(mask["ObsMask"], bool), low, high, float(np.squeeze(mask["Res"])), np.asarray(plane["P"], np.float64).reshape(4), points)


def thinned(points: np.ndarray, spacing: float) -> np.ndarray:
    """Points in a drawn order, each that is no nearer than `spacing` to one kept before it."""
    points = points[np.random.default_rng(0).permutation(len(points))]
    tree, kept = cKDTree(points), np.ones(len(points), bool)
    for begin in range(0, len(points), AT_ONCE):
        for number, near in enumerate(tree.query_ball_point(points[begin : begin + AT_ONCE], spacing), begin):
            if kept[number]:
                kept[near] = False
                kept[number] = True
    return points[kept]


def distances(vertices: np.ndarray, faces: np.ndarray, truth: Observed) -> Distances:
    """Of a mesh, in millimetres; infinite where nothing of it lies in the observed box."""
    count = int(np.ceil(PER_SPACING * face_areas(vertices, faces).sum() / SPACING**2))
    face, weight = sample(vertices, faces, count, seed=0)
    points = np.einsum("nk,nkc->nc", weight, vertices[faces[face]])
    points = thinned(points[((points >= truth.low - AROUND) & (points < truth.high + 2 * AROUND)).all(1)], SPACING)
    cell = np.round((points - truth.low) / truth.step).astype(np.int64)
    inside = ((cell >= 0) & (cell < truth.mask.shape)).all(1)
    inside[inside] = truth.mask[tuple(cell[inside].T)]
    above = truth.points[truth.points @ truth.plane[:3] + truth.plane[3] > 0]
    accuracy, completeness = _mean(points[inside], truth.points), _mean(above, points)
    return Distances(accuracy, completeness, (accuracy + completeness) / 2)


def _mean(points: np.ndarray, others: np.ndarray) -> float:
    """Mean distance to the nearest of others, of those nearer than FARTHEST."""
    if not len(points) or not len(others):
        return float("inf")
    found = cKDTree(others).query(points, distance_upper_bound=FARTHEST)[0]
    near = np.isfinite(found)
    return float(found[near].mean()) if near.any() else float("inf")


def in_masks(vertices: np.ndarray, faces: np.ndarray, cameras: Sequence[Camera], masks: Sequence[np.ndarray]) -> np.ndarray:
    """The faces (F, 3) of which no vertex is shown outside of a dilated mask.

    cameras  in the mesh's frame
    masks    (H, W) bool of each, of any size
    """
    kept = np.ones(len(vertices), bool)
    for camera, mask in zip(cameras, masks, strict=True):
        reach = round(MARGIN * mask.shape[1] / 1600)
        disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
        wide = cv2.dilate(mask.astype(np.uint8), disk).astype(bool)
        pixels, depth = project(camera, vertices)
        pixels = pixels * [mask.shape[1] / camera.width, mask.shape[0] / camera.height]
        shown = np.isfinite(pixels).all(1) & (depth > 0) & ((pixels >= 0) & (pixels < [mask.shape[1], mask.shape[0]])).all(1)
        column, row = np.floor(pixels[shown]).astype(np.int64).T
        kept[np.flatnonzero(shown)[~wide[row, column]]] = False
    return np.asarray(faces[kept[faces].all(1)])


def masks_of(run: Path) -> tuple[list[Camera], list[np.ndarray]]:
    """The cameras and masks of a run's training photographs, as far as there are masks; cameras in the capture's frame."""
    from stages.artifacts import PosesOutputs
    from stages.io.scene import load, views_of
    from stages.splats.pictures import photographs

    folder = PosesOutputs.of_run(run).folder
    scene = load(folder)
    cameras, masks = [], []
    for view, picture in zip(views_of(scene, "train"), photographs(folder, scene, run / "train"), strict=True):
        mask = picture.pixels[..., 3] >= 128 if picture.pixels.shape[2] == 4 else picture.mask
        if mask is not None:
            cameras.append(view.source_camera)
            masks.append(mask)
    return cameras, masks


def measured(run: Path, truth: Path, scan: int, mesh: Path | None = None, *, whole: bool = False) -> dict[str, float]:
    """All figures of a run's mesh."""
    loaded = trimesh.load(mesh or run / "mesh" / "mesh.ply", process=False)
    vertices, faces = np.asarray(loaded.vertices, np.float64), np.asarray(loaded.faces)
    kept = faces if whole else in_masks(vertices, faces, *masks_of(run))
    return {"scan": scan, **asdict(distances(vertices, kept, observed(truth, scan))), "faces": len(kept), "left_out": len(faces) - len(kept)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--truth", type=Path, required=True)
    parser.add_argument("--scan", type=int, required=True)
    parser.add_argument("--mesh", type=Path, help="in the capture's frame; default: RUN/mesh/mesh.ply")
    parser.add_argument("--whole", action="store_true")
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    result = measured(given.run, given.truth, given.scan, given.mesh, whole=given.whole)
    print(json.dumps(result, indent=1))
    if given.out:
        known = json.loads(given.out.read_text()) if given.out.is_file() else {}
        given.out.write_text(json.dumps(known | {given.run.resolve().name: result}, indent=1) + "\n")


if __name__ == "__main__":
    main()
