"""The reports and verdicts of stages as far as a later stage follows them, or the page of a run shows them: what has no place in the other files."""

from pathlib import Path
from typing import Any, Literal

from msgspec import Struct

from stages.artifacts import PosesOutputs
from stages.io.scene_schema import T, read_document


class Framing(Struct, frozen=True):
    bounds_from: str = ""


class Rejected(Struct, frozen=True):
    """An image that was not used, and why."""

    name: str = ""
    reason: str = ""


class MarkersFound(Struct, frozen=True):
    """Markers that give the scale: its error as a share (99 %)."""

    error: float | None = None


class UpFound(Struct, frozen=True):
    """What up is taken from, and by how many degrees others that say it are off."""

    by: str = ""
    degrees: dict[str, float] = {}


class CaptureFacts(Struct, frozen=True):
    markers: MarkersFound = MarkersFound()
    up: UpFound = UpFound()


class PosesReport(Struct, frozen=True):
    """`registered` are the views of the scene."""

    registered: list[Any] | None = None
    reprojection_error: float | None = None
    rejected: list[Rejected] | None = None
    warnings: list[str] | None = None
    framing: Framing = Framing()
    facts: CaptureFacts = CaptureFacts()


class CameraProblem(Struct, frozen=True):
    """A problem of the cameras, and what to do."""

    sentence: str = ""
    remedy: str = ""
    grade: str = ""


class CameraVerdict(Struct, frozen=True):
    """The verdict on the cameras."""

    grade: str = ""
    summary: str = ""
    problems: list[CameraProblem] = []

    @property
    def worst(self) -> CameraProblem:
        """The first of those that the grade is of."""
        return next((each for each in self.problems if each.grade == self.grade), CameraProblem())


class Refinement(Struct, frozen=True):
    steps: int


class BakeReport(Struct, frozen=True):
    voxels: int
    optimisation: Refinement
    cascades: list[int] | None = None  # of unbounded scenes


class RegionReport(Struct, frozen=True):
    """Of the mesh or the Gaussians: what of the scene they are of."""

    region: Literal["foreground", "all"] = "foreground"


def read_report(path: Path, kind: type[T]) -> T:
    """What a report of that kind states. Raises CorruptArtifact."""
    return read_document(path, kind, f"Run the {path.parent.name} stage again.")


def poses_report(poses: Path) -> PosesReport:
    """That of the poses stage; of a scene without one an empty one. Raises CorruptArtifact."""
    path = PosesOutputs(poses).report
    return read_report(path, PosesReport) if path.is_file() else PosesReport()


def bounds_are_given(poses: Path) -> bool:
    """Whether the scene bounds are a box given by hand (poses.crop_box). Raises CorruptArtifact."""
    return poses_report(poses).framing.bounds_from == "given"
