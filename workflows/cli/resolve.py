"""Settings of all stages from presets, files and options: names and values are checked, later sources override earlier ones.

The order is: the defaults of the dataclasses, the preset, the configuration file, `--set`, the dedicated options. A table is a
mapping `{stage: {setting: value}}`.
"""

import difflib
import functools
import re
import tomllib
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pipeline import files
from pipeline.errors import BadInput, UnknownSetting, UsageError
from pipeline.stage import settings_dict, settings_from
from pipeline.text import printable
from stages.settings import SettingInfo, describe_settings
from workflows.asset import WORKFLOW

Table = Mapping[str, Mapping[str, Any]]
# Besides the tables of the stages, a configuration file may hold the values of the dedicated options.
CONFIG_OPTIONS = {"preset": str, "device": str, "seed": int}
MAX_TOML = 2**16  # bytes; all settings together are a tenth of it
MAX_SHOWN = 200  # characters of a value in a message
_MAX_DOTS = 1000  # on a line: tomllib takes memory by the square of a key's parts


@dataclass(frozen=True)
class Preset:
    """A preset, read."""

    name: str
    description: str
    inherits: str | None  # the preset that it changes, or None
    own: Table  # the table of its file
    table: Table  # `own` over the table of the preset that it inherits from


@dataclass(frozen=True)
class Config:
    """A configuration file, read: the tables of the stages and the options in CONFIG_OPTIONS."""

    table: Table
    options: Mapping[str, Any] = field(default_factory=dict)


def nearest(name: str, known: Iterable[str]) -> str:
    """` Nearest: x.` or nothing, for the end of an error message."""
    found = difflib.get_close_matches(name[:MAX_SHOWN], list(known), n=1, cutoff=0.5)
    return f" Nearest: {found[0]}." if found else ""


def check_stage(name: str | None, known: Collection[str], option: str = "") -> None:
    """Raise UsageError for a stage that does not exist; None is none."""
    if name is not None and name not in known:
        raise UsageError(f"{option}{name}: no such stage.{nearest(name, known)} Stages: {', '.join(known)}.")


def preset_names(folder: Path = WORKFLOW.presets) -> list[str]:
    """Names of the presets in a folder, those that are shipped by default."""
    return sorted(path.stem for path in folder.glob("*.toml"))


def merged(table: Table, over: Table) -> dict[str, dict[str, Any]]:
    """The values of one table, and those of another over them."""
    return {stage: {**table.get(stage, {}), **over.get(stage, {})} for stage in {**table, **over}}


@functools.cache
def read_preset(name: str, folder: Path = WORKFLOW.presets) -> Preset:
    """A preset with what it inherits. Raises UsageError for an unknown name and for a cycle."""
    return _read_preset(name, folder, ())


def _read_preset(name: str, folder: Path, heirs: tuple[str, ...]) -> Preset:
    """heirs: the presets that led here, each of which inherits from the one after it."""
    origin = f"preset {heirs[-1]}: inherits {name!r}" if heirs else f"--preset {printable(name, MAX_SHOWN)}"
    if name not in preset_names(folder):
        raise UsageError(f"{origin}: no such preset.{nearest(name, preset_names(folder))} There are: {', '.join(preset_names(folder))}.")
    if name in heirs:
        raise UsageError(f"{origin}: a preset cannot inherit from itself ({' -> '.join((*heirs, name))}).")
    own = tomllib.loads((folder / f"{name}.toml").read_text(encoding="utf-8"))
    description, inherits = own.pop("description"), own.pop("inherits", None)
    parent = {} if inherits is None else _read_preset(inherits, folder, (*heirs, name)).table
    return Preset(name, description, inherits, own, merged(parent, own))


def read_config(path: Path) -> Config:
    """A configuration file. Raises UsageError, BadInput and UnknownSetting."""
    content = read_toml("--config", path)
    options = {name: content.pop(name) for name in CONFIG_OPTIONS if name in content}
    for name, value in options.items():
        if type(value) is not CONFIG_OPTIONS[name]:
            expected = "a whole number" if CONFIG_OPTIONS[name] is int else "text"
            raise UsageError(f"--config {path}: {name}: found {text_of(value)}, expected {expected}.")
    for name, value in content.items():
        if not isinstance(value, dict):
            raise UnknownSetting(
                f"--config {path}: {printable(name, MAX_SHOWN)} stands outside a table; expected [stage] tables and {', '.join(CONFIG_OPTIONS)}."
            )
    return Config(content, options)


def read_toml(option: str, path: Path) -> dict[str, Any]:
    """The TOML file that an option names. Raises UsageError and BadInput."""
    try:
        return parse_toml(read_text(path, MAX_TOML, f"{option} "))
    except ValueError as error:
        raise BadInput(f"{option} {path}: not valid TOML: {printable(error, 300)}.") from None


def read_text(path: Path, limit: int, option: str = "") -> str:
    """The text of a plain file of at most so many bytes; spreadsheets write a mark before it. Raises UsageError, whose text begins with the option."""
    try:
        with open(files.open_plain(path), "rb") as file:
            data = file.read(limit + 1)
    except (OSError, ValueError) as error:
        raise UsageError(f"{option}{path}: cannot be read ({getattr(error, 'strerror', None) or error}).") from None
    if len(data) > limit:
        raise UsageError(f"{option}{path}: larger than {limit} bytes.")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise UsageError(f"{option}{path}: byte {error.start} is no UTF-8; expected a text file.") from None


def parse_toml(text: str, limit: int = MAX_TOML) -> dict[str, Any]:
    """An untrusted TOML document. Raises ValueError, UnicodeDecodeError and tomllib.TOMLDecodeError being such."""
    if len(text) > limit:
        raise ValueError(f"larger than {limit} bytes")
    if any(line.count(".") > _MAX_DOTS for line in text.splitlines()):
        raise ValueError(f"more than {_MAX_DOTS} dots on a line")
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise ValueError("nested too deeply") from None


def text_of(value: Any, limit: int = MAX_SHOWN) -> str:
    """A value as a message shows it; Python writes out no number of more than 4300 digits, and nothing that nests deeply."""
    try:
        return printable(repr(value), limit)
    except RecursionError:
        return "a value that nests too deeply"
    except ValueError:
        return "a number that is too long"


def parse_value(text: str) -> list[Any]:
    """Readings of the text of a `--set`, the likeliest first: a TOML value, a list without its brackets, the text itself."""
    readings: list[Any] = []
    for candidate in (text, f"[{text}]") if "," in text else (text,):
        try:
            parsed = parse_toml(f"value = {candidate}")
        except ValueError:
            continue
        if parsed.keys() == {"value"}:
            readings.append(parsed["value"])
    return [*readings, text]


def seconds_of(text: str) -> float:
    """Seconds in `90`, `90s`, `10m` or `1h30m`."""
    found = re.fullmatch(r"(?:(\d+(?:\.\d+)?)h)?(?:(\d+(?:\.\d+)?)m)?(?:(\d+(?:\.\d+)?)s?)?", text.strip())
    if found is None or not any(found.groups()):
        raise UsageError(f"--budget {printable(text, MAX_SHOWN)}: expected a time, as in 90s, 10m or 1h30m.")
    hours, minutes, seconds = (float(part or 0) for part in found.groups())
    return 3600 * hours + 60 * minutes + seconds


def metres_of(text: str, option: str = "--marker-size") -> float:
    """Metres in `50mm`, `5cm`, `0.05m` or `2in`, above zero. Raises UsageError."""
    found = re.fullmatch(r"(\d+(?:\.\d+)?) ?(mm|cm|m|in)", text.strip())
    if found is None or not float(found[1]):
        raise UsageError(f"{option} {printable(text, MAX_SHOWN)}: expected a length with its unit, as in 50mm, 5cm, 0.05m or 2in.")
    return float(found[1]) * {"mm": 0.001, "cm": 0.01, "m": 1.0, "in": 0.0254}[found[2]]


FORMER = {("train", "near_plane"): 0.0}  # defaults of 0.1.0 that are no settings of their own any more


class Settings:
    """Builder of the settings of all stages; every value is checked when it is put."""

    def __init__(self, types: Mapping[str, type]) -> None:
        self.types = dict(types)  # {stage: its settings dataclass}
        self.about: dict[str, dict[str, SettingInfo]] = {
            stage: {info.name: info for info in describe_settings(settings_type)} for stage, settings_type in types.items()
        }
        self.values: dict[str, dict[str, Any]] = {stage: {} for stage in types}

    def _info(self, stage: str, name: str, origin: str) -> SettingInfo:
        if stage not in self.about:
            raise UnknownSetting(f"{origin}: no stage {printable(stage, MAX_SHOWN)!r}.{nearest(stage, self.about)} Stages: {', '.join(self.about)}.")
        if name not in self.about[stage]:
            known = [f"{stage}.{entry}" for entry in self.about[stage]]
            close = nearest(f"{stage}.{name}", known) or nearest(name, [f"{s}.{n}" for s in self.about for n in self.about[s]])
            raise UnknownSetting(f"{origin}: no setting {stage}.{printable(name, MAX_SHOWN)}.{close} 'enerf presets {stage}' lists them.")
        return self.about[stage][name]

    def put(self, stage: str, name: str, readings: Sequence[Any], origin: str) -> None:
        """Set one value: the first reading that fits. `origin` begins the error message."""
        self._info(stage, name, origin)
        refused = None
        for reading in readings:
            try:
                checked: Any = settings_from(self.types[stage], {name: reading}, where=stage)
                self.values[stage][name] = getattr(checked, name)
                return
            except UsageError as error:
                refused = refused or error
        text = f"{origin}: {refused}"
        raise UsageError(f"{text if text.endswith(('.', '?')) else f'{text}.'} 'enerf presets {stage}' says what it means.")

    def put_table(self, table: Table, origin: str) -> None:
        for stage, entries in table.items():
            if not entries and stage not in self.about:
                self._info(stage, "", origin)
            for name, value in entries.items():
                self.put(stage, name, [value], origin)

    def put_recorded(self, table: Table) -> list[str]:
        """Put recorded settings; returns those that this version does not have or does not admit."""
        dropped = []
        for stage, entries in table.items():
            for name, value in entries.items():
                if name not in self.about.get(stage, {}) or FORMER.get((stage, name)) == value:
                    dropped.append(f"{stage}.{name}")  # without a search for the nearest: there may be any number
                    continue
                try:
                    self.put(stage, name, [value], "run.json")
                except UsageError:
                    dropped.append(f"{stage}.{name}")
        return dropped

    def put_option(self, text: str) -> tuple[str, str, str]:
        """One `--set stage.name=value`; returns the three."""
        path, equals, value = text.partition("=")
        stage, dot, name = path.strip().partition(".")
        origin = f"--set {printable(text, MAX_SHOWN)}"
        if not equals or not dot or not name:
            raise UsageError(f"{origin}: expected stage.name=value, as in --set train.iterations=2000.")
        self.put(stage, name, parse_value(value.strip()), origin)
        return stage, name, value.strip()

    def put_seed(self, seed: int) -> None:
        """Set `seed` in every stage that has it."""
        for stage, entries in self.about.items():
            if "seed" in entries:
                self.put(stage, "seed", [seed], f"--seed {text_of(seed)}")

    def resolved(self) -> dict[str, Any]:
        """{stage: an instance of its settings dataclass}."""
        return {stage: settings_type(**self.values[stage]) for stage, settings_type in self.types.items()}


def table_of(settings: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Resolved settings as plain values of JSON."""
    return {stage: settings_dict(instance) for stage, instance in settings.items()}


def shown(value: Any) -> str:
    """A value as it is written after `--set stage.name=`."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(shown(item) for item in value) + "]"
    return f"{value}"


def meaning(info: SettingInfo) -> str:
    """What a setting means, as a sentence with its unit."""
    unit = f" ({info.unit})" if info.unit else ""
    return f"{info.doc.rstrip('.')}{unit}."
