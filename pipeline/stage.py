"""What a stage is, what it is handed when it runs, and the strict reading of its settings."""

from __future__ import annotations

import dataclasses
import difflib
import math
import re
import time
import types
import typing
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from pipeline.errors import Interrupted, UnknownSetting, UsageError

T = TypeVar("T")
Report = Callable[[dict[str, Any]], None]

PROGRESS_SECONDS = 0.1  # progress closer together than this is not reported: a stage may call it for every item


@dataclass(frozen=True)
class Stage:
    """One step of a workflow: a function from folders to a folder.

    name          also the name of its folder in the run
    version       raise it whenever the same request gives other bytes
    settings      a frozen dataclass, every field with a default
    needs         names of the stages whose artifacts it reads
    run           writes its outputs into job.out
    reads_source  whether it is handed the source; then the files of the source are part of its request
    source_files  (source, settings) -> the files of the source that matter (cheap: they are hashed, not read); None: every file in it
    volatile      fnmatch patterns of outputs (relative, posix) that depend on the clock: kept and hashed, but outside the
                  artifact's digest, so that a log does not make later stages stale
    """

    name: str
    version: int
    settings: type
    needs: tuple[str, ...]
    run: Callable[[Job], None]
    reads_source: bool = False
    source_files: Callable[[Path, Any], list[Path]] | None = None
    volatile: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[a-z][a-z0-9_]*", self.name):
            raise ValueError(f"stage name {self.name!r}: lower-case letters, digits and _ only; it names a folder")
        if not dataclasses.is_dataclass(self.settings):
            raise TypeError(f"stage {self.name}: settings must be a dataclass, found {self.settings!r}")


class Job:
    """What a stage sees while it runs. Tests make one by hand: Job(settings=..., inputs=..., out=..., work=...).

    settings  an instance of the stage's settings
    inputs    need -> the folder of its artifact, to be read only
    source    the user's source for a stage with reads_source, else None
    out       an empty folder; what is in it when the stage returns is the artifact
    work      scratch of this very request that survives a kill: checkpoints. Removed once the artifact stands
    device    "cpu" or "cuda"; not part of the request
    report    takes each event, a dict; None: nobody listens
    stop      returns the number of the signal that arrived, or None
    """

    def __init__(
        self,
        *,
        settings: Any,
        out: Path,
        work: Path,
        inputs: Mapping[str, Path] | None = None,
        source: Path | None = None,
        device: str = "cpu",
        stage: str = "",
        report: Report | None = None,
        stop: Callable[[], int | None] | None = None,
    ) -> None:
        self.settings = settings
        self.inputs = {need: Path(folder) for need, folder in (inputs or {}).items()}
        self.source = None if source is None else Path(source)
        self.out = Path(out)
        self.work = Path(work)
        self.device = device
        self.stage = stage
        self._report = report
        self._stop = stop
        self._last_progress = -math.inf
        self._last_text: str | None = None
        self.out.mkdir(parents=True, exist_ok=True)
        self.work.mkdir(parents=True, exist_ok=True)

    def progress(self, done: float, total: float, text: str = "", **facts: Any) -> None:
        """Say how far it is. May be called as often as is convenient: all but the first, the last and one in 0.1 s are dropped."""
        now = time.monotonic()
        if done < total and text == self._last_text and now - self._last_progress < PROGRESS_SECONDS:
            return
        self._last_progress, self._last_text = now, text
        self._emit("progress", done=done, total=total, text=text, **facts)

    def reached(self, done: float, total: float, text: str = "") -> None:
        """`progress` at a safe point."""
        self.progress(done, total, text)
        self.safe_point()

    def say(self, text: str, **facts: Any) -> None:
        """A sentence for the user."""
        self._emit("message", text=text, **facts)

    def warn(self, text: str, **facts: Any) -> None:
        """A sentence about something that went wrong and was got round."""
        self._emit("warning", text=text, **facts)

    def safe_point(self) -> None:
        """Raise Interrupted if a signal has asked to stop. Call it where `work` holds all that is needed to go on."""
        number = self._stop() if self._stop is not None else None
        if number is not None:
            raise Interrupted(number)

    def _emit(self, event: str, **facts: Any) -> None:
        if self._report is not None:
            self._report({**facts, "event": event, "stage": self.stage, "time": time.time()})


def settings_from(cls: type[T], mapping: Mapping[str, Any], *, where: str = "") -> T:
    """An instance of the settings dataclass from plain values, as JSON or TOML give them; what is not named keeps its default.

    where  put before names in errors, e.g. "train": `train.iterations: ...`

    Types are int, float (an int will do), bool, str, None, Literal, tuples (lists will do) and unions of these. A field's metadata may
    hold "choices", "minimum" and "maximum" (of a tuple: of each of its numbers), and "besides", numbers outside of these limits that
    are admitted all the same, such as a 0 for "choose". Raises UnknownSetting, which names the nearest, and UsageError for a wrong type
    or value.
    """
    prefix = f"{where}." if where else ""
    if not isinstance(mapping, Mapping):
        raise UsageError(f"{where or cls.__name__}: expected a table of settings, found {_shown(mapping)}")
    hints = typing.get_type_hints(cls)
    fields = {f.name: f for f in dataclasses.fields(cls) if f.init}  # type: ignore[arg-type]
    values = {}
    for name, value in mapping.items():
        if name not in fields:
            raise UnknownSetting(_unknown(prefix, str(name), list(fields)))
        try:
            values[name] = _decoded(hints[name], value)
        except TypeError:
            raise UsageError(f"{prefix}{name}: expected {_type_text(hints[name])}, found {_shown(value)}") from None
        _check_range(prefix + name, values[name], fields[name].metadata)
    return cls(**values)


def settings_dict(settings: Any) -> dict[str, Any]:
    """The plain values of an instance of a settings dataclass, as JSON holds them (tuples become lists)."""
    return {f.name: _plain(getattr(settings, f.name)) for f in dataclasses.fields(settings)}


def _unknown(prefix: str, name: str, known: list[str]) -> str:
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    remedy = f"Did you mean {prefix}{near[0]}?" if near else f"There are: {', '.join(known) or 'none'}."
    return f"{prefix}{name}: no such setting. {remedy}"


def _plain(value: Any) -> Any:
    return [_plain(item) for item in value] if isinstance(value, tuple | list) else value


def _decoded(hint: Any, value: Any) -> Any:
    """The value as the hint has it; TypeError where it does not fit."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return _decoded_union(arguments, value)
    if origin is typing.Literal:
        for choice in arguments:
            if type(choice) is type(value) and choice == value:
                return choice
        raise TypeError
    if origin is tuple:
        if not isinstance(value, list | tuple):
            raise TypeError
        if len(arguments) == 2 and arguments[1] is Ellipsis:
            return tuple(_decoded(arguments[0], item) for item in value)
        if len(arguments) != len(value):
            raise TypeError
        return tuple(_decoded(item_hint, item) for item_hint, item in zip(arguments, value, strict=True))
    if hint is None or hint is type(None):
        if value is not None:
            raise TypeError
        return None
    if hint is float:
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise TypeError
        return float(value)
    if hint in (int, bool, str):
        if type(value) is not hint:
            raise TypeError
        return value
    raise NotImplementedError(f"settings cannot hold {hint!r}")


def _decoded_union(arms: tuple[Any, ...], value: Any) -> Any:
    for arm in sorted(arms, key=lambda option: type(value) is not option):  # the exact type first: 1 stays an int where both fit
        try:
            return _decoded(arm, value)
        except TypeError:
            continue
    raise TypeError


def _check_range(name: str, value: Any, metadata: Mapping[str, Any]) -> None:
    choices = metadata.get("choices")
    if choices is not None and value not in choices:
        near = difflib.get_close_matches(str(value), [str(choice) for choice in choices], n=1)
        hint = f" Did you mean {near[0]}?" if near else ""
        raise UsageError(f"{name}: found {_shown(value)}, expected one of {', '.join(map(str, choices))}.{hint}")
    least, most, besides = metadata.get("minimum"), metadata.get("maximum"), metadata.get("besides", ())
    otherwise = "".join(f", or {number}" for number in besides)
    for number in _numbers(value):
        if number in besides:
            continue
        if least is not None and number < least:
            raise UsageError(f"{name}: found {_shown(value)}, expected at least {least}{otherwise}")
        if most is not None and number > most:
            raise UsageError(f"{name}: found {_shown(value)}, expected at most {most}{otherwise}")


def _numbers(value: Any) -> list[float]:
    if isinstance(value, tuple):
        return [number for item in value for number in _numbers(item)]
    return [value] if isinstance(value, int | float) and not isinstance(value, bool) else []


def _type_text(hint: Any) -> str:
    """The hint in words: "a whole number or none"."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return " or ".join(_type_text(arm) for arm in arguments)
    if origin is typing.Literal:
        return "one of " + ", ".join(map(repr, arguments))
    if origin is tuple:
        if len(arguments) == 2 and arguments[1] is Ellipsis:
            return f"a list, each {_type_text(arguments[0])}"
        return f"a list of {len(arguments)} ({', '.join(_type_text(item) for item in arguments)})"
    words = {int: "a whole number", float: "a finite number", bool: "true or false", str: "text", type(None): "none", None: "none"}
    return words.get(hint, str(hint))


def _shown(value: Any) -> str:
    text = f"{value!r} ({type(value).__name__})" if value is not None else "none"
    return text if len(text) <= 80 else text[:77] + "..."
