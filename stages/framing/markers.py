"""Metres by printed markers (ArUco, AprilTag) whose edges are of known length, found in the photographs at full size.

OpenCV finds them; its corners are up to two pixels off where a picture is blurred. They are found again as where lines through the four edges meet: an edge is
where half of the light between inside and outside is reached, of light that is linear, so that blur does not move it.
"""

import itertools
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from efficientnerf.capture.adjustment import shape_spread
from efficientnerf.capture.markers import CONFIDENCE, MIN_VIEWS, SquareFit, common_length, common_normal, fit_square
from efficientnerf.geometry.cameras import Camera, Similarity
from efficientnerf.rendering.colour import linear_from_srgb
from pipeline.errors import BadInput
from pipeline.stage import Job
from stages.cores import count_cores, in_order
from stages.framing.gps import in_metres
from stages.framing.training_frame import estimated_up
from stages.io.capture import Capture, Markers
from stages.io.photo import read_photo
from stages.io.pictures import MAX_SIDE, UnreadableImage
from stages.memory.need import refuse_what_does_not_fit
from stages.poses.memory import decoding_needed, reading_threads

DICTIONARIES = ("4X4_250", "5X5_250", "6X6_250", "7X7_250", "ARUCO_ORIGINAL", "ARUCO_MIP_36h12", "APRILTAG_25h9", "APRILTAG_36h11")
WINDOW, NARROWEST, WIDEST = 0.05, 1.5, 8.0  # to both sides of an edge: share of its length, and pixels
LARGEST_ERROR = 0.03  # of a length: what is less sure is no scale
TILT = 30.0  # degrees from the upward axis that the cameras suggest, up to which markers are taken to lie on the ground
TIED = 1.5  # times as sure as their four corners are the nine tie points of a marker taken to be
LEAST_MISS = 0.2  # px, of tie points: those of one marker agree by what they are made of
MIN_CONTRAST = 0.02  # of linear light between inside and outside of an edge
_LINEAR = linear_from_srgb(np.arange(256, dtype=np.float32) / 255)
_INSTEAD = (
    f"Dictionaries tried: {', '.join(DICTIONARIES)}; circular targets are not read. Print markers (enerf board), or give the distance of two places:"
    " enerf measure RUN --known-length PLACE PLACE LENGTH."
)
_REMEDY = "the cameras are wrong. Without --marker-size (poses.marker_size=off) they are not looked for."
Seen = dict[tuple[str, int], np.ndarray]  # dictionary and number of a marker -> (4, 2) its corners
Size = tuple[int, int]


def with_markers(job: Job, capture: Capture, size: float, warn: Callable[[str], None]) -> Capture:
    """The capture in metres, by markers with edges of `size` metres; as it is, with a warning, where none are found. Raises BadInput where they disagree."""
    seen = capture.markers
    if seen is None:
        seen = find_markers(job, {photo.camera.name: (photo.image, (photo.camera.width, photo.camera.height)) for photo in capture.photos})
    views = {
        number: [(photo, seen[photo.camera.name][number]) for photo in capture.photos if number in seen.get(photo.camera.name, {})]
        for number in sorted({number for corners in seen.values() for number in corners})
    }
    views = {number: found for number, found in views.items() if len(found) >= MIN_VIEWS}
    if not views:
        warn(f"no marker is seen by {MIN_VIEWS} photographs: lengths stay as they are. {_INSTEAD}")
        return capture
    fits = {number: fit_square([photo.camera for photo, _ in found], np.stack([corners for _, corners in found])) for number, found in views.items()}
    still = {number: fit for number, fit in fits.items() if fit.still}
    moved = sorted(fits.keys() - still.keys())
    their_numbers = ", ".join(map(str, moved))
    if len(still) <= len(moved):
        raise BadInput(f"{job.source}: markers {their_numbers} are not where other photographs see them: they moved, a number was printed twice, or {_REMEDY}")
    length, error, excess = common_length([*still.values()])
    if excess > 3 and max(abs(fit.square.scale / length - 1) for fit in still.values()) > LARGEST_ERROR:
        lengths = ", ".join(f"{number}: {fit.square.scale / length * size:.4g} m" for number, fit in sorted(still.items()))
        raise BadInput(f"{job.source}: markers differ in size ({lengths}): they are not all of one size, they moved, or {_REMEDY}")
    error = float(np.hypot(error, CONFIDENCE * _shape_spread(capture, [*still.values()], job.settings.feature_image_size)))
    if error > LARGEST_ERROR:
        remedy = "Photograph them larger, from more sides, and with more of what is round them."
        warn(f"markers give lengths within {min(error, 1):.0%} only, and are not used. {remedy}")
        return capture
    if moved:
        warn(f"markers {their_numbers} moved, or their number was printed twice; they are not used.")
    normal, tilt = _normal(capture, [*still.values()]) or (None, None)
    words, frame = f"{len(still)} markers give the scale, within {error:.2g} of each length (99 %)", Similarity(size / length, np.eye(3), np.zeros(3))
    if normal is not None:
        words += f", and the upward axis, within {tilt:.2g} degrees"
        if capture.up is None and capture.bounds is None:  # nothing else states a frame
            frame = _on_marker(still[min(still)], normal, frame.scale)
            words += f"; the origin is the middle of marker {min(still)}"
        normal = frame.rotation @ normal
    job.say(f"{words}.")
    facts = {"used": sorted(still), "moved": moved, "size": size, "error": error, "normal": None if normal is None else normal.tolist(), "normal_error": tilt}
    scaled = in_metres(capture, frame)
    return replace(scaled, facts=scaled.facts | {"markers": facts}, markers_up=normal)


def find_markers(job: Job, files: Mapping[str, tuple[Path, Size]]) -> Markers:
    """Corners of the markers in photographs, of those of the dictionary that is seen most that are seen in enough of them.

    files  each photograph's file, by name, and its size after EXIF rotation: of another size there are none
    """
    sizes = [size for _, size in files.values()]
    refuse_what_does_not_fit(job, decoding_needed(sizes), "Reduce the largest photographs.")
    threads = reading_threads(job, sizes, count_cores())
    found = []
    for index, seen in enumerate(in_order(lambda each: _markers_of(*each), [*files.values()], threads, job.safe_point)):
        job.progress(index + 1, len(files), "finding markers")
        found.append(seen)
    often = Counter(itertools.chain.from_iterable(found))
    kept = {key: count for key, count in often.items() if count >= MIN_VIEWS}
    best = max(DICTIONARIES, key=lambda name: sum(count for (own, _), count in kept.items() if own == name))  # the first of equals
    own = [{number: corners for (name, number), corners in sorted(seen.items()) if name == best and (name, number) in kept} for seen in found]
    return {name: seen for name, seen in zip(files, own, strict=True) if seen}


def _markers_of(path: Path, size: Size) -> Seen:
    try:
        rgb = read_photo(path, MAX_SIDE).rgb
    except UnreadableImage:  # reported where it is needed
        return {}
    if rgb.shape[1::-1] != size:
        return {}
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    light = _LINEAR[grey]
    found: Seen = {}
    dictionaries = [cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name}")) for name in DICTIONARIES]
    corners, numbers, _, which = cv2.aruco.ArucoDetector(dictionaries, cv2.aruco.DetectorParameters()).detectMarkersMultiDict(grey)
    if numbers is None:
        return {}
    for place, number, index in zip(corners, numbers.ravel().tolist(), which.ravel().tolist(), strict=True):
        exact = refined(light, place.reshape(4, 2).astype(np.float64), dictionaries[index].markerSize + 2)
        if exact is not None:
            found[DICTIONARIES[index], number] = exact + 0.5  # OpenCV's centres are integers
    return found


def refined(light: np.ndarray, corners: np.ndarray, cells: int) -> np.ndarray | None:
    """(4, 2) corners of a dark square on a light ground where the lines through its edges meet; None where there are no edges.

    light  (H, W) float32, linear; corners (4, 2) clockwise, centres of pixels at integers
    cells  along an edge; blur carries light of white ones behind the border to it, and an edge counts little there
    """
    for _ in range(8):
        lines = []
        for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            length = float(np.linalg.norm(end - start))
            along = (end - start) / max(length, 1e-9)
            out = np.array([along[1], -along[0]])
            reach = float(np.clip(WINDOW * length, NARROWEST, WIDEST))
            u = np.linspace(0.12, 0.88, int(np.clip(0.8 * length, 8, 200))) * length
            v = np.linspace(-reach, reach, int(np.ceil(4 * reach)) + 1)
            at = (start + u[:, None, None] * along + v[None, :, None] * out).astype(np.float32)
            values = cv2.remap(light, at[..., 0], at[..., 1], cv2.INTER_LINEAR)
            rise = np.diff(values, axis=1)
            whole = rise.sum(1)
            weight = np.maximum(whole, 0.0)
            if np.median(weight) < MIN_CONTRAST:
                return None
            behind = (start + u[:, None] * along - 1.5 * length / cells * out).astype(np.float32)
            inner = cv2.remap(light, behind[None, :, 0], behind[None, :, 1], cv2.INTER_LINEAR)[0]
            white = (inner - inner.min()) / max(float(np.median(values[:, -1])) - float(inner.min()), MIN_CONTRAST)
            weight = weight * np.clip(1 - white, 0.05, 1) ** 2
            edge = np.clip((rise * (v[1:] + v[:-1]) / 2).sum(1) / np.maximum(whole, MIN_CONTRAST), -reach, reach)
            basis, used = np.stack([np.ones_like(u), u], 1), weight
            for _ in range(5):
                line = np.linalg.lstsq(basis * np.sqrt(used)[:, None], edge * np.sqrt(used), rcond=None)[0]
                off = np.abs(edge - basis @ line)
                used = weight / (1 + (off / max(2 * float(np.median(off)), 1e-3)) ** 2)
            lines.append((start + line[0] * out, along + line[1] * out))
        matrices = np.stack([np.stack([lines[k - 1][1], -lines[k][1]], 1) for k in range(4)])
        if np.abs(np.linalg.det(matrices)).min() < 0.05:
            return None
        corners = np.stack([lines[k - 1][0] + np.linalg.solve(matrices[k], lines[k][0] - lines[k - 1][0])[0] * lines[k - 1][1] for k in range(4)])
    return corners


def _normal(capture: Capture, fits: list[SquareFit]) -> tuple[np.ndarray, float] | None:
    """The normal of the markers' plane and its error, where they lie on the ground."""
    found = common_normal(fits)
    near = estimated_up([photo.camera for photo in capture.photos]) if capture.up is None else capture.up
    return found if found is not None and found[0] @ near > np.cos(np.radians(TILT)) else None


def _shape_spread(capture: Capture, fits: list[SquareFit], feature_size: int) -> float:
    """How sure lengths round the markers and up to the cameras are by these, whatever their scale, as a share; 0 where nothing is known of that."""
    points, cameras = capture.points, [photo.camera for photo in capture.photos]
    if points is None or capture.reprojection_error is None:
        return 0.0
    if not any(points.tracks):
        return np.inf
    middle = np.mean([fit.square.translation for fit in fits], axis=0)
    near = np.linalg.norm(points.xyz - middle, axis=1) < np.median([np.linalg.norm(camera.centre - middle) for camera in cameras])
    counts, observers = np.array([len(track) for track in points.tracks], int), np.array([*itertools.chain.from_iterable(points.tracks)], int)
    miss = max(LEAST_MISS, at_full_size(capture.reprojection_error, capture.kind, cameras, feature_size))
    spread = shape_spread(cameras, points.xyz, counts, observers, miss, near, and_cameras=True)
    return 0.0 if np.isnan(spread) else TIED * spread


def at_full_size(reprojection_error: float, kind: str, cameras: Sequence[Camera], feature_size: int) -> float:
    """In pixels of the cameras: that of photographs is stated at the size in which features are found."""
    longest = max(max(camera.width, camera.height) for camera in cameras)
    return reprojection_error * (max(1.0, longest / feature_size) if kind == "photographs" else 1.0)


def _on_marker(fit: SquareFit, normal: np.ndarray, scale: float) -> Similarity:
    """To the frame with z along a normal, x along a marker's edges, and its origin in that marker's middle."""
    x = np.cross(fit.square.rotation[:, 1], normal)
    x /= np.linalg.norm(x)
    turn = np.stack([x, np.cross(normal, x), normal])
    return Similarity(scale, turn, -scale * turn @ fit.square.translation)
