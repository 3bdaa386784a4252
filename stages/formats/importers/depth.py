"""Depth maps of a sensor become sparse points, registered in the images whose own maps agree with them: they supervise training as those of structure from
motion do, and say where the scene is.

A phone's depth is upsampled, smooth across edges and a guess beyond five metres: samples near an edge of a map are not taken, and a point counts only where
other maps confirm it. Their number is bounded, whatever the number of maps. C photos, N points.
"""

import contextlib
import io
import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from efficientnerf.geometry.cameras import Camera, project, rays
from pipeline.errors import BadInput
from pipeline.text import printable
from stages.formats.importers.source import Source
from stages.formats.importers.texts import read_bytes
from stages.io.capture import Capture, Photo, SparsePoints
from stages.io.photo import same_aspect
from stages.io.pictures import UnreadableImage, integers_of, opened, read_header

MILLIMETRE = 0.001  # metres
MAX_POINTS = 20_000
MAX_LOOKUPS = 4_000_000  # points times maps that they are looked up in
MAX_MAPS = 1000  # that are used, evenly over the photos
MAX_EXR = 4096  # pixels a side
LARGEST_EXR = 64 << 20  # bytes
MOST_CHANNELS, MOST_DECODED = 16, 4 * 4 * MAX_EXR**2  # a pass of depth, besides colour and others; bytes of all
MAX_SIDE = 512  # pixels of a map; larger ones are thinned
MIN_TRACK = 3  # photos that agree; fewer and training does not use the point
MAX_TRACK = 16  # photos that a point is registered in: neighbours in a video see it alike
AGREEMENT = 0.03, 0.01  # of depths: a share, and metres
EDGE = 0.05  # share by which a sample may differ from its neighbours in the map


@dataclass(frozen=True)
class DepthFile:
    """The depth of a photo along its view axis."""

    file: Path  # PNG of one channel or OpenEXR, without links; 0, or what is not finite: unknown
    unit: float  # units of the capture's frame to one
    confidence: Path | None = None  # PNG of one channel of the same size, or None
    trusted: int = 0  # the least confidence that is used
    farthest: float = np.inf  # units beyond which a depth is not used


def depth_file(source: Source, path: Path, unit: float, confidence: Path | None = None, trusted: int = 0, farthest: float = np.inf) -> DepthFile | None:
    """The depth of a photo if its file is there; BadInput where that leads out of the source."""
    if not path.is_file():
        return None
    sure = source.real(confidence) if confidence is not None and confidence.is_file() else None
    return DepthFile(source.real(path), unit, sure, trusted, farthest)


def with_depth(capture: Capture, depths: Sequence[DepthFile | None]) -> Capture:
    """The capture with the points that the maps of its photos agree on, and what became of them among its facts and warnings; its own points stay."""
    known = [(index, found) for index, found in enumerate(depths) if found is not None]
    if capture.points is not None or not known:
        return capture
    every = -(-len(known) // MAX_MAPS)
    maps: dict[int, np.ndarray] = {}
    unreadable: list[str] = []
    for index, found in known[::every]:
        try:
            maps[index] = read_depth(found, capture.photos[index])
        except (UnreadableImage, BadInput) as error:
            unreadable.append(f"{found.file.name}: {error}")
    points = depth_points([photo.camera for photo in capture.photos], maps)
    warnings = [*capture.warnings]
    if unreadable:
        warnings.append(f"{len(unreadable)} of {len(known)} depth maps are not used, e.g. {unreadable[0]}.")
    if points is None and maps:
        warnings.append("The depth maps disagree everywhere and are not used: poses and depth may be in different units.")
    facts = capture.facts | {"depth_maps": len(maps), "depth_points": 0 if points is None else len(points.xyz)}
    return replace(capture, points=points, warnings=tuple(warnings), facts=facts)


def read_depth(found: DepthFile, photo: Photo) -> np.ndarray:
    """(h, w) float32 depth in units of the capture, 0 where it is unknown or not to be trusted, thinned to `MAX_SIDE`. Raises UnreadableImage."""
    if read_header(photo.image).orientation != 1:
        raise UnreadableImage("its photograph is rotated by EXIF, and the map is not")
    if found.file.suffix.lower() == ".exr":
        stored = _exr(found.file)
    else:
        with opened(found.file, ("PNG",)) as image:
            stored = integers_of(image)
    height, width = stored.shape
    if not same_aspect((photo.camera.width, photo.camera.height), (width, height)):
        raise UnreadableImage(f"{width}x{height} pixels, of another aspect than its photograph")
    depth = stored.astype(np.float32) * np.float32(found.unit)
    depth[~((depth > 0) & (depth <= found.farthest))] = 0
    if found.confidence is not None:
        with opened(found.confidence, ("PNG",)) as image:
            sure = integers_of(image)
        if sure.shape != stored.shape:
            raise UnreadableImage(f"its confidence has {sure.shape[1]}x{sure.shape[0]} pixels, and it {width}x{height}")
        depth[sure < found.trusted] = 0
    step = -(-max(width, height) // MAX_SIDE)
    return depth[step // 2 :: step, step // 2 :: step] if step > 1 and min(width, height) > step else depth


def _exr(path: Path) -> np.ndarray:
    """(H, W) float32, the one channel of an OpenEXR file, or its R, Y or Z. Raises UnreadableImage."""
    import OpenEXR  # only where depth is read: folders are recognised without it

    data, messages = read_bytes(path, LARGEST_EXR), io.StringIO()
    try:
        with contextlib.redirect_stdout(messages):  # it prints what is wrong with a file
            file = OpenEXR.File(io.BytesIO(data), header_only=True, num_threads=0)
            low, high = file.header()["dataWindow"]
            width, height = (int(end) - int(begin) + 1 for begin, end in zip(low, high, strict=True))
            if not (0 < width <= MAX_EXR and 0 < height <= MAX_EXR):
                raise UnreadableImage(f"{width}x{height} pixels; at most {MAX_EXR} a side are read")
            parts, count = len(file.parts), len(file.header()["channels"])  # all are decoded, and next to nothing of a file can stand for each
            if parts > 1 or count > MOST_CHANNELS or 4 * count * width * height > MOST_DECODED:
                raise UnreadableImage(f"{width}x{height} pixels in {count} channels and {parts} parts; at most {MOST_CHANNELS} channels of one part are read")
            channels = OpenEXR.File(io.BytesIO(data), separate_channels=True, num_threads=0).channels()
        name = next((name for name in ("R", "Y", "Z") if name in channels), next(iter(channels)))
        pixels = np.asarray(channels[name].pixels)
    except (RuntimeError, ValueError, TypeError, KeyError, StopIteration) as error:
        raise UnreadableImage(f"unreadable: no OpenEXR file, or damaged ({printable(error, 80)})") from error
    finally:
        if messages.getvalue():
            logging.getLogger("OpenEXR").warning(printable(messages.getvalue(), 300))
    if pixels.shape != (height, width) or pixels.dtype.kind not in "fiu":
        raise UnreadableImage("unreadable: no channel of as many pixels as the file has")
    return pixels


def depth_points(cameras: Sequence[Camera], maps: dict[int, np.ndarray]) -> SparsePoints | None:
    """Samples of the maps that at least `MIN_TRACK` of the photos agree on; None where there is none.

    maps  index of the photo -> (h, w) depth along its view axis
    """
    count = min(MAX_POINTS, MAX_LOOKUPS // max(1, len(maps)))
    each = max(1, -(-count // max(1, len(maps))))
    rng = np.random.default_rng(0)
    found, tracks = [], []
    for index, depth in maps.items():
        row, column = np.nonzero(_smooth(depth))
        chosen = np.sort(rng.permutation(len(row))[:each])
        if not len(chosen):
            continue
        xyz = _unprojected(cameras[index], depth, row[chosen], column[chosen])
        seen = np.zeros((len(xyz), len(maps)), bool)  # (N, C)
        for place, (other, others) in enumerate(maps.items()):
            seen[:, place] = True if other == index else _agrees(cameras[other], others, xyz)
        kept = np.flatnonzero(seen.sum(1) >= MIN_TRACK)
        order = np.fromiter(maps, np.int64)
        found.append(xyz[kept])
        tracks += [_thinned(sorted(order[seen[point]].tolist())) for point in kept]
    if not tracks:
        return None
    xyz = np.concatenate(found)
    return SparsePoints(xyz, np.full((len(xyz), 3), 128, np.uint8), np.full(len(xyz), np.nan), tuple(tracks))


def _thinned(track: list[int]) -> tuple[int, ...]:
    """`MAX_TRACK` of the photos at most, evenly over all of them."""
    count = min(len(track), MAX_TRACK)
    return tuple(track[place * len(track) // count] for place in range(count))


def _smooth(depth: np.ndarray) -> np.ndarray:
    """Where a map is known and differs little from its four neighbours."""
    inner = depth[1:-1, 1:-1]
    good = inner > 0
    for other in (depth[:-2, 1:-1], depth[2:, 1:-1], depth[1:-1, :-2], depth[1:-1, 2:]):
        good &= np.abs(other - inner) < EDGE * inner
    return np.pad(good, 1) if good.size else np.zeros(depth.shape, bool)


def _unprojected(camera: Camera, depth: np.ndarray, row: np.ndarray, column: np.ndarray) -> np.ndarray:
    """(N, 3) the points of samples of a map, in the frame of the camera's world."""
    height, width = depth.shape
    pixels = np.stack([(column + 0.5) * camera.width / width, (row + 0.5) * camera.height / height], -1)
    origins, directions = rays(camera, pixels)
    along = np.maximum(directions @ camera.forward, 1e-6)
    return np.asarray(origins + directions * (depth[row, column] / along)[:, None])


def _agrees(camera: Camera, depth: np.ndarray, xyz: np.ndarray) -> np.ndarray:
    """(N,) whether a photo's map has the points where they are."""
    height, width = depth.shape
    pixels, distance = project(camera, xyz)
    inside = np.isfinite(pixels).all(1) & (distance > 0)
    inside &= (pixels >= 0).all(1) & (pixels < (camera.width, camera.height)).all(1)
    column = np.where(inside, pixels[:, 0] * width / camera.width, 0).astype(np.int64)
    row = np.where(inside, pixels[:, 1] * height / camera.height, 0).astype(np.int64)
    stated = depth[row, column]
    return np.asarray(inside & (stated > 0) & (np.abs(stated - distance) < AGREEMENT[0] * distance + AGREEMENT[1]))
