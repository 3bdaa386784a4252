"""Parts that move between photographs while most of the scene stands still: people, cars, a pet, a shadow.

Three kinds of matches contradict the cameras. Wrong ones lie anywhere. Repeated texture joins a place to its twin, which in a third photograph is joined to
itself again. Moving parts are found again by one motion of their own: a similarity takes a patch of features to the other photograph, and on to a third one,
and hardly any match of these features agrees with the cameras. Only the last is reported, unless more features inside of a part's outline stand still than
move: a carpet or knitted cloth, whose pattern is matched with itself a stitch away in some pairs and rightly in others. docs/experiments/sfm.md

Two kinds are not seen: parts that are gone in other photographs have no matches, and motion along epipolar lines alone contradicts nothing.
"""

from collections.abc import Iterable, Mapping

import cv2
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from efficientnerf.geometry.cameras import Camera, epipolar_error, rays

NEAR, FAR = 4.0, 8.0  # px from epipolar lines: matches that agree with the cameras, and that contradict them
NEIGHBOURHOOD = 0.1  # of the longest side: between the two matches that tell a motion, at least a quarter of it; of the others up to three times as far
NEIGHBOURS = 4  # matches that each is taken with
TOLERANCE = 0.015  # of the longest side, from where the motion takes a feature
LARGER = 2.0  # times as large or as small, at most
MOTIONS, MOST = 3, 400  # of a pair; matches that are looked at
OF_A_MOTION, OF_A_PART = 8, 15  # features of a motion between two photographs; features of a part of one photograph, at least
PHOTOGRAPHS = 3  # in which a feature is found again
SAME_PLACE = 0.01  # of the longest side: what moves by less stays in the picture, as a date that was burnt in does
LINK = 0.06  # of the longest side, between features of one part


def moving_parts(cameras: Mapping[int, Camera], keypoints: Mapping[int, np.ndarray], matches: Iterable[tuple[tuple[int, int], np.ndarray]]) -> dict[int, float]:
    """Number of an image -> share of it that moves, of those in which anything does.

    cameras    of the images, found from the same matches
    keypoints  (N, 2) pixels, of each image
    matches    of pairs of images, before they were verified: (M, 2) indices of keypoints
    """
    order = sorted(cameras)
    sizes = [len(keypoints[image]) for image in order]
    first = dict(zip(order, np.cumsum([0, *sizes]).tolist()[:-1], strict=True))  # number of an image's first feature among those of all
    directions = {image: rays(cameras[image], keypoints[image])[1] for image in order}
    agreeing, moving = np.zeros(sum(sizes), np.int64), np.zeros(sum(sizes), np.int64)
    joined = [np.zeros((0, 2), np.int64)]
    for (i, j), rows in matches:
        a, b = directions[i][rows[:, 0]], directions[j][rows[:, 1]]
        errors = np.stack([epipolar_error(cameras[i], cameras[j], a, b), epipolar_error(cameras[j], cameras[i], b, a)])
        whole = rows.astype(np.int64) + np.array((first[i], first[j]))
        np.add.at(agreeing, whole[errors.max(0) < NEAR].ravel(), 1)
        far = np.flatnonzero(errors.min(0) > FAR)
        far = far[:: max(1, -(-len(far) // MOST))]
        places = [keypoints[image][rows[far, side]] / _longest(cameras[image]) for side, image in enumerate((i, j))]
        together = whole[far[motions(*places)]]
        np.add.at(moving, together.ravel(), 1)
        joined.append(together)
    moves = (moving > agreeing) & (_photographs_of(np.concatenate(joined), np.repeat(np.arange(len(order)), sizes)) >= PHOTOGRAPHS)
    shares = {}
    for image, size in zip(order, sizes, strict=True):
        own = slice(first[image], first[image] + size)
        shares[image] = share_of_parts(keypoints[image][moves[own]], keypoints[image][(agreeing > moving)[own]], cameras[image])
    found = {image: share for image, share in shares.items() if share > 0}
    return found if len(found) >= PHOTOGRAPHS else {}


def motions(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Indices of the matches of places a to places b, both (M, 2) of the longest side, that one of a few motions explains in a patch of a, and that does more
    than stay where it was."""
    left, found = np.arange(len(a)), [np.zeros(0, np.int64)]
    for _ in range(MOTIONS):
        group = left[_one_motion(a[left], b[left])]
        if not len(group):
            break
        if np.median(np.linalg.norm(a[group] - b[group], axis=1)) > SAME_PLACE:
            found.append(group)
        left = np.setdiff1d(left, group)
    return np.sort(np.concatenate(found))


def _one_motion(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Indices of the most matches that a similarity takes from a to b, in the neighbourhood of the two matches that tell it; none of fewer than OF_A_MOTION."""
    none = np.zeros(0, np.int64)
    if len(a) < OF_A_MOTION:
        return none
    p, q = a[:, 0] + 1j * a[:, 1], b[:, 0] + 1j * b[:, 1]  # a similarity is a product and a sum
    apart = np.abs(p[:, None] - p)  # (M, M)
    others = np.where((apart > NEIGHBOURHOOD / 4) & (apart < NEIGHBOURHOOD), apart, np.inf)
    best = none
    for other in np.argsort(others, axis=1, kind="stable")[:, :NEIGHBOURS].T:  # (M,)
        one = np.flatnonzero(np.isfinite(others[np.arange(len(p)), other]))
        turn = (q[other[one]] - q[one]) / (p[other[one]] - p[one])
        one, turn = (each[(np.abs(turn) > 1 / LARGER) & (np.abs(turn) < LARGER)] for each in (one, turn))
        if not len(one):
            continue
        off = np.abs(q[one, None] + turn[:, None] * (p - p[one, None]) - q)  # (motions, M)
        fits = (off < TOLERANCE) & (apart[one] < 3 * NEIGHBOURHOOD)
        most = int(np.argmax(fits.sum(1)))
        if fits[most].sum() > len(best):
            best = np.flatnonzero(fits[most])
    return best if len(best) >= OF_A_MOTION else none


def _photographs_of(joined: np.ndarray, image_of: np.ndarray) -> np.ndarray:
    """(N,) of each feature the number of photographs in which it is found again, itself included, by the pairs (E, 2) of features that are joined."""
    size = len(image_of)
    graph = coo_array((np.ones(len(joined), np.int8), (joined[:, 0], joined[:, 1])), shape=(size, size))
    count, track = connected_components(graph, directed=False)
    there = np.unique(track.astype(np.int64) * size + image_of) // max(1, size)
    return np.asarray(np.bincount(there, minlength=count)[track])


def share_of_parts(moving: np.ndarray, still: np.ndarray, camera: Camera) -> float:
    """The share of the picture inside of the outlines of the parts: moving features (N, 2) that are near to each other, OF_A_PART or more, and more than
    there are still features (M, 2) inside of their outline."""
    places, still = (np.unique(np.round(each), axis=0) for each in (moving, still))  # a feature may have two directions
    if len(places) < OF_A_PART:
        return 0.0
    near = np.linalg.norm(places[:, None] - places, axis=2) < LINK * _longest(camera)
    count, part = connected_components(near, directed=False)
    area = 0.0
    for k in range(count):
        of_part = places[part == k].astype(np.float32)
        if len(of_part) >= OF_A_PART:
            outline = cv2.convexHull(of_part)
            inside = sum(cv2.pointPolygonTest(outline, (float(x), float(y)), False) >= 0 for x, y in still)
            if inside < len(of_part):
                area += cv2.contourArea(outline)
    return float(min(1.0, area / (camera.width * camera.height)))


def _longest(camera: Camera) -> int:
    return max(camera.width, camera.height)
