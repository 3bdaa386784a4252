"""What a source holds, without changing or decoding it."""

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from efficientnerf.settings import Auto
from stages.formats.importers import IMPORTERS, candidates, one_line_errors
from stages.formats.importers.masks import masks_of
from stages.formats.importers.photographs import is_video, photographs
from stages.formats.importers.source import Source
from stages.io.capture import Capture
from stages.io.pictures import UnreadableImage, read_header
from stages.io.scene import described_camera
from stages.video.reading import UnreadableVideo, opened


@dataclass(frozen=True)
class Defaults:
    """The settings that a source is described with."""

    strict: bool = False
    allow_outside: bool = False
    llff_factor: int | Auto = "auto"


def describe_source(folder: Path) -> dict[str, Any]:
    """What `enerf inspect SOURCE` prints of a data set: count, resolutions, camera models, bounds, warnings. Raises BadInput."""
    name, *others = candidates(folder, Defaults.allow_outside)
    with one_line_errors(folder):
        described = _posed(IMPORTERS[name].read(folder, Defaults())) if IMPORTERS[name].posed else _photographs(folder)
    others = [other for other in others if other != "photographs"]
    if others:
        described["warnings"].append(f"can also be read --as {' or '.join(others)}.")
    return {"what": "source", "format": name} | described


def _sizes(sizes: list[tuple[int, int]]) -> list[dict[str, int]]:
    return [{"width": width, "height": height, "count": count} for (width, height), count in sorted(Counter(sizes).items())]


def _posed(capture: Capture) -> dict[str, Any]:
    centres = np.array([photo.camera.centre for photo in capture.photos])
    bounds: dict[str, Any] = {"cameras": [centres.min(0).tolist(), centres.max(0).tolist()]}
    if capture.points is not None:
        bounds["points"] = np.percentile(capture.points.xyz, [1, 99], axis=0).tolist()
    if capture.bounds is not None:
        bounds["stated"] = capture.bounds.tolist()
    return {
        "count": len(capture.photos),
        "splits": dict(Counter(photo.split or "not stated" for photo in capture.photos)),
        "resolution": _sizes([(photo.camera.width, photo.camera.height) for photo in capture.photos]),
        "models": sorted({photo.camera.model for photo in capture.photos}),
        "bounds": bounds,
        "masks": sum(photo.mask is not None for photo in capture.photos),
        "points": 0 if capture.points is None else len(capture.points.xyz),
        "reprojection_error": capture.reprojection_error,
        "metric": capture.metric,
        "facts": capture.facts,
        "rejected": [{"name": name, "reason": reason} for name, reason in capture.rejected],
        "warnings": list(capture.warnings),
        "cameras": [described_camera(photo.camera, photo.split) for photo in capture.photos],
    }


def _videos(source: Source, videos: list[Path]) -> dict[str, Any]:
    described: list[dict[str, Any]] = []
    rejected: list[dict[str, str]] = []
    for path in videos:
        name = path.name if path == source.root else source.name_of(path)
        try:
            with opened(path) as video:
                frame = next(video.frames(), None)
                if frame is None:
                    raise UnreadableVideo("unreadable: no frame in it can be decoded")
                facts = {"width": video.width, "height": video.height, "seconds": round(video.duration, 3), "frames": video.count, "camera": video.maker}
                described.append({"name": name, **facts})
        except UnreadableVideo as error:
            rejected.append({"name": name, "reason": str(error)})
    return _unposed([(video["width"], video["height"]) for video in described], rejected, [], videos=described)


def _photographs(folder: Path) -> dict[str, Any]:
    source = Source(folder)
    images = photographs(source) if folder.is_dir() else [folder]
    if is_video(images[0]):
        return _videos(source, images)
    sizes, rejected = [], []
    for image in images:
        try:
            header = read_header(source.real(image))
        except UnreadableImage as error:
            rejected.append({"name": source.name_of(image), "reason": str(error)})
            continue
        sizes.append(header.size)
    return _unposed(sizes, rejected, source.warnings(), masks=len(masks_of(source, images)))


def _unposed(sizes: list[tuple[int, int]], rejected: list[dict[str, str]], warnings: list[str], masks: int = 0, **more: Any) -> dict[str, Any]:
    unreadable = [f"{entry['name']}: {entry['reason']}" for entry in rejected]
    found = {"resolution": _sizes(sizes), "models": [], "bounds": None, "masks": masks, "rejected": rejected}
    return {"count": len(sizes), **more, **found, "warnings": [*unreadable, *warnings], "cameras": []}
