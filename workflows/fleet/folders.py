"""Scenes that no manifest lists: those of a folder, of a glob, or given one by one. Each is (name, source)."""

import glob
import itertools
import os
import re
from collections.abc import Sequence
from pathlib import Path

from pipeline.errors import BadInput, UsageError
from pipeline.fleet.state import MOST_SCENES, is_scene_name
from pipeline.run import NAME as RUN
from pipeline.text import printable
from stages.formats.importers import IMPORTERS
from stages.formats.importers.photographs import is_video
from stages.formats.importers.source import images_in

Found = list[tuple[str, str]]

_ENTRIES = 200_000  # of a folder, or paths that a pattern fits, that are read


def folder_entries(given: str, fleet: Path) -> tuple[Found, Path | None]:
    """The folders and videos in a folder, and the folder that they may not lead out of. Raises UsageError and BadInput."""
    folder = Path(given)
    if not folder.exists():
        raise BadInput(f"{given}: no such file or folder. Give a manifest (.toml, .csv), a folder of scenes, or a glob in quotes.")
    if not folder.is_dir():
        remedy = f"One video is one scene: enerf run {given} --out RUN" if is_video(folder) else "Give a manifest (.toml, .csv) or a folder of scenes."
        raise BadInput(f"{given}: is a file; expected a manifest or a folder of scenes. {remedy}")
    scene = _format_of(folder)
    if scene is not None:
        raise BadInput(
            f"{given}: is one scene ({scene}); expected a folder of scenes. Give the folder above it, a glob as '{given}/*/', or: enerf run {given} --out RUN"
        )
    with os.scandir(folder) as entries:
        found = sorted(entry.name for entry in itertools.islice(entries, _ENTRIES) if not entry.name.startswith("."))
    kept = [name for name in found if (folder / name).is_dir() or is_video(folder / name)]
    own = os.path.realpath(fleet)
    kept = [name for name in kept if os.path.realpath(folder / name) != own and not os.path.lexists(folder / name / RUN)]
    return [(_stem(folder / name), str(folder / name)) for name in kept], folder.absolute()


def _format_of(folder: Path) -> str | None:
    """The kind of a folder that is one scene: a data set, or photographs. Videos in it are scenes each."""
    for name, importer in IMPORTERS.items():
        if name != "photographs" and importer.recognises(folder):
            return name
    return "photographs" if images_in(folder) or images_in(folder / "images") else None


def glob_entries(pattern: str) -> tuple[Found, Path | None]:
    """Paths that match a pattern, each named by the parts that its wildcards match: of `shoots/*/photos/` by the folder between."""
    if "**" in pattern or "\0" in pattern:
        raise UsageError(f"{printable(pattern, 300)}: found '**', expected a pattern of *, ? and [...], as 'shoots/*/'.")
    parts = Path(pattern).parts
    wild = [place for place, part in enumerate(parts) if glob.has_magic(part)]
    root = Path(*parts[: wild[0]]) if wild[0] else Path()
    found: Found = []
    for path in sorted(itertools.islice(glob.iglob(pattern), _ENTRIES)):
        names = Path(path).parts
        found.append((named("-".join(_stem(Path(names[place])) for place in wild)), path))
    if not found:
        raise BadInput(f"{printable(pattern, 300)}: fits nothing; expected folders or videos, each of one scene.")
    return [(name, path) for name, path in found if os.path.isdir(path) or is_video(Path(path))], root.absolute()


def listed_entries(given: Sequence[str]) -> tuple[Found, Path | None]:
    """Folders and videos that were given one by one, as by a shell that expands a pattern; named by their last part, or by what differs."""
    if any(each.lower().endswith((".toml", ".csv")) for each in given):
        raise UsageError("several manifests, or a manifest together with sources; expected one manifest, or sources alone.")
    if len(given) > MOST_SCENES:
        raise UsageError(f"found {len(given)} sources, expected at most {MOST_SCENES}.")
    paths = [Path(os.path.abspath(each)) for each in given]
    names = [_stem(path) for path in paths]
    if len(set(names)) < len(names) and len({len(path.parts) for path in paths}) == 1:
        columns = list(zip(*(path.parts for path in paths), strict=True))
        differing = [place for place, column in enumerate(columns) if len(set(column)) > 1]
        names = [named("-".join(path.parts[place] for place in differing)) for path in paths]
    return list(zip(names, map(str, paths), strict=True)), None


def _stem(path: Path) -> str:
    return named(path.stem if is_video(path) else path.name)


def named(text: str) -> str:
    """A name that a scene may have, of a folder's: other characters become "_"."""
    name = re.sub(r"[^\w.-]", "_", text)[:60]
    return name if is_scene_name(name) else f"scene_{name}"
