"""Formats that a capture can come in: one file each, a plain dict as the table. Nothing heavy is imported until something is read."""

from __future__ import annotations

from collections.abc import Callable
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

    module  of this package, with files(folder, settings), and read(folder, settings) where the format states cameras
    posed   whether the format states cameras; else they are found from the photographs
    dialect passed on to `read` where one module reads several
    """

    module: str
    posed: bool = True
    dialect: str | None = None

    def read(self, folder: Path, settings: ImportSettings) -> Capture:
        """The capture; raises BadInput."""
        reader: Callable[..., Capture] = import_module(f"stages.io.importers.{self.module}").read
        return reader(folder, settings) if self.dialect is None else reader(folder, settings, self.dialect)

    def files(self, folder: Path, settings: ImportSettings) -> list[Path]:
        """What the capture depends on; raises BadInput."""
        lister: Callable[..., list[Path]] = import_module(f"stages.io.importers.{self.module}").files
        return lister(folder, settings)


# In the order in which they are looked for: a folder may hold several, and the most explicit one counts.
IMPORTERS: dict[str, Importer] = {
    "blender": Importer("transforms", dialect="blender"),
    "nerfstudio": Importer("transforms", dialect="nerfstudio"),
    "instant-ngp": Importer("transforms", dialect="instant-ngp"),
    "llff": Importer("llff"),
    "colmap": Importer("colmap"),
    "photographs": Importer("photographs", posed=False),
}
FORMATS = ("auto", *IMPORTERS)


@dataclass(frozen=True)
class ReadingDefaults:
    """What `describe` reads with."""

    strict: bool = False
    allow_outside: bool = False
    llff_factor: int | None = None


def detect(folder: Path) -> str:
    """The name of the format of a source folder; BadInput where it is none."""
    return candidates(folder)[0]


def candidates(folder: Path) -> list[str]:
    """Every format that the folder could be read as, the one to choose first; BadInput where there is none."""
    if not folder.exists():
        raise BadInput(f"{folder}: no such folder. Expected a folder of photographs or a posed data set.")
    if not folder.is_dir():
        raise BadInput(f"{folder}: a file; expected a folder of photographs or of a posed data set. Name the folder that holds it.")
    from stages.io.importers import colmap, llff, photographs, transforms
    from stages.io.importers.source import images_in

    found = []
    if transforms.json_files(folder):
        found.append(transforms.dialect(folder))
    if (folder / llff.POSES).is_file():
        found.append("llff")
    if colmap.model_folders(folder):
        found.append("colmap")
    if images_in(folder) or images_in(folder / "images"):
        found.append("photographs")
    elif not found:
        photographs.photographs(folder)  # anywhere below; says what is there instead
        found.append("photographs")
    return found


def files(folder: Path, settings: Any) -> list[Path]:
    """What the poses stage depends on: the files of the format in question that it reads."""
    name = detect(folder) if settings.format == "auto" else settings.format
    return sorted(set(IMPORTERS[name].files(folder, settings)))


def describe(source: Path, format: str = "auto") -> dict[str, Any]:
    """What `enerf inspect SOURCE` prints of a data set as it stands; raises BadInput."""
    from stages.io.importers.description import describe_source

    return describe_source(source, format)
