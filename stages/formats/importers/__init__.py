"""Formats that a capture can come in: one file each, or an entry in `datasets`; a plain dict as the table.

Nothing heavy is imported until something is read.
"""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any

from pipeline.errors import BadInput
from pipeline.text import printable
from stages.formats.importers.photographs import photographs
from stages.formats.importers.source import ImportSettings, Source
from stages.io.capture import Capture
from stages.io.pictures import ERRORS_OF_THE_MACHINE
from stages.video import KNOWN, SUFFIXES


@dataclass(frozen=True)
class Importer:
    """How one format is read."""

    module: str  # of this package or one below it
    # the name of its `ListFormat`; None: it states no cameras, and the module itself has recognises(folder) and files(folder, settings)
    entry: str | None = "FORMAT"
    renders: bool = False  # whether its images may be renders of an object on a constant background, whose alpha is coverage

    @property
    def posed(self) -> bool:
        """Whether the format states cameras; else they are found from the photographs."""
        return self.entry is not None

    def recognises(self, folder: Path, allow_outside: bool = False) -> bool:
        """Whether a folder holds files of this format; BadInput where they cannot be read."""
        return bool(self._called("recognises", folder, allow_outside))

    def read(self, folder: Path, settings: ImportSettings) -> Capture:
        """The capture, whose names and sentences may be shown; raises BadInput."""
        capture: Capture = self._called("read", folder, settings)
        return replace(capture, warnings=tuple(map(printable, capture.warnings)))

    def files(self, folder: Path, settings: ImportSettings) -> list[Path]:
        """What the capture depends on; raises BadInput."""
        paths: list[Path] = self._called("files", folder, settings)
        return paths

    def _called(self, name: str, folder: Path, how: Any) -> Any:
        with one_line_errors(folder):
            module = import_module(f"{__name__}.{self.module}")
            return getattr(module if self.entry is None else getattr(module, self.entry), name)(folder, how)


@contextmanager
def one_line_errors(folder: Path) -> Iterator[None]:
    """BadInput whose text is one line that may be shown, whatever the names in it hold; also where a file or folder of the source cannot be read."""
    try:
        yield
    except BadInput as error:
        raise BadInput(printable(error, LONGEST)) from error
    except OSError as error:
        if error.errno in ERRORS_OF_THE_MACHINE:
            raise
        raise BadInput(printable(f"{error.filename or folder}: cannot be read ({error.strerror or error}). Check the source folder.")) from error


LONGEST = 2000  # characters of a message: a path of the longest kind may be in it, more than once it may not

# In order of preference: a folder may hold several formats.
IMPORTERS: dict[str, Importer] = {
    "blender": Importer("transforms", "BLENDER", renders=True),
    "nerfstudio": Importer("transforms", "NERFSTUDIO", renders=True),
    "instant-ngp": Importer("transforms", "INSTANT_NGP", renders=True),
    "scannetpp": Importer("datasets.published", "SCANNETPP"),
    "polycam": Importer("datasets.phones", "POLYCAM"),
    "record3d": Importer("datasets.phones", "RECORD3D"),
    "3d-scanner-app": Importer("datasets.phones", "SCANNER_APP"),
    "metashape": Importer("photogrammetry.metashape"),
    "realitycapture": Importer("photogrammetry.realitycapture"),
    "opensfm": Importer("photogrammetry.opensfm"),
    "kapture": Importer("datasets.published", "KAPTURE"),
    "llff": Importer("llff"),
    "colmap": Importer("colmap"),
    "mvsnet": Importer("datasets.published", "MVSNET"),
    "idr": Importer("datasets.published", "IDR"),
    "nsvf": Importer("datasets.published", "NSVF", renders=True),
    "tanks-and-temples": Importer("datasets.published", "TANKS"),
    "photographs": Importer("photographs", entry=None),
}
FORMATS = ("auto", *IMPORTERS)


def formats_of(folder: Path, settings: Any) -> list[str]:
    """The format that the settings state, else every one that the folder could be read as, the one to choose first; BadInput where there is none."""
    return candidates(folder, settings.allow_outside, settings.llff_factor) if settings.format == "auto" else [settings.format]


def candidates(folder: Path, allow_outside: bool = False, llff_factor: int | str = "auto") -> list[str]:
    """Every format that the folder could be read as, the one to choose first; BadInput where there is none.

    llff_factor  of the settings: where it is stated, LLFF is meant
    """
    if not folder.exists():
        raise BadInput(f"{folder}: no such folder. Expected a folder of photographs, a video or a posed data set.")
    if not folder.is_dir():
        if folder.suffix.lower() in SUFFIXES:
            return ["photographs"]
        raise BadInput(f"{folder}: a file; expected a folder of photographs or of a posed data set, or a video ({KNOWN}). Name the folder that holds it.")
    found = [name for name, importer in IMPORTERS.items() if importer.recognises(folder, allow_outside)]
    if not found:
        with one_line_errors(folder):
            photographs(Source(folder, allow_outside))  # anywhere below; says what is there instead
        found.append("photographs")
    if {"llff", "colmap"} <= set(found) and llff_factor == "auto":
        with one_line_errors(folder):
            richer = import_module(f"{__name__}.llff").holds_less_than_colmap(folder, allow_outside)
        if richer:
            found.remove("colmap")
            found.insert(found.index("llff"), "colmap")
    return found


def posed_format(folder: Path, settings: Any) -> str | None:
    """The format of a folder's stated cameras where it is to be read as photographs in spite of them; else None."""
    if settings.format != "photographs" or not folder.is_dir():
        return None
    try:
        name = candidates(folder, settings.allow_outside, settings.llff_factor)[0]
    except BadInput:
        return None
    return name if IMPORTERS[name].posed else None


def files(folder: Path, settings: Any) -> list[Path]:
    """The files that the poses stage depends on: those that the format reads, and for photographs those that state their cameras."""
    found, stated = set(IMPORTERS[formats_of(folder, settings)[0]].files(folder, settings)), posed_format(folder, settings)
    if stated is not None:
        with suppress(BadInput):  # reported where it is read
            found |= set(IMPORTERS[stated].files(folder, settings))
    return sorted(found)
