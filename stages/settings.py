"""Settings of stages: frozen dataclasses whose fields say what they mean and what they may be.

A default stands once, in the dataclass; presets, the command line and the documentation are derived from it.
"""

from __future__ import annotations

import dataclasses
import math
import types
import typing
from collections.abc import Iterator, Sequence
from typing import Any


class SettingError(ValueError):
    """A value that its setting does not admit. The message names the setting, the value and what is expected."""


def setting(
    default: Any,
    doc: str,
    *,
    choices: Sequence[Any] | None = None,
    minimum: float | None = None,
    maximum: float | None = None,
    unit: str | None = None,
) -> Any:
    """A field of a settings dataclass.

    default            an immutable value: number, string, None or tuple
    doc                one sentence: what the setting does
    choices            the values it may take
    minimum, maximum   inclusive limits; for a tuple, of each of its numbers
    unit               of the number, as printed in the documentation
    """
    metadata: dict[str, Any] = {"doc": doc}
    if choices is not None:
        metadata["choices"] = tuple(choices)
    if minimum is not None:
        metadata["minimum"] = minimum
    if maximum is not None:
        metadata["maximum"] = maximum
    if unit is not None:
        metadata["unit"] = unit
    return dataclasses.field(default=default, metadata=metadata)


@dataclasses.dataclass(frozen=True)
class SettingInfo:
    """What a settings field says about itself."""

    name: str
    type: Any
    default: Any
    doc: str
    choices: tuple[Any, ...] | None
    minimum: float | None
    maximum: float | None
    unit: str | None

    @property
    def type_name(self) -> str:
        return name_of_type(self.type)


def describe_settings(settings_type: type) -> list[SettingInfo]:
    """The fields of a settings dataclass in the order in which they are written."""
    hints = typing.get_type_hints(settings_type)
    described = []
    for entry in dataclasses.fields(settings_type):
        about = entry.metadata
        described.append(
            SettingInfo(
                name=entry.name,
                type=hints[entry.name],
                default=entry.default,
                doc=about.get("doc", ""),
                choices=about.get("choices"),
                minimum=about.get("minimum"),
                maximum=about.get("maximum"),
                unit=about.get("unit"),
            )
        )
    return described


def name_of_type(annotation: Any) -> str:
    """A type as it is shown to users: `int`, `float or none`, `3 x float`."""
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin in (typing.Union, types.UnionType):
        return " or ".join(name_of_type(argument) for argument in arguments)
    if annotation is type(None):
        return "none"
    if origin is typing.Literal:
        return " | ".join(str(argument) for argument in arguments)
    if origin is tuple:
        if len(arguments) == 2 and arguments[1] is Ellipsis:
            return f"list of {name_of_type(arguments[0])}"
        if len(set(arguments)) == 1:
            return f"{len(arguments)} x {name_of_type(arguments[0])}"
        return "(" + ", ".join(name_of_type(argument) for argument in arguments) + ")"
    return {str: "text", bool: "true or false"}.get(annotation, getattr(annotation, "__name__", str(annotation)))


class _Unfit(Exception):
    pass


def _fit(value: Any, annotation: Any) -> Any:
    """`value` as an instance of `annotation`; raises _Unfit. An int does for a float, a list for a tuple; nothing else is converted."""
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin in (typing.Union, types.UnionType):
        # The exact type first, so that 1 stays an int where both int and float are admitted.
        for argument in sorted(arguments, key=lambda option: type(value) is not option):
            try:
                return _fit(value, argument)
            except _Unfit:
                continue
        raise _Unfit
    if annotation is type(None):
        # TOML has no null: `none` is the word for it on the command line and in files.
        if value is None or value == "none":
            return None
        raise _Unfit
    if origin is typing.Literal:
        if value in arguments:
            return value
        raise _Unfit
    if origin is tuple:
        if not isinstance(value, (list, tuple)):
            raise _Unfit
        if len(arguments) == 2 and arguments[1] is Ellipsis:
            return tuple(_fit(item, arguments[0]) for item in value)
        if len(value) != len(arguments):
            raise _Unfit
        return tuple(_fit(item, argument) for item, argument in zip(value, arguments, strict=True))
    if annotation is float and type(value) in (int, float):
        return float(value)
    if annotation is Any or type(value) is annotation:
        return value
    raise _Unfit


def _numbers(value: Any) -> Iterator[float]:
    if isinstance(value, tuple):
        for item in value:
            yield from _numbers(item)
    elif type(value) in (int, float):
        yield value


def check_value(info: SettingInfo, value: Any, *, where: str = "") -> Any:
    """`value` in the setting's own type, within its choices and limits; raises SettingError. `where` goes in front of the name (`train.`)."""
    name = where + info.name
    try:
        fitted = _fit(value, info.type)
    except _Unfit:
        raise SettingError(f"{name}: found {value!r}, expected {info.type_name}") from None
    if info.choices is not None and fitted not in info.choices:
        raise SettingError(f"{name}: found {value!r}, expected one of {', '.join(str(choice) for choice in info.choices)}")
    for number in _numbers(fitted):
        if not math.isfinite(number):
            raise SettingError(f"{name}: found {value!r}, expected finite numbers")
        if info.minimum is not None and number < info.minimum:
            raise SettingError(f"{name}: found {value!r}, expected at least {info.minimum:g}")
        if info.maximum is not None and number > info.maximum:
            raise SettingError(f"{name}: found {value!r}, expected at most {info.maximum:g}")
    return fitted


def check_settings(settings: Any, *, where: str = "") -> None:
    """Check the type, choices and limits of every field of a settings instance; raises SettingError."""
    for info in describe_settings(type(settings)):
        check_value(info, getattr(settings, info.name), where=where)


def settings_from_values(settings_type: type, values: dict[str, Any], *, where: str = "") -> Any:
    """An instance of `settings_type` with `values` in place of its defaults, each checked; raises SettingError.

    `values` may hold what TOML or JSON can: lists become tuples, whole numbers floats where a float is expected. Names are expected to exist.
    """
    about = {info.name: info for info in describe_settings(settings_type)}
    return settings_type(**{name: check_value(about[name], value, where=where) for name, value in values.items()})
