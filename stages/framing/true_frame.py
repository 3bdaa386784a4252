"""The unit and up of a run that were found after it: a similarity from the capture's frame. No artifact changes; exports, pages and measures apply it.

    RUN/frame.json   {"format": 1, "cameras": SHA-256 of poses/scene.json, "frame_from_capture", "error", "lengths": [...]}

Format 2, where up was set, adds "ground"; its "error" is null where no length is known.
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
from efficientnerf.geometry.orbit import rotation_to_z
from pipeline.errors import BadInput, CorruptArtifact
from pipeline.files import write_json
from pipeline.hashes import sha256_of
from pipeline.text import printable
from stages.artifacts import PosesOutputs
from stages.formats.exporters.writing import SourceFrame, source_frame
from stages.io.scene import Scene, similarity_to_json
from stages.io.scene_schema import Number, Positive, SimilarityDocument, Vector, decoded, json_of_run

NAME = "frame.json"
FORMAT, WITH_GROUND = 1, 2
Given = Annotated[str, Meta(max_length=4000)]
REMEDY = "Give the known lengths again (enerf measure RUN --known-length A B LENGTH), or go back to the capture's frame: enerf measure RUN --forget."


class KnownLength(Struct, frozen=True):
    """A length that the user knows: between two places as they were given, in metres, and how far the found unit is off it, as a share."""

    begin: Given
    end: Given
    metres: Positive
    residual: float


class Ground(Struct, frozen=True):
    """What someone set to be level."""

    up: Vector  # unit, in the capture's frame
    height: Number  # of the ground along it, in the capture's unit
    places: Annotated[list[Given], Meta(max_length=3)]  # on it, as they were given; none where it was found


class FrameDocument(Struct, frozen=True):
    format: int
    cameras: Annotated[str, Meta(max_length=64)]
    frame_from_capture: SimilarityDocument
    error: Annotated[float, Meta(ge=0, le=1)] | None
    lengths: Annotated[list[KnownLength], Meta(max_length=1000)]
    ground: Ground | None = None


@dataclass(frozen=True, eq=False)
class TrueFrame:
    """The frame that exports are in."""

    from_capture: Similarity  # takes the capture's frame there
    error: float | None  # of all lengths, as a share (99 %), where its unit is a metre; None: its unit is the capture's
    lengths: tuple[KnownLength, ...]  # that its unit was found by
    ground: Ground | None = None  # on which its z is 0, and upright; None: it is turned as the capture's

    @property
    def up(self) -> np.ndarray | None:
        """(3,) in this frame, where it was set."""
        return None if self.ground is None else np.array([0.0, 0.0, 1.0])

    def with_ground(self, ground: Ground | None) -> TrueFrame:
        return replace(self, from_capture=frame_of(self.from_capture.scale, ground), ground=ground)

    def with_lengths(self, scale: float, error: float | None, lengths: tuple[KnownLength, ...]) -> TrueFrame:
        """With units of the frame in one of the capture; `error` and `lengths` as above."""
        return replace(self, from_capture=frame_of(scale, self.ground), error=error, lengths=lengths)

    def scene(self, found: Scene) -> Scene:
        """The scene, its photographs' cameras in this frame."""
        views = tuple(replace(view, source_camera=self.from_capture.camera(view.source_camera)) for view in found.views)
        world = then(found.world_from_capture, self.from_capture.inverse())
        return replace(found, views=views, world_from_capture=world, metric=self.error is not None or found.metric)

    def metadata(self, metadata: Mapping[str, Any]) -> dict[str, Any]:
        """What of an asset's metadata differs in this frame."""
        world = then(source_frame(metadata).world_from_capture, self.from_capture.inverse())
        out = {"world_from_capture": similarity_to_json(world), "metric": self.error is not None or bool(metadata.get("metric", False))}
        return out if self.up is None else out | {"up": self.up.tolist()}

    def source_frame(self, metadata: Mapping[str, Any]) -> SourceFrame:
        """This frame, as exporters take it, from an asset's metadata."""
        return source_frame({**metadata, **self.metadata(metadata)})


AS_CAPTURED = TrueFrame(Similarity.identity(), None, ())


def frame_of(scale: float, ground: Ground | None) -> Similarity:
    """From the capture's frame to one with `scale` units in one of its own, and with a ground to z up, and 0 on that."""
    if ground is None:
        return Similarity(scale, np.eye(3), np.zeros(3))
    up = np.array(ground.up)
    over = np.diag([1.0, -1.0, -1.0]) if up[2] < -0.9 else np.eye(3)  # near -z the smallest rotation would lose its digits
    return Similarity(scale, rotation_to_z(over @ up) @ over, np.array([0.0, 0.0, -scale * ground.height]))


def then(second: Similarity, first: Similarity) -> Similarity:
    """The similarity that does both."""
    return Similarity(second.scale * first.scale, second.rotation @ first.rotation, second.points(first.translation))


def save_frame(frame: TrueFrame, run: Path) -> None:
    """Write RUN/frame.json, atomically."""
    lengths = [to_builtins(each) for each in frame.lengths]
    facts = {"frame_from_capture": similarity_to_json(frame.from_capture), "error": frame.error, "lengths": lengths}
    version, more = (FORMAT, {}) if frame.ground is None else (WITH_GROUND, {"ground": to_builtins(frame.ground)})
    write_json(run / NAME, {"format": version, "cameras": sha256_of(PosesOutputs.of_run(run).scene), **facts, **more})


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
    turned = np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6) and np.linalg.det(rotation) > 0
    if found.ground is None:
        good = found.format == FORMAT and turned and found.error is not None
    else:
        good = found.format == WITH_GROUND and turned and np.allclose(rotation @ found.ground.up, [0, 0, 1], atol=1e-6)
    if not good:
        raise CorruptArtifact(f"{printable(path)}: format version {found.format} with a similarity; this build reads {FORMAT} and {WITH_GROUND}. {remedy}")
    scene = PosesOutputs.of_run(run).scene
    if not scene.is_file() or sha256_of(scene) != found.cameras:
        raise BadInput(f"{printable(path)}: belongs to other cameras than the run has now. {REMEDY}")
    return TrueFrame(Similarity(given.scale, rotation, np.array(given.translation, np.float64)), found.error, tuple(found.lengths), found.ground)
