"""The manifest of a fleet: a TOML file, a CSV file, a folder of scenes, or a glob, read into the scenes of `pipeline.fleet.state`.

    preset = "preview"                  # for all scenes; so are as, seed, budget
    train.iterations = 4000             # settings for all scenes

    [scenes.chair]                      # the run FLEET/chair/
    source = "shoots/chair"             # or sources = ["shoots/chair", "clips/chair.mp4"]
    preset = "standard"
    bake.max_mib = 8

A CSV has a scene a line and the same keys as columns: name, source (which may stand several times), preset, as, seed, budget, and stage.setting.

A manifest may be untrusted. It is small, its names name folders, and its sources lie in its own folder or in one that the operator gave.
All mistakes are reported at once, before anything runs.
"""

import csv
import glob
import io
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from pipeline.errors import UsageError
from pipeline.fleet.state import MOST_SCENES, Scene, is_scene_name
from pipeline.run import MOST_SOURCES
from pipeline.text import printable
from stages.formats.importers.photographs import is_video
from workflows.cli.resolve import parse_toml, read_text, text_of
from workflows.fleet.checked import OPTIONS, Checker, Choice, Text
from workflows.fleet.folders import folder_entries, glob_entries, listed_entries
from workflows.workflow import Workflow

MAX_BYTES = 4 * 2**20
MAX_COLUMNS = 300
SUFFIXES = (".toml", ".csv")
NAME_RULE = "letters, digits, '.', '_' and '-', a letter or digit first, at most 100, and none of the fleet's own files"


@dataclass
class Entry:
    """A scene as it was written."""

    name: str
    sources: list[Any]
    values: dict[str, Any] = field(default_factory=dict)
    line: int | None = None  # of a CSV


def read_manifest(given: Sequence[str], workflow: Workflow, fleet: Path, *, over: Choice | None = None, roots: Sequence[Path] = ()) -> list[Scene]:
    """The scenes of what a command line names. Raises UsageError; Mistakes, which has them all, for what is wrong in it.

    given  a manifest, a folder of scenes, a glob, or several folders and videos
    fleet  the fleet's folder: what it has begun may have lost its sources
    over   what the command line sets for all scenes, over the manifest; its values may be Text
    roots  folders besides the manifest's own that its sources may lie in
    """
    checker = Checker(workflow, given[0] if len(given) == 1 else f"{len(given)} sources")
    common = Choice()
    if len(given) == 1 and given[0].lower().endswith(SUFFIXES) and not Path(given[0]).is_dir():
        path = Path(given[0])
        base = path.absolute().parent
        root: Path | None = base
        common, entries = (_toml if path.suffix.lower() == ".toml" else _csv)(read_text(path, MAX_BYTES), checker)
    else:
        base = Path()  # the working folder, which may be gone: absolute sources need none
        is_pattern = glob.has_magic(given[0]) and not os.path.lexists(given[0])
        found, root = listed_entries(given) if len(given) > 1 else glob_entries(given[0]) if is_pattern else folder_entries(given[0], fleet)
        entries = [Entry(name, [source]) for name, source in found]
    if not entries and not checker.mistakes:
        raise UsageError(f"{printable(checker.what, 1000)}: holds no scenes; expected folders or videos, each of one scene.")
    if len(entries) > MOST_SCENES:
        raise UsageError(f"{printable(checker.what, 1000)}: found {len(entries)} scenes, expected at most {MOST_SCENES}.")
    _check_names(entries, checker)
    over = over or Choice()
    over = replace(over, settings=Checker(workflow, "--set").given(over.settings, over.seed))
    reader = _Reader(checker, base, None if root is None else [root, *roots], fleet, common, over)
    scenes = [reader.scene(entry) for entry in entries]
    checker.end()
    return scenes


def _toml(text: str, checker: Checker) -> tuple[Choice, list[Entry]]:
    """The choices for all scenes, and the scenes."""
    try:
        content = parse_toml(text, MAX_BYTES)
    except ValueError as error:
        raise UsageError(f"{checker.what}: not valid TOML: {printable(error, 300)}.") from None
    tables = content.pop("scenes", {})
    if not isinstance(tables, dict):
        checker.mistake("scenes: found no tables, expected [scenes.NAME].")
        tables = {}
    common = checker.choice(content)
    entries = []
    for name, table in tables.items():
        if not isinstance(table, dict):
            checker.mistake(f"found {text_of(table, 100)}, expected a table with source = ...", scene=name)
            continue
        stated = [table.pop(key) for key in ("source", "sources") if key in table]
        listed = [each if isinstance(each, list) else [each] for each in stated]
        entries.append(Entry(name, [source for each in listed for source in each], table))
    return common, entries


def _csv(text: str, checker: Checker) -> tuple[Choice, list[Entry]]:
    """As `_toml`, of a table whose first line names its columns; separated by commas, semicolons or tabs."""
    head = text.partition("\n")[0]
    separator = max(",;\t", key=head.count)
    rows = csv.reader(io.StringIO(text, newline=""), delimiter=separator, strict=True)
    entries: list[Entry] = []
    columns: list[str] = []
    try:
        for row in rows:
            cells = [cell.strip() for cell in row]
            if not any(cells):
                continue
            if not columns:
                columns = cells
                _check_columns(columns, checker)
            elif len(cells) > len(columns):
                checker.mistake(f"found {len(cells)} columns, expected {len(columns)}.", line=rows.line_num)
            elif len(entries) <= MOST_SCENES:
                entries.append(_row(columns, cells, rows.line_num))
    except csv.Error as error:
        raise UsageError(f"{checker.what}: line {rows.line_num}: not valid CSV: {error}.") from None
    return Choice(), entries


def _check_columns(columns: list[str], checker: Checker) -> None:
    if len(columns) > MAX_COLUMNS:
        raise UsageError(f"{checker.what}: found {len(columns)} columns, expected at most {MAX_COLUMNS}.")
    if "name" not in columns or "source" not in columns:
        checker.mistake(f"found the columns {printable(', '.join(columns), 200)}, expected name and source among them.", line=1)
    for column in columns:
        if column != "source" and columns.count(column) > 1:
            checker.mistake(f"found the column {printable(column, 100)!r} twice, expected it once.", line=1)
            return
        if "." not in column and column not in ("name", "source", *OPTIONS):
            checker.unknown(column, 1)


def _row(columns: list[str], cells: list[str], line: int) -> Entry:
    """A scene of a line; empty cells say nothing."""
    entry = Entry("", [], {}, line)
    for column, cell in zip(columns, cells, strict=False):
        stage, dot, name = column.partition(".")
        if column == "name":
            entry.name = cell
        elif cell and column == "source":
            entry.sources.append(cell)
        elif cell and column in OPTIONS:
            entry.values[column] = Text(cell)
        elif cell and dot:
            entry.values.setdefault(stage, {})[name] = Text(cell)
    return entry


def _check_names(entries: Sequence[Entry], checker: Checker) -> None:
    first: dict[str, Entry] = {}
    for entry in entries:
        if not is_scene_name(entry.name):
            checker.mistake(f"found the name {printable(entry.name, 100)!r}, expected {NAME_RULE}.", line=entry.line)
            continue
        before = first.setdefault(entry.name.casefold(), entry)
        if before is not entry:
            other = f"that of line {before.line}" if before.line else f"that of {printable(before.sources[0], 200)}"
            checker.mistake(
                f"found the name again that {other} has (whatever its case), expected another: it names a folder.", line=entry.line, scene=entry.name
            )


@dataclass
class _Reader:
    """Makes scenes of entries."""

    checker: Checker
    base: Path  # what relative sources are relative to
    inside: list[Path] | None  # folders that sources may lie in; None: anywhere, the operator gave each
    fleet: Path
    common: Choice
    over: Choice

    def scene(self, entry: Entry) -> Scene:
        """The scene of an entry; mistakes are kept."""
        sources = tuple(self._sources(entry))
        own = self.checker.choice(entry.values, entry.line, entry.name)
        choice = self.over.over(own.over(self.common))
        settings = choice.with_budget(sources, self.checker.workflow)
        return Scene(entry.name, tuple(map(str, sources)), settings, choice.preset, choice.seed)

    def _sources(self, entry: Entry) -> Iterator[Path]:
        if not 0 < len(entry.sources) <= MOST_SOURCES:
            self.checker.mistake(f"found {len(entry.sources)} sources, expected 1 to {MOST_SOURCES}.", line=entry.line, scene=entry.name)
            return
        real = []
        for source in entry.sources:
            if (why := self._wrong(entry, source)) is not None:
                self.checker.mistake(why, line=entry.line, scene=entry.name)
                continue
            path = Path(os.path.abspath(self.base / source))
            real.append(os.path.realpath(path))
            yield path
        if len(set(real)) < len(real):
            self.checker.mistake("found a source twice, expected each once.", line=entry.line, scene=entry.name)

    def _wrong(self, entry: Entry, source: Any) -> str | None:
        """What is wrong with a source, or None."""
        if not isinstance(source, str) or not source or "\0" in source or len(source) > 4096:
            return f"source: found {text_of(source, 100)}, expected the path of a folder or of a video."
        path, shown = self.base / source, printable(source, 300)
        try:
            real = os.path.realpath(path)
            if self.inside is not None and not any(Path(real).is_relative_to(os.path.realpath(root)) for root in self.inside):
                return f"source: found {shown}, which leads out of {self.inside[0]}; expected a path in it. To allow others: --root FOLDER"
            if os.path.exists(path):
                return None if os.path.isdir(path) or is_video(path) else f"source: found the file {shown}, expected a folder or a video."
        except (OSError, ValueError):
            return f"source: found {shown}, which is no path, expected that of a folder or of a video."
        begun = is_scene_name(entry.name) and (self.fleet / entry.name / "run.json").is_file()
        return None if begun else f"source: found {shown}, which does not exist, expected a folder or a video."
