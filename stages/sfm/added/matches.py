"""Matches by networks added to those of SIFT: features of photographs without a camera, and of those that they are compared with."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.files import SafePoint
from stages.cores import in_order
from stages.io.png import read_png
from stages.sfm.added.networks import MIN_MATCHES, Detector, Features, Matcher
from stages.sfm.colmap import quiet_pycolmap
from stages.sfm.database import FEATURES, PAIRS, WorkImage, database_path, forget, images_of, pair_id_of
from stages.sfm.images import Progress
from stages.sfm.pairs import Pair, ordered

MAX_FEATURES = 2048  # features of a photograph: what LightGlue takes grows with their square
NEIGHBOURS = 4  # photographs with a camera that each of them is compared with, too: its features get points by these
MAX_AT_ONCE = 2  # pictures, or pairs, that are worked on: each takes up to 2.3 GiB (`stages.poses.memory`)


def pairs_of(weak: Sequence[int], partners: Sequence[Pair], overlaps: Mapping[tuple[int, int], int]) -> list[Pair]:
    """The pairs to compare, in order: those of photographs without a camera, and of each other photograph in these with those that it overlaps with most.

    weak      positions of photographs without a camera
    partners  pairs of them with others
    overlaps  verified matches by COLMAP's image ids, which are positions from 1 on
    """
    wanted = {ordered(i, j) for i, j in partners}
    others = {i for pair in wanted for i in pair} - set(weak)
    nearest: dict[int, list[tuple[int, int]]] = {i: [] for i in others}
    for (i, j), count in overlaps.items():
        if count and {i - 1, j - 1} <= others:
            nearest[i - 1].append((-count, j - 1))
            nearest[j - 1].append((-count, i - 1))
    return sorted(wanted | {ordered(i, j) for i, near in nearest.items() for _, j in sorted(near)[:NEIGHBOURS]})


def add_matches(
    place: Path, images: Sequence[WorkImage], pairs: Sequence[Pair], networks: tuple[Path, Path], *, seed: int, threads: int, progress: Progress,
    safe_point: SafePoint,
) -> None:
    """Append a detector's features to those in the database of a scratch folder, and the matches of these pairs to theirs; all are verified together.

    networks  the files of a detector and a matcher
    threads   on which pictures are worked on; nothing depends on them
    """
    detector, matcher = Detector(networks[0]), Matcher(networks[1])
    used, at_once = sorted({i for pair in pairs for i in pair}), max(1, min(threads, MAX_AT_ONCE))

    def detect(position: int) -> Features:
        folder, file = images_of(place).parent, images[position].file
        mask = folder / "masks" / f"{file}.png"
        return detector.features(read_png(folder / "images" / file), read_png(mask) if mask.exists() else None, MAX_FEATURES)

    found: dict[int, Features] = {}
    for position, each in zip(used, in_order(detect, used, at_once, safe_point), strict=True):
        found[position] = each
        progress(len(found), len(used), "detecting features by a network")
    with quiet_pycolmap() as pycolmap, pycolmap.Database.open(database_path(place)) as database:
        ids = {image.name: image for image in database.read_all_images()}
        of = {position: ids[images[position].file] for position in used}
        before = {position: np.asarray(database.read_keypoints(of[position].image_id), np.float32) for position in used}
        known = {pair: np.asarray(database.read_matches(*(of[i].image_id for i in pair)), np.uint32).reshape(-1, 2) for pair in pairs}
        lenses = {position: database.read_camera(of[position].camera_id) for position in used}
    forget(place, FEATURES, [of[position].image_id for position in used])
    forget(place, PAIRS, [pair_id_of(*(of[i].image_id for i in pair)) for pair in pairs])
    every = {position: appended(before[position], found[position].xy) for position in used}
    matched = in_order(lambda pair: matcher.matches(found[pair[0]], found[pair[1]]), pairs, at_once, safe_point)
    with quiet_pycolmap() as pycolmap, pycolmap.Database.open(database_path(place)) as database:
        for position in used:
            database.write_keypoints(of[position].image_id, every[position])
        for done, ((i, j), new) in enumerate(zip(pairs, matched, strict=True)):
            both = np.concatenate([known[i, j], new + np.array((len(before[i]), len(before[j])), np.uint32)]).astype(np.uint32)
            database.write_matches(of[i].image_id, of[j].image_id, both)
            database.write_two_view_geometry(of[i].image_id, of[j].image_id, two_views(pycolmap, (i, j), lenses, every, both, seed))
            progress(done + 1, len(pairs), "matching pairs by a network")


def two_views(pycolmap: Any, pair: Pair, lenses: Mapping[int, Any], keypoints: Mapping[int, np.ndarray], matches: np.ndarray, seed: int) -> Any:
    """COLMAP's geometry of a pair by these matches; without any where they are too few."""
    if len(matches) < MIN_MATCHES:
        return pycolmap.TwoViewGeometry()
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = seed
    (one, a), (other, b) = ((lenses[k], keypoints[k][:, :2].astype(np.float64)) for k in pair)
    return pycolmap.estimate_two_view_geometry(one, a, other, b, matches, options)


def appended(keypoints: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """(N + M, K) key points of a database, and others of no size and direction."""
    columns = keypoints.shape[1] if keypoints.ndim == 2 and len(keypoints) else 2
    more = np.zeros((len(xy), columns), np.float32)
    more[:, :2] = xy
    if columns == 6:  # x, y and an affine shape
        more[:, [2, 5]] = 1
    return np.concatenate([keypoints.reshape(-1, columns), more]).astype(np.float32)
