"""The reports of stages as far as a later one follows them: what they hold has no place in the other files, whose formats stay. This is the one place."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, TypeVar

from msgspec import Struct

from stages.artifacts import PosesOutputs
from stages.io.scene_schema import read_document

R = TypeVar("R", bound=Struct)


class Framing(Struct, frozen=True):
    bounds_from: str = ""


class PosesReport(Struct, frozen=True):
    framing: Framing = Framing()
    warnings: tuple[str, ...] = ()


class Refinement(Struct, frozen=True):
    steps: int


class BakeReport(Struct, frozen=True):
    voxels: int
    optimisation: Refinement
    cascades: tuple[int, ...] | None = None  # of unbounded scenes


class RegionReport(Struct, frozen=True):
    """Of the mesh or the Gaussians: what of the scene they are of."""

    region: Literal["foreground", "all"] = "foreground"


def read_report(path: Path, kind: type[R]) -> R:
    """What a report of that kind states. Raises CorruptArtifact."""
    return read_document(path, kind, f"Run the {path.parent.name} stage again.")


def poses_report(poses: Path) -> PosesReport:
    """That of the poses stage; of a scene without one the defaults. Raises CorruptArtifact."""
    path = PosesOutputs(poses).report
    return read_report(path, PosesReport) if path.is_file() else PosesReport()


def bounds_are_given(poses: Path) -> bool:
    """Whether the scene bounds are a box given by hand (poses.crop_box). Raises CorruptArtifact."""
    return poses_report(poses).framing.bounds_from == "given"
