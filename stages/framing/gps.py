"""Scale and up of cameras that were found: by the GPS positions in the EXIF data of their photographs, or by cameras that the source states, as of an app that
tracked the phone.

The cameras are aligned to the positions by a robust similarity (of least squares, reweighted). How well the two agree decides what is used: a phone's
positions are metres off, which says nothing of a capture two metres wide.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from msgspec import structs

from efficientnerf.geometry.cameras import Similarity, closest_similarity
from stages.io.capture import Alignment, Capture
from stages.io.photo import read_gps_position
from stages.io.pictures import UnreadableImage

MIN_PHOTOGRAPHS = 6  # photographs with a position
ROUNDS = 20
# Median distance to the positions over their extent, up to which the scale (or a stated frame) and the upward axis are taken from them.
MAX_DISTANCE_FOR_SCALE, MAX_DISTANCE_FOR_UP = 0.1, 0.03
MIN_BREADTH = 0.1  # extent across the longest line through the cameras, over that along it: below, they turn about it freely
_A, _F = 6378137.0, 1 / 298.257223563  # WGS 84: semi-major axis in metres, flattening


def enu_from_gps(positions: np.ndarray) -> np.ndarray:
    """(N, 3) metres east, north and up of the first position, from (N, 3) latitude and longitude in degrees and altitude in metres on WGS 84."""
    latitude, longitude, altitude = np.radians(positions[:, 0]), np.radians(positions[:, 1]), positions[:, 2]
    squared = _F * (2 - _F)  # eccentricity
    normal = _A / np.sqrt(1 - squared * np.sin(latitude) ** 2)
    across = (normal + altitude) * np.cos(latitude)
    earth = np.stack([across * np.cos(longitude), across * np.sin(longitude), (normal * (1 - squared) + altitude) * np.sin(latitude)], 1)
    (sin, cos), (sin_l, cos_l) = ((np.sin(angle[0]), np.cos(angle[0])) for angle in (latitude, longitude))
    axes = np.array([[-sin_l, cos_l, 0.0], [-sin * cos_l, -sin * sin_l, cos], [cos * cos_l, cos * sin_l, sin]])
    return np.asarray((earth - earth[0]) @ axes.T)


def robust_similarity(source: np.ndarray, target: np.ndarray) -> Similarity:
    """The similarity that takes most of (N, 3) points near to (N, 3) others: squared distances, each weighted by how far it is from the usual."""
    weights = np.ones(len(source))
    found = Similarity.identity()
    for _ in range(ROUNDS):
        found = closest_similarity(source, target, weights)
        distance = np.linalg.norm(found.points(source) - target, axis=1)
        weights = 1 / (1 + (distance / max(2 * float(np.median(distance)), 1e-9)) ** 2)
    return found


def with_gps(capture: Capture, files: Mapping[str, Path]) -> tuple[Capture, str]:
    """The capture in metres, and with the upward axis of the earth, as far as GPS positions determine them; and a sentence, empty where they are not used.

    files  of the photographs, by name
    """
    positions = {}
    for photo in capture.photos:
        try:
            position = read_gps_position(files[photo.camera.name])
        except UnreadableImage:
            continue
        if position is not None:
            positions[photo.camera.name] = position
    if not positions:
        return capture, ""
    if len(positions) < max(MIN_PHOTOGRAPHS, len(capture.photos) / 2):
        return _with(capture, gps=Alignment(photographs=len(positions), used="nothing")), ""
    places = enu_from_gps(np.array([positions[photo.camera.name] for photo in capture.photos if photo.camera.name in positions]))
    aligned, distance, extent, straight = _aligned(capture, [*positions], places)
    found = Alignment(photographs=len(positions), extent=round(extent, 3), distance=round(distance, 3), used="nothing")
    if not distance <= MAX_DISTANCE_FOR_SCALE * extent or aligned.scale <= 0:
        return _with(capture, gps=found), ""
    words = f"{len(positions)} of {len(capture.photos)} photographs have a GPS position, {distance:.2g} m from the cameras found in the median"
    if distance > MAX_DISTANCE_FOR_UP * extent or straight:
        scaled = Similarity(aligned.scale, np.eye(3), np.zeros(3))
        return in_metres(_with(capture, gps=structs.replace(found, used="scale")), scaled), f"{words}: the scale is taken from them."
    moved = replace(in_metres(capture, aligned), up=np.array([0.0, 0.0, 1.0]))
    return _with(moved, gps=structs.replace(found, used="scale and up")), f"{words}: scale and upward axis are taken from them."


def with_stated_cameras(capture: Capture, stated: Capture) -> tuple[Capture, str]:
    """Cameras that were found, in the frame of those that their source states, with its scale and upward axis, as far as the two agree; and a sentence."""
    places = {photo.camera.name: photo.camera.centre for photo in stated.photos}
    names = [photo.camera.name for photo in capture.photos if photo.camera.name in places]
    words = f"the source states cameras of {len(names)} of the {len(capture.photos)} photographs ({stated.kind})"
    if len(names) < max(MIN_PHOTOGRAPHS, len(capture.photos) / 2):
        return _with(capture, stated_cameras=Alignment(photographs=len(names), used="nothing")), f"{words}: too few to be used."
    aligned, distance, extent, straight = _aligned(capture, names, np.array([places[name] for name in names]))
    found = Alignment(photographs=len(names), extent=round(extent, 6), distance=round(distance, 6), used="nothing")
    if not distance <= MAX_DISTANCE_FOR_SCALE * extent or aligned.scale <= 0:
        share = f"{distance / extent:.0%} of their extent" if extent > 0 else "they lie in one place"
        return _with(capture, stated_cameras=found), f"{words}, but not where they were found ({share} apart in the median): they are not used."
    if straight:
        return _with(capture, stated_cameras=found), f"{words}, along a line, which they may turn about: they are not used."
    moved = replace(in_metres(capture, aligned), up=stated.up, metric=stated.metric)
    moved = _with(moved, stated_cameras=structs.replace(found, used="frame"))
    return moved, f"{words}: their frame and scale are kept, {distance / extent:.2%} of their extent apart."


def _aligned(capture: Capture, names: Sequence[str], places: np.ndarray) -> tuple[Similarity, float, float, bool]:
    """The similarity that takes the photographs of these names, in the order of the capture, to places (N, 3); the median distance that is left, the extent of
    the photographs there, and whether they lie along a line."""
    wanted = set(names)
    centres = np.array([photo.camera.centre for photo in capture.photos if photo.camera.name in wanted])
    aligned = robust_similarity(centres, places)
    distance = float(np.median(np.linalg.norm(aligned.points(centres) - places, axis=1)))
    spread = np.linalg.svd(aligned.scale * (centres - centres.mean(0)), compute_uv=False) / np.sqrt(len(centres))  # along three axes
    return aligned, distance, float(np.linalg.norm(spread)), bool(spread[1] < MIN_BREADTH * spread[0])


def in_metres(capture: Capture, similarity: Similarity) -> Capture:
    """The capture in the frame that the similarity leads to, whose unit is a metre; of one with bounds it only scales."""
    k = similarity.scale
    photos = tuple(
        replace(photo, camera=similarity.camera(photo.camera), near=photo.near and k * photo.near, far=photo.far and k * photo.far) for photo in capture.photos
    )
    points = capture.points and replace(capture.points, xyz=similarity.points(capture.points.xyz))
    bounds = None if capture.bounds is None else similarity.points(capture.bounds)
    return replace(capture, photos=photos, points=points, bounds=bounds, metric=True)


def _with(capture: Capture, **known: Alignment) -> Capture:
    return replace(capture, provenance=structs.replace(capture.provenance, **known))
