"""The unit of a run that was found after it: a similarity from the capture's frame. No artifact changes; exports, pages and measures apply it.

    RUN/frame.json   {"format": 1, "cameras": SHA-256 of poses/scene.json, "frame_from_capture", "error", "lengths": [...]}
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta, Struct, to_builtins

from efficientnerf.geometry.cameras import Similarity
from pipeline.errors import BadInput, CorruptArtifact
from pipeline.files import write_json
from pipeline.hashes import sha256_of
from pipeline.text import printable
from stages.artifacts import PosesOutputs
from stages.formats.exporters.writing import SourceFrame, source_frame
from stages.io.scene import Scene, similarity_to_json
from stages.io.scene_schema import Positive, SimilarityDocument, decoded, json_of_run

NAME = "frame.json"
FORMAT = 1
REMEDY = "Give the known lengths again (enerf measure RUN --known-length A B LENGTH), or go back to the capture's frame: enerf measure RUN --forget."


class KnownLength(Struct, frozen=True):
    """A length that the user knows: between two places as they were given, in metres, and how far the found unit is off it, as a share."""

    begin: Annotated[str, Meta(max_length=4000)]
    end: Annotated[str, Meta(max_length=4000)]
    metres: Positive
    residual: float


class FrameDocument(Struct, frozen=True):
    format: int
    cameras: Annotated[str, Meta(max_length=64)]
    frame_from_capture: SimilarityDocument
    error: Annotated[float, Meta(ge=0, le=1)]
    lengths: Annotated[list[KnownLength], Meta(max_length=1000)]


@dataclass(frozen=True, eq=False)
class TrueFrame:
    """The frame that exports are in, whose unit is a metre.

    from_capture  takes the capture's frame there
    error         of all lengths, as a share (99 %)
    lengths       that it was found by
    """

    from_capture: Similarity
    error: float
    lengths: tuple[KnownLength, ...]

    def scene(self, found: Scene) -> Scene:
        """The scene, its photographs' cameras in this frame."""
        views = tuple(replace(view, source_camera=self.from_capture.camera(view.source_camera)) for view in found.views)
        return replace(found, views=views, world_from_capture=then(found.world_from_capture, self.from_capture.inverse()), metric=True)

    def metadata(self, metadata: Mapping[str, Any]) -> dict[str, Any]:
        """What of an asset's metadata differs in this frame."""
        world = then(source_frame(metadata).world_from_capture, self.from_capture.inverse())
        return {"world_from_capture": similarity_to_json(world), "metric": True}

    def source_frame(self, metadata: Mapping[str, Any]) -> SourceFrame:
        """This frame, as exporters take it, from an asset's metadata."""
        return source_frame({**metadata, **self.metadata(metadata)})


def then(second: Similarity, first: Similarity) -> Similarity:
    """The similarity that does both."""
    return Similarity(second.scale * first.scale, second.rotation @ first.rotation, second.points(first.translation))


def save_frame(frame: TrueFrame, run: Path) -> None:
    """Write RUN/frame.json, atomically."""
    lengths = [to_builtins(each) for each in frame.lengths]
    facts = {"frame_from_capture": similarity_to_json(frame.from_capture), "error": frame.error, "lengths": lengths}
    write_json(run / NAME, {"format": FORMAT, "cameras": sha256_of(PosesOutputs.of_run(run).scene), **facts})


def load_frame(run: Path) -> TrueFrame | None:
    """The frame that was found for a run; None where there is none. Raises CorruptArtifact, and BadInput where its cameras were found again since."""
    path = run / NAME
    if not os.path.lexists(path):
        return None
    if path.is_symlink() or not path.is_file():
        raise CorruptArtifact(f"{printable(path)}: is no plain file. Remove it.")
    remedy = f"Remove it, or: {REMEDY}"
    found = decoded(json_of_run(path, remedy), FrameDocument, path, remedy)
    given = found.frame_from_capture
    rotation = np.array(given.rotation, np.float64)
    if found.format != FORMAT or not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6) or np.linalg.det(rotation) < 0:
        raise CorruptArtifact(f"{printable(path)}: format version {found.format} with a similarity; this build reads {FORMAT}. {remedy}")
    scene = PosesOutputs.of_run(run).scene
    if not scene.is_file() or sha256_of(scene) != found.cameras:
        raise BadInput(f"{printable(path)}: belongs to other cameras than the run has now. {REMEDY}")
    return TrueFrame(Similarity(given.scale, rotation, np.array(given.translation, np.float64)), found.error, tuple(found.lengths))
