"""The result of an importer: cameras, images and points in the capture's frame, at the source's size."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
from msgspec import UNSET, Struct, UnsetType

from efficientnerf.geometry.cameras import Camera

FOREGROUND = "foreground"  # a fact of photographs with silhouettes of it: how sure they are
Lens = Literal["zoomed", "cropped"]


@dataclass(frozen=True)
class Photo:
    """One image of the source and the camera that took it."""

    # in the capture's frame, for the image after EXIF rotation, at the source's full size; its name is the image's path relative to the source folder
    camera: Camera
    image: Path  # the file itself, without links
    mask: Path | None = None  # the file of its mask, without links, or None
    mask_ignore: str = "black"  # "black" if zero pixels of the mask are left out, "white" if the non-zero ones are
    split: str | None = None  # "train", "val" or "test" where the source states it, else None
    # near, far: along the view axis in the capture's units where the source states it, else None
    near: float | None = None
    far: float | None = None


@dataclass(frozen=True)
class Silhouettes:
    """Which of the two are silhouettes: pixels they leave out are background. Else those pixels are ignored."""

    alpha: bool = False  # alpha channels of the photographs
    masks: bool = False  # mask files

    def __bool__(self) -> bool:
        return self.alpha or self.masks


@dataclass(frozen=True)
class SparsePoints:
    """Sparse points of structure from motion or a depth sensor."""

    xyz: np.ndarray  # (N, 3) float64, the capture's frame
    rgb: np.ndarray  # (N, 3) uint8, sRGB
    error: np.ndarray  # (N,) float64 mean reprojection error, pixels (nan where unknown)
    tracks: tuple[tuple[int, ...], ...]  # of each point the indices of the photos that observe it (empty where unknown)

    def only(self, kept: np.ndarray) -> SparsePoints:
        """The points of these indices."""
        tracks = tuple(self.tracks[index] for index in kept.tolist()) if self.tracks else ()
        return SparsePoints(self.xyz[kept], self.rgb[kept], self.error[kept], tracks)


class Alignment(Struct, frozen=True, omit_defaults=True, kw_only=True):
    """Cameras that were found, against positions that are known of so many photographs."""

    photographs: int
    extent: float | None = None  # of the positions, metres
    distance: float | None = None  # of the cameras from them, median, metres
    used: Literal["nothing", "scale", "scale and up", "frame"]  # of the positions


class Provenance(Struct, frozen=True, omit_defaults=True):
    """How the cameras of photographs were found. report.json has it without what is not known."""

    photographs: int | None = None
    registered: int | None = None
    points: int | None = None
    triangulation_angle: float | None = None
    pairs_agreeing: float | None = None  # share of the verified matches that agree with the cameras
    matching: str | None = None  # the pairs that were matched, as the setting has it
    components: list[int] | None = None  # photographs of each group that overlaps with no other, the largest first
    models: list[int] | None = None  # photographs of each sub-model that adds to the first
    attempts: list[dict[str, object]] | None = None  # `tried` of `stages.sfm.attempts.Search`
    planar_pairs: float | UnsetType | None = UNSET  # share of the pairs whose matches one homography explains; None: there are no pairs
    lens: Lens | None = None  # photographs that were zoomed have a focal length each, cropped ones a principal point
    own_intrinsics: str | UnsetType | None = UNSET  # which each photograph has of its own (`stages.sfm.intrinsics.own`), if any
    moving_parts: dict[str, float] = {}  # name of a photograph -> share of it that moves
    background: Literal["left out", "stands still", "white"] | None = None  # of a subject that turns; or a white one that is left out
    stated_cameras: Alignment | None = None
    gps: Alignment | None = None


Markers = dict[str, dict[int, np.ndarray]]  # name of a photograph -> number of a marker in it -> (4, 2) its corners, px at full size


@dataclass(frozen=True)
class Capture:
    """A source, read."""

    kind: str  # "photographs", "blender", "nerfstudio", "instant-ngp", "llff" or "colmap"
    photos: tuple[Photo, ...]  # in sorted order of name within each split; all registered
    # the constant sRGB colour (0-1) that transparent pixels are composited on, of bounded scenes; None: unbounded
    background: tuple[float, float, float] | None
    silhouettes: Silhouettes = Silhouettes()  # whether alpha channels and masks are silhouettes
    up: np.ndarray | None = None  # unit up vector in the capture's frame where the format defines one (Blender: +z), else None
    points: SparsePoints | None = None
    bounds: np.ndarray | None = None  # (2, 3) box in the capture's frame where the source states one (instant-ngp's aabb), else None
    rejected: tuple[tuple[str, str], ...] = ()  # (name, reason) of each image that could not be used
    warnings: tuple[str, ...] = ()  # sentences for the user
    reprojection_error: float | None = None  # mean, pixels, where known
    metric: bool = False  # whether a unit of the capture's frame is known to be a metre
    facts: dict[str, object] = field(default_factory=dict)  # what the format states besides; the report repeats it, nothing follows from it
    provenance: Provenance = field(default_factory=Provenance)  # how the cameras were found, of photographs that state none
    rejected_files: dict[str, Path] = field(default_factory=dict)  # name -> file, without links, of those of the rejected that are there
    overlaps: tuple[tuple[str, str, int], ...] = ()  # (name, name, verified matches) of pairs of photographs, registered or not, where they were compared
    markers: Markers | None = None  # those in the photographs, where they were looked for
    markers_up: np.ndarray | None = None  # (3,) unit, in the capture's frame: up by the markers that lie on the ground, if any do


def without(capture: Capture, kept: Sequence[int], failed: Sequence[tuple[str, str]]) -> Capture:
    """The capture with only the photos `kept`; the others are rejected and leave the tracks."""
    if not failed:
        return capture
    place = {index: new for new, index in enumerate(kept)}
    files = {photo.camera.name: photo.image for index, photo in enumerate(capture.photos) if index not in place}
    points = capture.points
    if points is not None:
        tracks = tuple(tuple(place[photo] for photo in track if photo in place) for track in points.tracks)
        points = SparsePoints(points.xyz, points.rgb, points.error, tracks)
    photos = tuple(capture.photos[index] for index in kept)
    return replace(capture, photos=photos, points=points, rejected=(*capture.rejected, *failed), rejected_files=capture.rejected_files | files)
