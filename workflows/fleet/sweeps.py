"""Sweeps: `--sweep train.iterations=2000,4000 --sweep bake.max_mib=8,24` makes of each scene one for each combination of values.

Scenes share common stages: a stage whose settings, and those of all before it, are equal for the same sources is the same request, and so the
same artifact (`pipeline.sharing`). `shared` says of which scene each stage is taken.
"""

import hashlib
import itertools
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from pipeline.errors import UsageError
from pipeline.files import canonical_json
from pipeline.fleet.state import MOST_SCENES, Scene, is_scene_name
from pipeline.stage import Stage
from pipeline.text import printable
from workflows.fleet.checked import Checker, Text
from workflows.workflow import Workflow

_MOST_VALUES = 1000  # of one setting
_EXPECTED = "expected stage.name=VALUE,VALUE, as in --sweep train.iterations=2000,4000."


@dataclass(frozen=True)
class Sweep:
    """A setting and the values that it takes, as JSON holds them, each once."""

    stage: str
    name: str
    values: tuple[Any, ...]

    @property
    def setting(self) -> str:
        return f"{self.stage}.{self.name}"


def read_sweeps(texts: Sequence[str], workflow: Workflow) -> list[Sweep]:
    """Those of the command line's `--sweep`. Raises UsageError: Mistakes for several."""
    checker = Checker(workflow, "--sweep")
    found: dict[str, Sweep] = {}
    for text in texts:
        setting, equals, listed = text.partition("=")
        stage, dot, name = setting.strip().partition(".")
        values = split_values(listed)
        if not equals or not dot or not name or not 0 < len(values) <= _MOST_VALUES:
            checker.mistake(f"found {printable(text, 200)!r}, {_EXPECTED}")
            continue
        if setting.strip() in found:
            checker.mistake(f"found {printable(setting, 200)} twice, expected all of its values in one --sweep.")
            continue
        checked = []
        for value in values:
            with checker.kept():
                checked.append(checker.value(stage, name, Text(value), by_hand=True))
        once = {canonical_json(value): value for value in checked}
        found[setting.strip()] = Sweep(stage, name, tuple(once.values()))
    checker.end()
    return list(found.values())


def split_values(text: str) -> list[str]:
    """The values between commas; a list in brackets is one value."""
    values = [value.strip() for value in re.split(r",(?![^\[]*\])", text)]
    return values if all(values) else []


def swept(scenes: Sequence[Scene], sweeps: Sequence[Sweep], stages: Sequence[Stage]) -> list[Scene]:
    """Each scene with each combination of values, or as it is where there are no sweeps; with what they share. Raises UsageError for too many."""
    count = len(scenes) * math.prod(len(sweep.values) for sweep in sweeps)
    if count > MOST_SCENES:
        raise UsageError(f"--sweep: found {count} runs ({len(scenes)} scenes with each combination of values), expected at most {MOST_SCENES}.")
    made: list[Scene] = []
    for scene in scenes:
        made += _variants(scene, sweeps) if sweeps else [scene]
    return shared(made, stages)


def _variants(scene: Scene, sweeps: Sequence[Sweep]) -> list[Scene]:
    made: list[Scene] = []
    for values in itertools.product(*(sweep.values for sweep in sweeps)):
        settings = {stage: dict(table) for stage, table in scene.settings.items()}
        for sweep, value in zip(sweeps, values, strict=True):
            settings.setdefault(sweep.stage, {})[sweep.name] = value
        sweep_of = {sweep.setting: value for sweep, value in zip(sweeps, values, strict=True)}
        made.append(replace(scene, name=scene.name + _suffix(sweep_of), settings=settings, sweep=sweep_of))
    folders = {each.name.casefold() for each in made}
    if len(folders) == len(made) and all(is_scene_name(each.name) for each in made):
        return made
    begin = scene.name[:90].encode("utf-8")[:190].decode("utf-8", "ignore")
    return [replace(each, name=f"{begin}--{number:04d}") for number, each in enumerate(made, 1)]  # too long, or alike without signs


def unswept(name: str, sweep: Mapping[str, Any]) -> str:
    """The name of the scene that a sweep made the scene `name` of, with these values; names may hold "--" themselves."""
    suffix = _suffix(sweep)
    return name.removesuffix(suffix) if name.endswith(suffix) else re.sub(r"--\d{4,}$", "", name)


def _suffix(sweep: Mapping[str, Any]) -> str:
    names = [setting.partition(".")[2] for setting in sweep]
    short = [name if names.count(name) == 1 else setting for name, setting in zip(names, sweep, strict=True)]
    return "".join(f"--{what}-{_shown(value)}" for what, value in zip(short, sweep.values(), strict=True))


def _shown(value: Any) -> str:
    text = value if isinstance(value, str) else canonical_json(value).decode("ascii")
    return re.sub(r"[^\w.-]+", "_", text).strip("_") or "none"


def shared(scenes: Sequence[Scene], stages: Sequence[Stage]) -> list[Scene]:
    """The scenes with their `shares`: stage -> the first scene before it that makes the same artifact."""
    first: dict[str, str] = {}
    found = []
    for scene in scenes:
        keys: dict[str, str] = {}
        shares = {}
        common = [list(scene.sources), scene.preset, scene.seed]
        for stage in stages:
            request = [stage.name, scene.settings.get(stage.name, {}), common, [keys[need] for need in stage.needs]]
            keys[stage.name] = hashlib.sha256(canonical_json(request)).hexdigest()
            donor = first.setdefault(keys[stage.name], scene.name)
            if donor != scene.name:
                shares[stage.name] = donor
        found.append(replace(scene, shares=shares))
    return found
