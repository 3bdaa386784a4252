"""A stage, the job that it is handed when it runs, and the strict reading of its settings."""

from __future__ import annotations

import dataclasses
import difflib
import functools
import math
import time
import types
import typing
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from pipeline.errors import Interrupted, UnknownSetting, UsageError
from pipeline.executors.memory import Limit
from pipeline.links import is_stage_name
from pipeline.run import named
from pipeline.text import printable, suggestion

T = TypeVar("T")
Report = Callable[[dict[str, Any]], None]

PROGRESS_SECONDS = 0.1  # progress closer together than this is not reported: a stage may call it for every item


@dataclass(frozen=True)
class ByName:
    """A function by its name, `package.module:function`, whose module is imported when it is called: stages are described by modules that import little."""

    name: str

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        module, _, function = self.name.partition(":")
        return getattr(import_module(module), function)(*arguments, **named)


@dataclass(frozen=True)
class Stage:
    """One step of a workflow: a function from folders to a folder."""

    name: str  # also the name of its folder in the run
    version: int  # raise it whenever the same request gives other bytes
    settings: type  # a frozen dataclass, every field with a default
    needs: tuple[str, ...]  # names of the stages whose artifacts it reads
    run: Callable[[Job], None]  # writes its outputs into job.out; a `ByName` where its module imports what takes time
    reads_source: bool = False  # whether it is handed the source; then the files of the source are part of its request
    # (source, settings) -> the files of the source that matter (cheap: they are hashed, not read); None: every file in it
    source_files: Callable[[Path, Any], list[Path]] | None = None
    uses_device: bool = False  # whether it computes on job.device
    # takes the settings of the stages that are considered, by name, its own among them, and raises UsageError where it cannot work with them: called before
    # the first stage runs, so that hours of the stages before it are not spent in vain. Cheap
    check: Callable[[Mapping[str, Any]], None] | None = None
    # fnmatch patterns of outputs (relative, posix) that depend on the clock: kept and hashed, but outside the artifact's digest, so that a log does not make
    # later stages stale
    volatile: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not is_stage_name(self.name):
            raise ValueError(f"stage name {self.name!r}: lower-case letters, digits and _ only; it names a folder")
        if not dataclasses.is_dataclass(self.settings):
            raise TypeError(f"stage {self.name}: settings must be a dataclass, found {self.settings!r}")


@dataclass(kw_only=True, eq=False)
class Job:
    """What a stage sees while it runs. Tests make one by hand: Job(settings=..., inputs=..., out=..., work=...)."""

    settings: Any  # an instance of the stage's settings
    out: Path  # an empty folder; what is in it when the stage returns is the artifact
    work: Path  # scratch of this very request that survives a kill: checkpoints. Removed once the artifact is published
    inputs: Mapping[str, Path] = field(default_factory=dict)  # need -> the folder of its artifact, to be read only
    source: Path | None = None  # the user's source for a stage with reads_source, else None
    also: Sequence[Path] = ()  # further sources
    device: str = "cpu"  # "cpu" or "cuda"; not part of the request
    memory: Limit | None = None  # what the stage may take; not part of the request: no bytes of an artifact may depend on it. None: no limit is known
    stage: str = ""
    report: Report | None = None  # takes each event, a dict; None: nobody listens
    stop: Callable[[], int | None] | None = None  # returns the number of the signal that arrived, or None
    facts: dict[str, Any] = field(default_factory=dict, init=False)
    _last: tuple[float, str | None] = field(default=(-math.inf, None), init=False)  # when progress was reported last, and its text

    def __post_init__(self) -> None:
        self.out.mkdir(parents=True, exist_ok=True)
        self.work.mkdir(parents=True, exist_ok=True)

    @property
    def sources(self) -> dict[str, Path]:
        """All of them by name, where there are several; see `pipeline.run.named`."""
        return {} if self.source is None else named([self.source, *self.also])

    def progress(self, done: float, total: float, text: str = "", **facts: Any) -> None:
        """Report progress. May be called often: at most one report in 0.1 s is passed on, and the first and the last."""
        now, (last, last_text) = time.monotonic(), self._last
        if done < total and text == last_text and now - last < PROGRESS_SECONDS:
            return
        self._last = now, text
        self._emit("progress", done=done, total=total, text=text, **facts)

    def reached(self, done: float, total: float, text: str = "") -> None:
        """`progress` at a safe point."""
        self.progress(done, total, text)
        self.safe_point()

    def say(self, text: str, **facts: Any) -> None:
        """A sentence for the user."""
        self._emit("message", text=text, **facts)

    def warn(self, text: str, **facts: Any) -> None:
        """A sentence about a problem that was worked around."""
        self._emit("warning", text=text, **facts)

    def record(self, name: str, value: Any) -> None:
        """Put a value that JSON can hold into the manifest, outside of every digest: what a stage decided that is no setting."""
        self.facts[name] = value

    def pass_on(self, event: dict[str, Any]) -> None:
        """An event of the process that does this job."""
        if self.report is not None:
            self.report(event)

    def safe_point(self) -> None:
        """Raise Interrupted if a signal has arrived. Call it where `work` holds all that is needed to resume."""
        number = self.stop() if self.stop is not None else None
        if number is not None:
            raise Interrupted(number)

    def _emit(self, event: str, **facts: Any) -> None:
        self.pass_on({**facts, "event": event, "stage": self.stage, "time": time.time()})


@functools.cache
def hints_of(cls: type) -> dict[str, Any]:
    """The types of a class's fields by name, with their limits: evaluated once, for that takes milliseconds."""
    return typing.get_type_hints(cls, include_extras=True)


def settings_from(cls: type[T], mapping: Mapping[str, Any], *, where: str = "") -> T:
    """An instance of the settings dataclass from plain values, as JSON or TOML give them; fields that are missing keep their defaults.

    where  put before names in errors, e.g. "train": `train.iterations: ...`

    Types are those that msgspec decodes strictly: int, float (an int will do, infinities and nan will not), bool, str, None, Literal, tuples (lists will
    do), unions of these, and limits as `Annotated[int, msgspec.Meta(ge=1)]`. Raises UnknownSetting, which names the nearest, and UsageError for a wrong
    type or value.
    """
    prefix = f"{where}." if where else ""
    if not isinstance(mapping, Mapping):
        raise UsageError(f"{where or cls.__name__}: expected a table of settings, found {_shown(mapping)}.")
    hints = hints_of(cls)  # type: ignore[arg-type]
    names = [f.name for f in dataclasses.fields(cls) if f.init]  # type: ignore[arg-type]
    values = {}
    for name, value in mapping.items():
        if name not in names:
            shown = printable(name, 80)
            raise UnknownSetting(f"{prefix}{shown}: no such setting. {suggestion(shown, names, prefix)}")
        try:
            values[name] = msgspec.convert(value, hints[name], strict=True)
            if any(isinstance(number, int) and abs(number) >= 2**63 for number in _numbers(values[name])):
                raise OverflowError
        except (ValueError, OverflowError, RecursionError):  # msgspec's own is a ValueError; the others are of texts and numbers beyond all bounds
            raise UsageError(f"{prefix}{name}: found {_shown(value)}, expected {type_in_words(hints[name])}.{_near(hints[name], value)}") from None
        if not all(math.isfinite(number) for number in _numbers(values[name])):
            raise UsageError(f"{prefix}{name}: found {_shown(value)}, expected a finite number.")
    return cls(**values)


def settings_of(stages: Iterable[Stage], table: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Stage -> an instance of its settings, from plain values by stage and name. Raises as `settings_from`."""
    return {stage.name: settings_from(stage.settings, table.get(stage.name, {}), where=stage.name) for stage in stages}


def settings_dict(settings: Any) -> dict[str, Any]:
    """The plain values of an instance of a settings dataclass, as JSON holds them (tuples become lists)."""
    return {f.name: plain(getattr(settings, f.name)) for f in dataclasses.fields(settings)}


def plain(value: Any) -> Any:
    """A value as JSON holds it."""
    return [plain(item) for item in value] if isinstance(value, tuple | list) else value


def _numbers(value: Any) -> list[float]:
    if isinstance(value, tuple):
        return [number for item in value for number in _numbers(item)]
    return [value] if isinstance(value, int | float) else []


def type_in_words(hint: Any) -> str:
    """What a value of this type may be: `a whole number, at least 8, or auto`."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is typing.Annotated:
        described = [limit.description for limit in arguments[1:] if limit.description is not None]
        return described[0] if described else type_in_words(arguments[0]) + _limits_in_words(hint)
    if origin in (typing.Union, types.UnionType):
        arms = [type_in_words(arm) for arm in arguments]
        return (", or " if any("," in arm for arm in arms) else " or ").join(arms)
    if origin is typing.Literal:
        return ("one of " if len(arguments) > 1 else "") + ", ".join(map(str, arguments))
    if origin is tuple:
        if len(arguments) == 2 and arguments[1] is Ellipsis:
            return f"a list, each {type_in_words(arguments[0])}"
        items = [type_in_words(item) for item in arguments]
        return f"a list of {len(items)}, " + (f"each {items[0]}" if len(set(items)) == 1 else " and ".join(items))
    words = {int: "a whole number", float: "a number", bool: "true or false", str: "text", type(None): "none", None: "none"}
    return words.get(hint, str(hint))


def limits_of(hint: Any) -> tuple[float | None, float | None]:
    """Lowest and highest number that an annotation admits, exclusive ones included; None where it sets none."""
    low: float | None = None
    high: float | None = None
    for limit in typing.get_args(hint)[1:] if typing.get_origin(hint) is typing.Annotated else ():
        low = next((bound for bound in (limit.ge, limit.gt) if bound is not None), low)
        high = next((bound for bound in (limit.le, limit.lt) if bound is not None), high)
    return low, high


def _limits_in_words(hint: Any) -> str:
    words = {"ge": "at least", "gt": "more than", "le": "at most", "lt": "less than"}
    found = [(word, getattr(limit, name)) for limit in typing.get_args(hint)[1:] for name, word in words.items()]
    return "".join(f", {word} {bound:g}" if isinstance(bound, float) else f", {word} {bound}" for word, bound in found if bound is not None)


def _near(hint: Any, value: Any) -> str:
    """` Did you mean x?` where the text is close to a word that the type admits."""
    arms = typing.get_args(hint) if typing.get_origin(hint) in (typing.Union, types.UnionType) else (hint,)
    words = [str(choice) for arm in arms if typing.get_origin(arm) is typing.Literal for choice in typing.get_args(arm)]
    near = difflib.get_close_matches(value, words, n=1) if isinstance(value, str) else []
    return f" Did you mean {near[0]}?" if near else ""


def _shown(value: Any) -> str:
    try:
        text = f"{value!r} ({type(value).__name__})" if value is not None else "none"
    except RecursionError:
        text = f"a value that nests too deeply ({type(value).__name__})"
    except ValueError:  # of more than 4300 digits
        text = f"a number that is too long ({type(value).__name__})"
    return text if len(text) <= 80 else text[:77] + "..."
