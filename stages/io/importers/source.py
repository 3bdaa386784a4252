"""The folder of a source: finding the files that its lists name, and reading them within bounds.

Data sets travel: lists hold absolute paths of another computer, extensions that have changed, files that were never copied. A listed
name is therefore searched for, in this order: as listed; with another extension; by its last parts, from the longest, inside the
source; absolute paths also by their file name alone. What lies outside the source folder is not read unless the user allows it.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Protocol

from efficientnerf.settings import Auto
from pipeline.errors import BadInput

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp", ".heic", ".heif", ".hif")
MAX_FRAMES = 100_000
MAX_FILES = 1_000_000  # entries of a source folder
MIN_IMAGES = 3  # images that make a data set
MAX_NAMES = 5  # names that a message lists


class ImportSettings(Protocol):
    """What importers read of the settings of the poses stage."""

    @property
    def strict(self) -> bool: ...
    @property
    def allow_outside(self) -> bool: ...
    @property
    def llff_factor(self) -> int | Auto: ...


def abbreviated(names: Sequence[str]) -> str:
    """The first few names, and how many more there are."""
    return ", ".join(names[:MAX_NAMES]) + (f" and {len(names) - MAX_NAMES} more" if len(names) > MAX_NAMES else "")


@dataclass(frozen=True)
class Found:
    """What a listed name led to.

    path  the file, or None
    how   "listed", "extension" (another one than listed) or "elsewhere" (at another place in the source)
    """

    path: Path | None
    how: str = "listed"


@dataclass
class Source:
    """A source folder; all look-ups go through it.

    root           the folder
    allow_outside  whether files outside it may be read
    """

    root: Path
    allow_outside: bool = False
    _folders: dict[Path, dict[str, list[Path]]] = field(default_factory=dict)
    _by_name: dict[str, list[Path]] | None = None

    def __post_init__(self) -> None:
        self.root = Path(os.path.abspath(self.root))

    def name_of(self, path: Path) -> str:
        """The path relative to the source folder, with /; for a file outside, its last two parts."""
        try:
            return path.relative_to(self.root).as_posix()
        except ValueError:
            return "/".join(path.parts[-2:]).strip("/")

    def check_inside(self, path: Path) -> Path:
        """The path itself; BadInput if it, or the file a link leads to, lies outside the source folder."""
        if not self.allow_outside and not path.resolve().is_relative_to(self.root.resolve()):
            raise BadInput(f"{path}: leads out of the source folder {self.root} (to {path.resolve()}). Copy it into the folder, or pass --allow-outside.")
        return path

    def find(self, name: str, beside: Path | None = None, suffixes: Sequence[str] = IMAGE_SUFFIXES) -> Found:
        """The file that a list names.

        name      as listed: relative to `beside` (default: the source folder) or absolute, of any system
        suffixes  the extensions tried where the listed one is not there
        Raises BadInput where the name leads out of the source folder.
        """
        beside = beside or self.root
        if "\0" in name or not name.strip():
            return Found(None)
        foreign = PureWindowsPath(name) if "\\" in name or PureWindowsPath(name).drive else PurePosixPath(name)
        absolute = bool(foreign.root or foreign.drive)
        parts = [part for part in foreign.parts[1 if foreign.anchor else 0 :] if part != "."]
        here = Path(name) if absolute and isinstance(foreign, PurePosixPath) else None if absolute else Path(os.path.normpath(beside.joinpath(*parts)))
        inside = here is not None and here.is_relative_to(self.root)
        if here is not None and (inside or self.allow_outside or not absolute):
            if not inside and not self.allow_outside:
                raise BadInput(f"{name}: leads out of the source folder {self.root}. Copy it into the folder, or pass --allow-outside.")
            found = self._with_any_suffix(here, suffixes)
            if found.path is not None:
                return found
        for drop in range(1 if not absolute else 0, len(parts)):
            found = self._with_any_suffix(self.root.joinpath(*parts[drop:]), suffixes) if ".." not in parts[drop:] else Found(None)
            if found.path is not None:
                return Found(found.path, "elsewhere")
        if absolute and parts:
            alike = self._index().get(parts[-1].lower(), [])
            if len(alike) == 1:
                return Found(self.check_inside(alike[0]), "elsewhere")
            if here is not None and here.is_file() and not inside:
                raise BadInput(f"{name}: lies outside the source folder {self.root}. Copy it into the folder, or pass --allow-outside.")
        return Found(None)

    def _with_any_suffix(self, path: Path, suffixes: Sequence[str]) -> Found:
        try:
            if path.is_file():
                return Found(self.check_inside(path))
        except OSError:  # a name longer than the system allows
            return Found(None)
        stem = path.stem if path.suffix.lower() in suffixes else path.name
        alike = self._folder(path.parent).get(stem.lower(), [])
        usable = [other for other in alike if other.suffix.lower() in suffixes and (other.stem.lower() == stem.lower())]
        if not usable:
            return Found(None)
        best = min(usable, key=lambda other: (other.stem != stem, suffixes.index(other.suffix.lower())))
        return Found(self.check_inside(best), "extension" if path.suffix.lower() in suffixes else "listed")

    def _folder(self, folder: Path) -> dict[str, list[Path]]:
        """The files of a folder by stem in lower case."""
        if folder not in self._folders:
            stems: dict[str, list[Path]] = {}
            if folder.is_dir() and (self.allow_outside or folder.resolve().is_relative_to(self.root.resolve())):
                for entry in sorted(folder.iterdir()):
                    stems.setdefault(entry.stem.lower(), []).append(entry)
            self._folders[folder] = stems
        return self._folders[folder]

    def _index(self) -> dict[str, list[Path]]:
        """Every file of the source by name in lower case; links to folders are not followed."""
        if self._by_name is None:
            self._by_name = {}
            for path in walk(self.root):
                self._by_name.setdefault(path.name.lower(), []).append(path)
        return self._by_name


def walk(folder: Path) -> list[Path]:
    """Every file below a folder in sorted order; hidden ones and links to folders are left out."""
    found: list[Path] = []
    for parent, folders, files in os.walk(folder):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        found += [Path(parent) / name for name in sorted(files) if not name.startswith(".")]
        if len(found) > MAX_FILES:
            raise BadInput(f"{folder}: more than {MAX_FILES} files. Name the folder of the data set itself.")
    return found


def images_in(folder: Path) -> list[Path]:
    """The image files directly in a folder, sorted by name."""
    if not folder.is_dir():
        return []
    return sorted(path for path in folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES and not path.name.startswith(".") and path.is_file())


def missing_images_warning(where: str, total: int, kept: int, missing: Sequence[str], strict: bool, remedy: str) -> list[str]:
    """The warning about images that are listed but absent, if any; BadInput where too few remain or `strict` forbids it."""
    if not missing:
        return []
    sentence = f"{where}: {len(missing)} of {total} listed images are missing: {abbreviated(missing)}."
    if kept < MIN_IMAGES:
        raise BadInput(f"{sentence} {kept} remain; at least {MIN_IMAGES} are needed. {remedy}")
    if strict:
        raise BadInput(f"{sentence} Refused by --strict. {remedy}")
    return [sentence]


def moved_images_warnings(where: str, places: Sequence[tuple[str, str]], extensions: Sequence[tuple[str, str]]) -> list[str]:
    """Warnings about images found elsewhere than listed, as (listed, found)."""
    sentences = []
    if places:
        sentences.append(f"{where}: {len(places)} images are not where they are listed and were found by name, e.g. {places[0][0]} as {places[0][1]}.")
    if extensions:
        sentences.append(f"{where}: {len(extensions)} images have another extension than listed, e.g. {extensions[0][0]} is {extensions[0][1]}.")
    return sentences
