"""Corners of markers as features whose matches are known, by the numbers of the markers.

They are added to a copy of COLMAP's database, which the mapper reads. SIFT's own matches on a marker that both photographs see are left out: cells of a board
look alike, and on a bare table nothing else tells where it is. docs/experiments/true-size.md
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np

from pipeline.files import SafePoint, remove, write_atomically
from stages.io.capture import Markers
from stages.io.png import read_png
from stages.sfm.added.matches import appended, two_views
from stages.sfm.colmap import quiet_pycolmap
from stages.sfm.database import PAIRS, TIED, WorkImage, copy_database, database_path, forget, images_of, inlier_counts, pair_id_of

FILE = "markers.json"  # in the scratch folder
GRID = 3  # points along an edge: the corners, and as many between them as let a few markers outweigh what SIFT finds on a bare table
ROUND = 1.2  # times a marker's size, within which features are on it


def keep_markers(work: Path, images: Sequence[WorkImage], markers: Markers) -> None:
    """Note the corners, at the size of the copies, of those that no mask leaves out."""
    remove(work / FILE)
    remove(work / TIED)
    kept: dict[str, dict[int, list[list[float]]]] = {}
    for image in images:
        mask_path = work / "masks" / f"{image.file}.png"
        mask = read_png(mask_path) if mask_path.exists() else None
        for number, corners in markers.get(image.name, {}).items():
            at = _grid(corners * [image.work_width / image.width, image.work_height / image.height])
            x, y = np.clip(at.astype(int), 0, [image.work_width - 1, image.work_height - 1]).T
            if mask is None or mask[y, x].all():
                kept.setdefault(image.file, {})[number] = at.tolist()
    if kept:
        write_atomically(work / FILE, json.dumps(kept).encode(), durable=False)


def tie_markers(work: Path, seed: int, safe_point: SafePoint) -> None:
    """Make the copy of a scratch folder's database with the corners that were noted, where any were."""
    note, place = images_of(work).parent / FILE, work / TIED
    if not note.exists():
        return
    noted = {file: {int(number): np.array(at) for number, at in seen.items()} for file, seen in json.loads(note.read_bytes()).items()}
    place.mkdir(exist_ok=True)
    copy_database(work, place)
    with quiet_pycolmap() as pycolmap:
        with pycolmap.Database.open(database_path(place)) as database:
            images = {image.image_id: image for image in database.read_all_images()}
            seen: dict[int, Mapping[int, np.ndarray]] = {number: noted.get(image.name, {}) for number, image in images.items()}
            before = {image: np.asarray(database.read_keypoints(image), np.float32) for image in images}
            pairs = [pair for pair in inlier_counts(database_path(place)) if seen[pair[0]].keys() & seen[pair[1]].keys()]
            inliers = {pair: np.asarray(database.read_two_view_geometry(*pair).inlier_matches, np.uint32).reshape(-1, 2) for pair in pairs}
            lenses = {image: database.read_camera(images[image].camera_id) for image in images}
            every = {image: appended(before[image], np.concatenate([*seen[image].values()])) for image in images if seen[image]}
            for image, keypoints in every.items():
                database.update_keypoints(image, keypoints)
        forget(place, PAIRS[1:], [pair_id_of(*pair) for pair in pairs])
        with pycolmap.Database.open(database_path(place)) as database:
            for i, j in pairs:
                safe_point()
                common = sorted(seen[i].keys() & seen[j].keys())
                on = [_on([seen[k][number] for number in common], before[k])[inliers[i, j][:, side]] for side, k in enumerate((i, j))]
                first = [len(before[k]) + GRID**2 * np.array([[*seen[k]].index(number) for number in common]) for k in (i, j)]
                ties = (np.stack(first, 1)[:, None] + np.arange(GRID**2)[:, None]).reshape(-1, 2)
                both = np.concatenate([inliers[i, j][~(on[0] | on[1])], ties]).astype(np.uint32)
                database.write_two_view_geometry(i, j, two_views(pycolmap, (i, j), lenses, every, both, seed))


def _grid(corners: np.ndarray) -> np.ndarray:
    """(GRID * GRID, 2) points of a marker, by its corners (4, 2), clockwise."""
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    steps = np.stack(np.meshgrid(*2 * [np.linspace(0, 1, GRID)]), -1).reshape(1, -1, 2)
    return np.asarray(cv2.perspectiveTransform(steps, cv2.findHomography(square, corners)[0]))[0]


def _on(markers: Sequence[np.ndarray], keypoints: np.ndarray) -> np.ndarray:
    """(N,) whether keypoints (N, K) lie on one of the markers, or right round it."""
    quads = np.stack(markers)[:, [0, GRID - 1, -1, -GRID]]  # (M, 4, 2)
    quads = quads.mean(1, keepdims=True) + ROUND * (quads - quads.mean(1, keepdims=True))
    edge, to = np.roll(quads, -1, 1) - quads, keypoints[:, None, None, :2] - quads  # (N, M, 4, 2)
    side = edge[..., 0] * to[..., 1] - edge[..., 1] * to[..., 0]
    return np.asarray((side > 0).all(2).any(1))  # clockwise, y down
