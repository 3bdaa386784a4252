"""Settings of stages: fields of frozen dataclasses that say what they mean and what they may be.

A default stands once, in the dataclass; presets, the command line and the documentation are derived from it, and the engine checks
values against it (`pipeline.stage.settings_from`).
"""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Sequence
from typing import Any


def setting(
    default: Any,
    doc: str,
    *,
    choices: Sequence[Any] | None = None,
    minimum: float | None = None,
    maximum: float | None = None,
    besides: Sequence[float] | None = None,
    unit: str | None = None,
) -> Any:
    """A field of a settings dataclass.

    default            an immutable value: number, text, true or false, None or a tuple of these
    doc                one sentence: what the setting does
    choices            the values it may take
    minimum, maximum   inclusive limits of a number; of a tuple, of each of its numbers
    besides            numbers outside of these limits that it may be all the same: 0 where that means "choose"
    unit               of the number, as printed in the documentation
    """
    about = {"doc": doc, "choices": None if choices is None else tuple(choices), "minimum": minimum, "maximum": maximum}
    about |= {"besides": None if besides is None else tuple(besides), "unit": unit}
    return dataclasses.field(default=default, metadata={name: value for name, value in about.items() if value is not None})


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
    besides: tuple[float, ...]
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
                besides=about.get("besides", ()),
                unit=about.get("unit"),
            )
        )
    return described


def name_of_type(annotation: Any) -> str:
    """A type as it is shown to users: `whole number`, `number or none`, `3 x number`."""
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin in (typing.Union, types.UnionType):
        return " or ".join(name_of_type(argument) for argument in arguments)
    if origin is typing.Literal:
        return ", ".join(str(argument) for argument in arguments)
    if origin is tuple:
        if len(arguments) == 2 and arguments[1] is Ellipsis:
            return f"list of {name_of_type(arguments[0])}"
        if len(set(arguments)) == 1:
            return f"{len(arguments)} x {name_of_type(arguments[0])}"
        return "(" + ", ".join(name_of_type(argument) for argument in arguments) + ")"
    names = {str: "text", bool: "true or false", int: "whole number", float: "number", type(None): "none"}
    return names.get(annotation, str(annotation))
