"""A mesh against the true one: accuracy, completeness, F-scores, normals, silhouettes and depth.

    python -m benchmarks.surface RUN [--mesh FILE] [--scene KIND | --truth FILE.ply] [--cameras FILE.json] [--out RESULTS.json]

RUN's mesh (or FILE, in the capture's frame) against a true mesh in the frame of the true cameras. Without --truth and --scene these are the still life's.
--scene KIND takes a made scene's (`benchmarks.scenes`), whose capture's frame is that of its shapes. Frames are aligned by the camera centres (a similarity,
Umeyama 1991), never by the surfaces. Both surfaces are sampled evenly by area. Samples count where they are inside the asset's region, and where at least VIEWS
of the training cameras see them on their own mesh: nothing is known of the rest. Distances are from sample to surface, in units of the true frame; one of them
is the footprint of a pixel: the median over the cameras of the distance of the truth's middle over the focal length.

--out adds the run to a file of results by name.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from benchmarks.poses import TRUTH
from efficientnerf.geometry.cameras import Camera, Similarity, closest_similarity, pose_from_opengl, project
from efficientnerf.surface.mesh import face_vectors, sample
from efficientnerf.surface.rasteriser import mesh_image
from tests.still_life import true_mesh

SAMPLES = 200_000  # of each surface
DISTANCES = (0.005, 0.01, 0.02)
VIEWS = 2  # that have to see a sample
SLACK = 0.01  # of its depth, by which a sample may lie behind what a camera sees
CANDIDATES = 6  # faces that may be the nearest to a point
AT_ONCE = 50_000


@dataclass(frozen=True, eq=False)
class Surface:
    """Vertices (V, 3) and faces (F, 3)."""

    vertices: np.ndarray
    faces: np.ndarray


@dataclass(frozen=True)
class Scores:
    """accuracy       mean distance of the mesh from the truth
    completeness   mean distance of the truth from the mesh
    f              distance -> harmonic mean of the shares of both that are nearer than that
    precision, recall  the two shares
    normals        mean angle between normals, degrees, of samples of the truth with a surface within the greatest distance; sides do not matter
    near           share of the truth's samples that these are
    """

    accuracy: float
    completeness: float
    f: dict[float, float]
    precision: dict[float, float]
    recall: dict[float, float]
    normals: float
    near: float


def seen(surface: Surface, points: np.ndarray, cameras: Sequence[Camera]) -> np.ndarray:
    """(N,) by how many cameras points on a surface are seen."""
    count = np.zeros(len(points), np.int64)
    for camera in cameras:
        image = mesh_image(surface.vertices, surface.faces, camera)
        pixels, depth = project(camera, points)
        inside = np.isfinite(pixels).all(1) & (depth > 0) & ((pixels >= 0) & (pixels < [camera.width, camera.height])).all(1)
        column, row = np.floor(pixels[inside]).astype(np.int64).T
        count[np.flatnonzero(inside)[depth[inside] <= image.depth[row, column] * (1 + SLACK)]] += 1
    return count


def distances(points: np.ndarray, surface: Surface, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """(N,) distances of points from a surface, and the nearest faces (N,); exact but where the nearest face is none of the CANDIDATES with the nearest samples.
    Each face has a sample, and all of them `samples` more, evenly by area."""
    owner, weight = sample(surface.vertices, surface.faces, samples, seed=1)
    spread = (surface.vertices[surface.faces[owner]] * weight[..., None]).sum(1)
    tree = cKDTree(np.concatenate([spread, surface.vertices[surface.faces].mean(1)]))
    owner = np.concatenate([owner, np.arange(len(surface.faces))])
    distance, face = np.empty(len(points)), np.empty(len(points), np.int64)
    for begin in range(0, len(points), AT_ONCE):
        part = points[begin : begin + AT_ONCE]
        _, index = tree.query(part, CANDIDATES)
        candidates = owner[index]  # (N, CANDIDATES)
        corners = surface.vertices[surface.faces[candidates.ravel()]]
        place = trimesh.triangles.closest_point(corners, np.repeat(part, CANDIDATES, 0)).reshape(-1, CANDIDATES, 3)
        away = np.linalg.norm(place - part[:, None], axis=2)
        best = away.argmin(1)
        distance[begin : begin + len(part)] = away[np.arange(len(part)), best]
        face[begin : begin + len(part)] = candidates[np.arange(len(part)), best]
    return distance, face


def scores(
    found: Surface, truth: Surface, cameras: Sequence[Camera], limits: Sequence[float] = DISTANCES, region: Any = None, samples: int = SAMPLES
) -> Scores:
    """How near a surface is to the true one.

    cameras  in the frame of both
    region   points (N, 3) -> (N,) bool, whether they count; None: all
    """
    chosen = []
    for surface in (found, truth):
        face, weight = sample(surface.vertices, surface.faces, samples, seed=0)
        points = (surface.vertices[surface.faces[face]] * weight[..., None]).sum(1)
        kept = seen(surface, points, cameras) >= VIEWS
        if region is not None:
            kept &= region(points)
        chosen.append((points[kept], face[kept]))
    (points, _), (true_points, true_face) = chosen
    away, _ = distances(points, truth, 2 * samples)
    missing, nearest = distances(true_points, found, 2 * samples)
    near = missing <= max(limits)
    a, b = (face_vectors(surface.vertices, surface.faces[face]) for surface, face in ((found, nearest[near]), (truth, true_face[near])))
    cosine = np.abs((a * b).sum(1)) / np.maximum(np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1), 1e-300)
    precision = {limit: float((away <= limit).mean()) for limit in limits}
    recall = {limit: float((missing <= limit).mean()) for limit in limits}
    f = {limit: 2 * precision[limit] * recall[limit] / max(precision[limit] + recall[limit], 1e-12) for limit in limits}
    angle = float(np.degrees(np.arccos(np.clip(cosine, 0, 1))).mean()) if near.any() else 90.0
    return Scores(float(away.mean()), float(missing.mean()), f, precision, recall, angle, float(near.mean()))


def image_scores(found: Surface, truth: Surface, cameras: Sequence[Camera], region: Any = None) -> dict[str, float]:
    """Silhouettes and depth of a surface against those of the true one, of all cameras' pixels together; of faces whose middles are in the region.

    iou     intersection of the silhouettes over their union
    missed  share of the truth's pixels that the surface does not cover; added: share of the surface's beyond the truth
    depth   median difference of depths where both are
    """
    if region is not None:
        found, truth = (Surface(each.vertices, each.faces[region(each.vertices[each.faces].mean(1))]) for each in (found, truth))
    both = either = true = own = 0
    errors = []
    for camera in cameras:
        one, other = (mesh_image(surface.vertices, surface.faces, camera) for surface in (found, truth))
        common = one.covered & other.covered
        both, either = both + int(common.sum()), either + int((one.covered | other.covered).sum())
        own, true = own + int(one.covered.sum()), true + int(other.covered.sum())
        errors.append(np.abs(one.depth[common] - other.depth[common]))
    depth = float(np.median(np.concatenate(errors))) if both else float("inf")
    return {"iou": both / max(either, 1), "missed": (true - both) / max(true, 1), "added": (own - both) / max(own, 1), "depth": depth}


def true_cameras(path: Path) -> dict[str, Camera]:
    """The cameras of a transforms.json, by the names of their images."""
    data = json.loads(path.read_text())
    model, params = (
        ("SIMPLE_RADIAL", (data["fl_x"], data["cx"], data["cy"], data["k1"])) if "k1" in data else ("SIMPLE_PINHOLE", (data["fl_x"], data["cx"], data["cy"]))
    )
    out = {}
    for frame in data["frames"]:
        name = frame["file_path"]
        out[Path(name).name] = Camera(name, data["w"], data["h"], model, params, pose_from_opengl(np.array(frame["transform_matrix"])))
    return out


def truth_from_capture(run: Path, cameras: dict[str, Camera]) -> tuple[Similarity, list[Camera]]:
    """The frame of the true cameras from that of a run's capture; and the true cameras that it was trained on."""
    from stages.artifacts import PosesOutputs
    from stages.io.scene import load, views_of

    scene = load(PosesOutputs.of_run(run).folder)
    stated = {Path(view.source_camera.name).name: view.source_camera.centre for view in scene.views}
    known = [name for name in stated if name in cameras]
    similarity = closest_similarity(*(np.array(centres) for centres in ([stated[name] for name in known], [cameras[name].centre for name in known])))
    trained = [Path(view.source_camera.name).name for view in views_of(scene, "train")]
    return similarity, [cameras[name] for name in trained if name in cameras]


def region_of(run: Path, truth_from_capture: Similarity) -> Any:
    """Points of the true frame -> whether they lie in the foreground region of a run's asset, without its fading band; in its box where it has no region."""
    from efficientnerf.asset.camera_paths import similarity_of
    from efficientnerf.asset.format import load
    from efficientnerf.asset.region import inside_distance
    from stages.artifacts import BakeOutputs

    tree = load(BakeOutputs.of_run(run).asset)
    low, high = np.asarray(tree.bounds_min), np.asarray(tree.bounds_max)
    world_from_truth = truth_from_capture.inverse()

    def inside(points: np.ndarray) -> np.ndarray:
        at = similarity_of(tree).points(world_from_truth.points(points))
        if tree.region is not None:
            return inside_distance(tree.region, at) > tree.region.fade
        return np.asarray(((at >= low) & (at <= high)).all(1))

    return inside


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--mesh", type=Path, help="default: RUN/mesh/mesh.ply")
    parser.add_argument("--scene", help="kind of a made scene")
    parser.add_argument("--truth", type=Path, help="default: that of the still life")
    parser.add_argument("--cameras", type=Path, default=TRUTH)
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    result = measured(given.run, given.mesh or given.run / "mesh" / "mesh.ply", given.scene, given.truth, given.cameras)
    print(json.dumps(result, indent=1))
    if given.out:
        known = json.loads(given.out.read_text()) if given.out.is_file() else {}
        given.out.write_text(json.dumps(known | {given.run.resolve().name: result}, indent=1) + "\n")


def footprint(cameras: Sequence[Camera], middle: np.ndarray) -> float:
    """How wide a pixel is at a place (3,): the median over cameras of its distance over the focal length."""
    return float(np.median([np.linalg.norm(camera.centre - middle) / camera.intrinsics["fx"] for camera in cameras]))


def measured(run: Path, mesh: Path, kind: str | None, truth: Path | None, cameras: Path) -> dict[str, Any]:
    """All figures of a run's mesh."""
    if kind is not None:
        from benchmarks.scenes.catalogue import recipes
        from benchmarks.scenes.triangles import mesh_of

        true = mesh_of(recipes()[kind].shapes)
    else:
        true = true_mesh() if truth is None else trimesh.load(truth, process=False)
    similarity, trained = truth_from_capture(run, true_cameras(cameras))
    loaded = trimesh.load(mesh, process=False)
    found = Surface(similarity.points(np.asarray(loaded.vertices)), np.asarray(loaded.faces))
    real = Surface(np.asarray(true.vertices, np.float64), np.asarray(true.faces))
    region = region_of(run, similarity)
    pixel = round(footprint(trained, (real.vertices.min(0) + real.vertices.max(0)) / 2), 4)
    figures = scores(found, real, trained, sorted({*DISTANCES, pixel}), region)
    return {"faces": len(found.faces), "pixel": pixel, **asdict(figures), "images": image_scores(found, real, trained, region)}


if __name__ == "__main__":
    main()
