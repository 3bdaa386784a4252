"""Angles of parallax at the subject: below some, depth is unreliable.

The subject is where the view axes meet. Points behind it say nothing of it: in photographs all round a table most sparse points are of the large room, which
all cameras see from about one place.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from efficientnerf.capture.coverage import meeting_point
from stages.io.capture import Photo, SparsePoints

SMALL_ANGLE = 4.0  # degrees of parallax
SUBJECT_REACH = 0.5  # of the distance of the cameras from where their axes meet: points nearer to it are the subject, with its support
MIN_OBSERVERS, MIN_POINTS = 3, 10  # photographs that see a point of the subject, and such points, that wrong matches hardly make: then something is there
MAX_POINTS = 2000  # points that are looked at


@dataclass(frozen=True)
class Parallax:
    angle: float  # degrees: the median over the points of the subject, else over all, of the largest angle between two rays of a track
    subject: bool  # whether the cameras look from different sides at a subject that is there

    @property
    def small(self) -> bool:
        """Whether the photographs were taken from almost one place."""
        return self.angle < SMALL_ANGLE and not self.subject


def parallax(points: SparsePoints, photos: Sequence[Photo]) -> Parallax:
    """Of cameras and the sparse points that they see."""
    cameras = [photo.camera for photo in photos]
    chosen = np.arange(len(points.xyz))
    centres = np.array([camera.centre for camera in cameras]).reshape(-1, 3)
    subject = False
    if len(cameras) >= MIN_OBSERVERS:
        middle, meeting = meeting_point(cameras)
        if meeting:
            reach = SUBJECT_REACH * float(np.median(np.linalg.norm(centres - middle, axis=1)))
            near = np.linalg.norm(points.xyz - middle, axis=1) < reach
            there = np.flatnonzero(near & np.array([len(set(track)) >= MIN_OBSERVERS for track in points.tracks], bool))
            subject = len(there) >= MIN_POINTS
            chosen = there if subject else chosen
    chosen = chosen[:: max(1, len(chosen) // MAX_POINTS)]
    widest = [_widest(centres[list(points.tracks[n])] - points.xyz[n]) for n in chosen.tolist() if len(points.tracks[n]) > 1]
    return Parallax(float(np.median(widest)) if widest else 0.0, subject)


def _widest(towards: np.ndarray) -> float:
    """The largest angle between two of (N, 3) directions, degrees."""
    towards = towards / np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-300)
    return float(np.degrees(np.arccos(np.clip((towards @ towards.T).min(), -1, 1))))
