"""Settings and options of scenes, checked as `enerf run` checks them, with all mistakes instead of the first."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pipeline.errors import Mistakes, UsageError
from pipeline.files import canonical_json
from pipeline.fleet.state import Scene
from pipeline.run import NAME as RUN_NAME
from pipeline.stage import Stage, plain, settings_from, settings_of
from pipeline.text import printable
from workflows.budget import share_budget, train_share
from workflows.cli.resolve import Settings, merged, nearest, parse_value, read_preset, seconds_of, text_of
from workflows.workflow import Workflow

Table = dict[str, dict[str, Any]]

DEFAULT_PRESET = "preview"  # where none is stated, and which settings are chosen by the device makes no difference
MOST_SHOWN = 50  # mistakes
OPTIONS = ("preset", "as", "seed", "budget")  # what a manifest has besides settings, by the names of the options of `enerf run`
# Settings that no manifest decides, for they lead out of its folder: the operator does.
GIVEN_BY_HAND = ("poses.allow_outside", "poses.mask_model", "poses.features_model", "poses.matcher_model")


class Text(str):
    """A value as the text of a CSV's cell or of an option: it is read as after `--set stage.name=`."""


@dataclass
class Choice:
    """The choices for a scene, or for all: settings that are not the preset's, and options."""

    settings: Table = field(default_factory=dict)
    preset: str | None = None
    seed: int | None = None
    budget: float | None = None

    def over(self, other: Choice) -> Choice:
        """This one where it has a value, else the other."""
        options = {name: getattr(other if getattr(self, name) is None else self, name) for name in ("preset", "seed", "budget")}
        return Choice(merged(other.settings, self.settings), **options)

    def with_budget(self, sources: Sequence[Path], workflow: Workflow) -> Table:
        """The settings, with what the budget makes of them."""
        if self.budget is None:
            return self.settings
        stated = merged(read_preset(self.preset or DEFAULT_PRESET, workflow.presets).table, self.settings)
        poses: Any = settings_from(workflow.settings["poses"], stated.get("poses", {}), where="poses")
        parts = share_budget(self.budget, train_share(sources, poses), splats=stated.get("splats", {}).get("make") != "off")
        return merged(self.settings, {stage: {"time_budget": seconds} for stage, seconds in parts.items()})


class Checker:
    """Collects mistakes while values are checked against a workflow's settings."""

    def __init__(self, workflow: Workflow, what: str) -> None:
        self.workflow = workflow
        self.what = what
        self.mistakes: list[tuple[int, str]] = []
        self._settings = Settings(workflow.settings)

    def mistake(self, text: str, *, line: int | None = None, scene: str | None = None) -> None:
        """Keep a mistake; `text` says what was found and what was expected."""
        where = ", ".join(part for part in (f"line {line}" if line else "", f"scene {printable(scene, 100)}" if scene else "") if part)
        self.mistakes.append((line or 0, f"{where}: {text}" if where else text))

    @contextmanager
    def kept(self, line: int | None = None, scene: str | None = None) -> Iterator[None]:
        """While open, a UsageError is kept as a mistake."""
        try:
            yield
        except UsageError as error:
            self.mistake(str(error).removeprefix(": ").removeprefix("--"), line=line, scene=scene)

    def end(self) -> None:
        """Raise Mistakes if there are any."""
        texts = [text for _, text in sorted(self.mistakes, key=lambda each: each[0])]
        what, more = printable(self.what, 1000), len(texts) - MOST_SHOWN
        if len(texts) == 1:
            raise Mistakes(f"{what}: {texts[0]}", ())
        if texts:
            raise Mistakes(f"{what}: {len(texts)} mistakes; nothing was run:", (*texts[:MOST_SHOWN], *([f"and {more} more"] if more > 0 else [])))

    def value(self, stage: str, name: str, value: Any, *, by_hand: bool = False) -> Any:
        """A setting's value as JSON holds it, of a manifest or, `by_hand`, of the command line. Raises UsageError."""
        if f"{stage}.{name}" in GIVEN_BY_HAND and not by_hand:
            raise UsageError(f"{stage}.{name}: found in a manifest, expected on the command line alone (--set {stage}.{name}=VALUE).")
        self._settings.put(stage, name, parse_value(str(value).strip()) if isinstance(value, Text) else [value], "")
        return plain(self._settings.values[stage][name])

    def given(self, table: Mapping[str, Mapping[str, Any]], seed: int | None = None) -> Table:
        """Settings of the command line, whose values may be Text, as JSON holds them. Raises UsageError, for a seed that no stage takes, too."""
        if seed is not None:
            self._settings.put_seed(seed)
        return {stage: {name: self.value(stage, name, value, by_hand=True) for name, value in entries.items()} for stage, entries in table.items()}

    def choice(self, values: Mapping[str, Any], line: int | None = None, scene: str | None = None) -> Choice:
        """What a manifest has for a scene, or for all: OPTIONS, and tables of settings; what is wrong is kept as mistakes."""
        found = Choice()
        for name in (key for key in values if key in OPTIONS):
            with self.kept(line, scene):
                self._option(found, name, values[name])
        for stage, entries in values.items():
            if stage in OPTIONS:
                continue
            if not isinstance(entries, Mapping) or not entries:
                self.unknown(stage, line, scene)
                continue
            for name, value in entries.items():
                with self.kept(line, scene):
                    found.settings.setdefault(stage, {})[name] = self.value(stage, name, value)
        return found

    def unknown(self, key: str, line: int | None = None, scene: str | None = None) -> None:
        """A key that is neither an option nor a stage with settings."""
        if key in self._settings.types:
            self.mistake(f"{key}: found no table of settings, expected {key}.NAME = VALUE.", line=line, scene=scene)
            return
        known = ["source", "sources", *OPTIONS, *self._settings.types]
        text = f"found {printable(key, 100)!r}, expected source, sources, {', '.join(OPTIONS)} or the settings of a stage.{nearest(key, known)}"
        self.mistake(text, line=line, scene=scene)

    def _option(self, found: Choice, name: str, value: Any) -> None:
        if name == "seed":
            try:
                found.seed = int(value) if isinstance(value, Text) else value
            except ValueError:
                found.seed = None
            if type(found.seed) is not int:
                raise UsageError(f"seed: found {text_of(value, 100)}, expected a whole number.")
            self._settings.put_seed(found.seed)
        elif not isinstance(value, str):
            raise UsageError(f"{name}: found {text_of(value, 100)}, expected text.")
        elif name == "preset":
            found.preset = read_preset(str(value), self.workflow.presets).name
        elif name == "as":
            found.settings.setdefault("poses", {})["format"] = self.value("poses", "format", str(value))
        else:
            found.budget = seconds_of(str(value))


def table_of_options(texts: Sequence[str], workflow: Workflow) -> Table:
    """The settings of `--set stage.name=value` for all scenes; each value is still Text, and checked. Raises UsageError."""
    checked = Settings(workflow.settings)
    found: Table = {}
    for text in texts:
        stage, name, value = checked.put_option(text)
        found.setdefault(stage, {})[name] = Text(value)
    return found


def refuse_what_cannot_work(scenes: Sequence[Scene], workflow: Workflow, fleet: Path, what: str) -> None:
    """Raise Mistakes for the scenes whose settings a stage cannot work with (`Stage.check`); those that were begun are left to their runs.

    what  was given, the beginning of the message
    """
    checker = Checker(workflow, what)
    refused: dict[bytes, str | None] = {}  # scenes are many, and their settings few
    for scene in scenes:
        if (fleet / scene.name / RUN_NAME).is_file():
            continue
        preset = scene.preset or DEFAULT_PRESET
        key = canonical_json([preset, scene.settings])
        if key not in refused:
            refused[key] = _why_refused(merged(read_preset(preset, workflow.presets).table, scene.settings), workflow.stages)
        if (why := refused[key]) is not None:
            checker.mistake(why, scene=scene.name)
    checker.end()


def _why_refused(given: Table, stages: Sequence[Stage]) -> str | None:
    settings = settings_of(stages, given)
    try:
        for stage in stages:
            if stage.check is not None:
                stage.check(settings)
    except UsageError as error:
        return str(error)
    return None
