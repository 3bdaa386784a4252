"""The folder of a source: finding the files that its lists name, and reading them within bounds.

Data sets travel: lists hold absolute paths of another computer, extensions that have changed, files that were never copied. A listed
name is therefore searched for, in this order: as listed; with another extension; by its last parts, from the longest, inside the
source; absolute paths also by their file name alone.

Names are compared without case, and composed (NFC): archives made on macOS hold `e` and an accent where lists have one letter.

What lies outside the source folder is not read unless the user allows it. `Source.real` is the one gate: it follows the links of a path once, and the path
that it returns is the one that is opened, whatever becomes of the links later.
"""

import os
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Protocol

from efficientnerf.settings import Auto
from pipeline import files, run
from pipeline.errors import BadInput
from pipeline.text import printable
from stages.io.pictures import RAW_SUFFIXES

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp", ".heic", ".heif", ".hif", ".avif", *RAW_SUFFIXES)
MAX_FRAMES = 100_000
MAX_FILES = 1_000_000  # entries of a source folder
MAX_PATH = 4096  # characters of a listed name
MAX_DEPTH = 32  # last parts of a listed name that are searched for below the source
MIN_IMAGES = 3  # images that make a data set
MAX_NAMES = 5  # names that a message lists
MASK_ENDINGS = ("_mask", ".mask")  # of a mask that lies next to its photograph: IMG_1_mask.png


class ImportSettings(Protocol):
    """Settings of the poses stage that importers read."""

    @property
    def strict(self) -> bool: ...
    @property
    def allow_outside(self) -> bool: ...
    @property
    def llff_factor(self) -> int | Auto: ...


def abbreviated(names: Sequence[str], most: int = MAX_NAMES) -> str:
    """The first few names, and how many more there are."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def name_key(name: str) -> str:
    """The key of a name."""
    return unicodedata.normalize("NFC", name).lower()


@dataclass(frozen=True)
class Found:
    """The file of a listed name."""

    path: Path | None  # the file, or None
    elsewhere: bool = False  # whether it lies at another place than listed


@dataclass
class Source:
    """A source folder; all look-ups go through it."""

    root: Path  # the folder
    allow_outside: bool = False  # whether files outside it may be read
    llff_factor: int | Auto = "auto"  # of the settings
    runs: set[Path] = field(default_factory=set)  # run folders below it that a look-up met: they were made from the source, and are no part of it
    links: set[Path] = field(default_factory=set)  # linked folders that a look-up met and did not follow, for they lead out of it
    remarks: dict[str, None] = field(default_factory=dict)  # sentences about files that are left aside, each once
    _real: dict[Path, Path] = field(default_factory=dict)
    _names: dict[Path, str] = field(default_factory=dict)
    _taken: set[str] = field(default_factory=set)
    _folders: dict[Path, dict[str, list[Path]]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.root = Path(os.path.abspath(self.root))
        self._real[self.root] = Path(os.path.realpath(self.root))

    def name_of(self, path: Path) -> str:
        """The name of a file from here on: its path relative to the source folder, with /; for a file outside, its last two parts. Line ends, terminal
        escapes and bytes of no encoding are escaped, and no two files have one name.
        """
        if path not in self._names:
            inside = path.is_relative_to(self.root)
            plain = printable(path.relative_to(self.root).as_posix() if inside else "/".join(path.parts[-2:]).strip("/"))
            name, again = plain, 2
            while name in self._taken:
                name, again = f"{plain} ({again})", again + 1
            self._taken.add(name)
            self._names[path] = name
        return self._names[path]

    def real(self, path: Path) -> Path:
        """The file that a path leads to, without links, to be opened in its place; BadInput if that lies outside the source folder."""
        if path not in self._real:
            target = Path(os.path.realpath(path))
            if not self.allow_outside and not target.is_relative_to(self._real[self.root]):
                raise BadInput(f"{path}: leads out of the source folder {self.root} (to {target}). Copy it into the folder, or pass --allow-outside.")
            self._real[path] = target
        return self._real[path]

    def first_of(self, places: Sequence[str]) -> list[Path]:
        """The first of these files that is there, or none; raises BadInput where it leads out of the source."""
        found = next((path for place in places if (path := self.root / place).is_file()), None)
        return [] if found is None else [self.check_inside(found)]

    def check_inside(self, path: Path) -> Path:
        """The path itself, which has passed the gate; BadInput otherwise."""
        self.real(path)
        return path

    def walk(self) -> list[Path]:
        """Every file of the source in sorted order; hidden ones are left out, and so are those of run folders in it.

        Linked folders that lead out of the source are followed where that is allowed, each once; those that lead to a place within it are left out, for that
        is walked.
        """
        found: list[Path] = []
        root, seen = self._real[self.root], {_identity(self.root)}
        for parent, folders, names in os.walk(self.root, followlinks=True):
            here = Path(parent)
            if here != self.root and run.NAME in names and is_run(here):
                folders.clear()
                self.runs.add(here)
                continue
            kept = []
            for path in [here / name for name in sorted(folders) if not name.startswith(".")]:
                if path.is_symlink():
                    if Path(os.path.realpath(path)).is_relative_to(root):
                        continue
                    if not self.allow_outside:
                        self.links.add(path)
                        continue
                if self.allow_outside:
                    if (identity := _identity(path)) in seen:
                        continue
                    seen.add(identity)
                kept.append(path.name)
            folders[:] = kept
            found += [here / name for name in sorted(names) if not name.startswith(".")]
            if len(found) > MAX_FILES:
                raise BadInput(f"{self.root}: more than {MAX_FILES} files. Name the folder of the data set itself.")
        return found

    def warnings(self) -> list[str]:
        """Sentences about what look-ups came by and left aside, as they may be shown."""
        names = [self.name_of(path) for path in sorted(self.runs)]
        runs = [f"{abbreviated(names)}: {'runs' if len(names) > 1 else 'a run'} inside the source folder; what was made there is not read."] if names else []
        links = [f"{self.root}: holds {self.linked_folders()}."] if self.links else []
        return [printable(sentence) for sentence in (*runs, *links, *self.remarks)]

    def linked_folders(self) -> str:
        """A message about linked folders that were not followed."""
        names = [f"{path.relative_to(self.root)} -> {os.path.realpath(path)}" for path in sorted(self.links)]
        return f"linked folders, which are not followed ({abbreviated(names)}): name the target itself, or pass --allow-outside"

    def find(self, name: str, folder: Path | None = None, suffixes: Sequence[str] = IMAGE_SUFFIXES) -> Found:
        """The file that a list names.

        name      as listed: relative to `folder` (default: the source folder) or absolute, of any system
        suffixes  the extensions tried where the listed one is not there
        Raises BadInput where the name leads out of the source folder.
        """
        folder = folder or self.root
        if not name.strip() or len(name) > MAX_PATH or not _is_encodable(name):
            return Found(None)
        windows = ("\\" in name or PureWindowsPath(name).drive) and not os.path.isfile(folder / name)
        foreign = PureWindowsPath(name) if windows else PurePosixPath(name)
        absolute = bool(foreign.root or foreign.drive)
        parts = [part for part in foreign.parts[1 if foreign.anchor else 0 :] if part != "."]
        here = Path(name) if absolute and isinstance(foreign, PurePosixPath) else None if absolute else Path(os.path.normpath(folder.joinpath(*parts)))
        inside = here is not None and here.is_relative_to(self.root)
        if here is not None and (inside or self.allow_outside or not absolute):
            if not inside and not self.allow_outside:
                raise BadInput(f"{printable(name, 200)}: leads out of the source folder {self.root}. Copy it into the folder, or pass --allow-outside.")
            found = self._with_any_suffix(here, suffixes)
            if found is not None:
                return Found(found)
        for drop in range(max(0 if absolute else 1, len(parts) - MAX_DEPTH), len(parts)):
            found = self._with_any_suffix(self.root.joinpath(*parts[drop:]), suffixes) if ".." not in parts[drop:] else None
            if found is not None:
                return Found(found, elsewhere=True)
        if absolute and parts:
            alike = self._by_name.get(name_key(parts[-1]), [])
            if len(alike) == 1:
                return Found(self.check_inside(alike[0]), elsewhere=True)
            if here is not None and os.path.isfile(here) and not inside:
                raise BadInput(f"{printable(name, 200)}: lies outside the source folder {self.root}. Copy it into the folder, or pass --allow-outside.")
        return Found(None)

    def _with_any_suffix(self, path: Path, suffixes: Sequence[str]) -> Path | None:
        if os.path.isfile(path):
            return self.check_inside(path)
        stem = path.stem if path.suffix.lower() in suffixes else path.name
        if path.parent not in self._folders:
            stems: dict[str, list[Path]] = {}
            if os.path.isdir(path.parent) and (self.allow_outside or Path(os.path.realpath(path.parent)).is_relative_to(self._real[self.root])):
                for entry in sorted(path.parent.iterdir()):
                    stems.setdefault(name_key(entry.stem), []).append(entry)
            self._folders[path.parent] = stems
        usable = [other for other in self._folders[path.parent].get(name_key(stem), []) if other.suffix.lower() in suffixes]
        if not usable:
            return None
        composed = unicodedata.normalize("NFC", stem)
        return self.check_inside(min(usable, key=lambda other: (unicodedata.normalize("NFC", other.stem) != composed, suffixes.index(other.suffix.lower()))))

    @cached_property
    def images_by_stem(self) -> dict[str, list[Path]]:
        """Every image of the source by the key of its stem; see `walk`."""
        found: dict[str, list[Path]] = {}
        for path in self.walk():
            if path.suffix.lower() in IMAGE_SUFFIXES:
                found.setdefault(name_key(path.stem), []).append(path)
        return found

    @cached_property
    def _by_name(self) -> dict[str, list[Path]]:
        """Every file of the source by the key of its name; see `walk`."""
        found: dict[str, list[Path]] = {}
        for path in self.walk():
            found.setdefault(name_key(path.name), []).append(path)
        return found


def _identity(folder: Path) -> tuple[int, int]:
    try:
        about = folder.stat()
    except OSError:  # it has gone since it was listed
        return -1, -1
    return about.st_dev, about.st_ino


def is_run(folder: Path) -> bool:
    """Whether a folder is one that a run writes into."""
    try:
        about = files.read_json(folder / run.NAME)
    except (files.Unreadable, FileNotFoundError):
        return False
    return isinstance(about, dict) and about.get("format") == run.FORMAT


def _is_encodable(name: str) -> bool:
    """Whether a file may have this name at all: half a surrogate pair of a JSON text has no bytes."""
    try:
        return b"\0" not in os.fsencode(name)
    except UnicodeEncodeError:
        return False


def files_in(folder: Path, suffixes: Sequence[str]) -> list[Path]:
    """The files directly in a folder, if it is there, that have one of these extensions, sorted by name; without hidden ones."""
    if not os.path.isdir(folder):
        return []
    return sorted(path for path in folder.iterdir() if path.suffix.lower() in suffixes and not path.name.startswith(".") and path.is_file())


def images_in(folder: Path) -> list[Path]:
    """The image files directly in a folder, sorted by name."""
    return one_of_each(pictures_in(folder))


def pictures_in(folder: Path) -> list[Path]:
    """The same with the masks next to them, and with raw pictures that have a JPEG."""
    return files_in(folder, IMAGE_SUFFIXES)


def one_of_each(images: Sequence[Path]) -> list[Path]:
    """Without a camera's raw pictures next to the same as JPEG or the like, and without masks next to their photograph."""
    developed = {path.with_suffix("") for path in images if path.suffix.lower() not in RAW_SUFFIXES}
    named = {(path.parent, name_key(name)) for path in images for name in (path.stem, path.name)}

    def is_mask(path: Path) -> bool:
        key = name_key(path.stem)
        return any(key.endswith(ending) and (path.parent, key.removesuffix(ending)) in named for ending in MASK_ENDINGS)

    return [path for path in images if (path.suffix.lower() not in RAW_SUFFIXES or path.with_suffix("") not in developed) and not is_mask(path)]
