"""The documents of a run that the page and the summary read: metrics.json and the stages' reports, each checked against its schema.

A run may be untrusted or damaged: a document that does not follow its schema is left out, and reported.
"""

from pathlib import Path
from typing import Any, TypeVar

import msgspec

from pipeline import files
from stages.verdict.grades import GRADES

T = TypeVar("T")


class Damaged(Exception):
    """A document that does not follow its schema; the text names it and says why."""


class Quality(msgspec.Struct):
    """Means over views, or the figures of one view: PSNR in decibels."""

    psnr: float | None = None
    ssim: float | None = None
    psnr_colour_fitted: float | None = None


class MeshQuality(Quality):
    """Those of the mesh in its texture; in the colours of its vertices; on the pixels that it covers, and the asset's on the same."""

    psnr_vertex_colours: float | None = None
    ssim_vertex_colours: float | None = None
    psnr_covered: float | None = None
    asset_psnr_covered: float | None = None


class OfView(msgspec.Struct):
    """The figures of one view, of the network, of the asset and of the mesh."""

    network: Quality | None = None
    asset: Quality | None = None
    mesh: Quality | None = None


class ViewQuality(OfView):
    """A measured view."""

    name: str = ""
    gap: Quality | None = None
    holes: float | None = None
    floaters: float | None = None


class Strip(OfView):
    """A picture of photograph, network, asset and mesh: of which view."""

    which: str = ""
    view: str = ""


class Metrics(msgspec.Struct):
    """metrics.json, as far as it is shown; see `stages.evaluate.summary`."""

    split: str = "test"
    network: Quality | None = None
    asset: Quality | None = None
    mesh: MeshQuality | None = None
    splats: Quality | None = None
    asset_with_network_background: Quality | None = None
    gap: Quality | None = None
    holes: float | None = None
    floaters: float | None = None
    strips: list[Strip] = []
    views: list[ViewQuality] = []


class ResultProblem(msgspec.Struct):
    """A problem of a result: its cause, what to do, and the picture in the run that shows it."""

    grade: str = ""
    sentence: str = ""
    cause: str = ""
    remedy: str = ""
    picture: str = ""


class Verdict(msgspec.Struct):
    """A verdict: its grade, and a sentence."""

    grade: str
    summary: str


class ResultVerdict(msgspec.Struct):
    """The verdict on a result, as far as it is shown."""

    grade: str = ""
    summary: str = ""
    problems: list[ResultProblem] = []

    def is_as_bad_as(self, grade: str) -> bool:
        """Whether the grade is this one, or worse."""
        return self.grade in GRADES[GRADES.index(grade) :]


def read(path: Path, kind: type[T]) -> tuple[T, dict[str, Any]] | None:
    """A document by its schema, and all that it holds; None where there is none. Raises Damaged."""
    name = f"{path.parent.name}/{path.name}"
    try:
        found = files.read_json(path)
        return msgspec.convert(found, kind, strict=True), found
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (files.Unreadable, msgspec.ValidationError) as error:
        raise Damaged(f"{name}: damaged ({error})") from None
    except UnicodeEncodeError:  # of msgspec, where it looks a name up
        raise Damaged(f"{name}: damaged (a name in it is no text)") from None


def sound(path: Path, kind: type[T]) -> tuple[T, dict[str, Any]] | None:
    """The same; None for a damaged document, too."""
    try:
        return read(path, kind)
    except Damaged:
        return None
