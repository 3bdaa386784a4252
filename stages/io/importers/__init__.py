"""Formats that a capture can come in: one file each, a plain dict as the table. Nothing heavy is imported until something is read."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from pipeline.errors import BadInput
from stages.io.capture import Capture
from stages.io.importers.source import ImportSettings


@dataclass(frozen=True)
class Importer:
    """How one format is read.

    module   of this package, with recognises(folder), files(folder, settings) and, where the format states cameras, read(folder, settings)
    posed    whether the format states cameras; else they are found from the photographs
    renders  whether its images may be renders of an object on a constant background, whose alpha is coverage
    dialect  passed on to `recognises` and `read` where one module reads several formats
    """

    module: str
    posed: bool = True
    renders: bool = False
    dialect: str | None = None

    def recognises(self, folder: Path) -> bool:
        """Whether a folder holds files of this format; BadInput where they cannot be read."""
        return bool(self._call("recognises", folder))

    def read(self, folder: Path, settings: ImportSettings) -> Capture:
        """The capture; raises BadInput."""
        capture: Capture = self._call("read", folder, settings)
        return capture

    def files(self, folder: Path, settings: ImportSettings) -> list[Path]:
        """What the capture depends on; raises BadInput."""
        paths: list[Path] = import_module(f"{__name__}.{self.module}").files(folder, settings)
        return paths

    def _call(self, function: str, *arguments: Any) -> Any:
        return getattr(import_module(f"{__name__}.{self.module}"), function)(*arguments, *(() if self.dialect is None else (self.dialect,)))


# In order of preference: a folder may hold several formats.
IMPORTERS: dict[str, Importer] = {
    "blender": Importer("transforms", renders=True, dialect="blender"),
    "nerfstudio": Importer("transforms", renders=True, dialect="nerfstudio"),
    "instant-ngp": Importer("transforms", renders=True, dialect="instant-ngp"),
    "llff": Importer("llff"),
    "colmap": Importer("colmap"),
    "photographs": Importer("photographs", posed=False),
}
FORMATS = ("auto", *IMPORTERS)


def detect(folder: Path) -> str:
    """The name of the format of a source folder; BadInput where it is none."""
    return candidates(folder)[0]


def candidates(folder: Path) -> list[str]:
    """Every format that the folder could be read as, the one to choose first; BadInput where there is none."""
    if not folder.exists():
        raise BadInput(f"{folder}: no such folder. Expected a folder of photographs or a posed data set.")
    if not folder.is_dir():
        raise BadInput(f"{folder}: a file; expected a folder of photographs or of a posed data set. Name the folder that holds it.")
    found = [name for name, importer in IMPORTERS.items() if importer.recognises(folder)]
    if not found:
        from stages.io.importers.photographs import photographs

        photographs(folder)  # anywhere below; says what is there instead
        found.append("photographs")
    return found


def files(folder: Path, settings: Any) -> list[Path]:
    """What the poses stage depends on: the files of the format in question that it reads."""
    name = detect(folder) if settings.format == "auto" else settings.format
    return sorted(set(IMPORTERS[name].files(folder, settings)))
