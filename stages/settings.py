"""Descriptions of settings: types, limits, defaults and meaning, from the fields of settings dataclasses.

A default stands once, in the dataclass; presets, the command line and the documentation are derived from it, and the engine checks
values against it (`pipeline.stage.settings_from`).
"""

import dataclasses
import types
import typing
from typing import Any

from pipeline.stage import hints_of, limits_of, type_in_words


@dataclasses.dataclass(frozen=True)
class SettingInfo:
    """Description of a settings field."""

    name: str
    type: Any  # its annotation, evaluated
    default: Any
    doc: str
    unit: str | None
    advanced: bool  # whether it is listed apart from the settings that most users want

    @property
    def type_name(self) -> str:
        """Its type in words: `a whole number, at least 8, or auto`."""
        return type_in_words(self.type)

    @property
    def choices(self) -> tuple[Any, ...] | None:
        """The words it may be, such as auto; all its values where `listed`."""
        return tuple(choice for arm in _arms(self.type) if typing.get_origin(arm) is typing.Literal for choice in typing.get_args(arm)) or None

    @property
    def listed(self) -> bool:
        """Whether its choices are all that it may be."""
        return all(typing.get_origin(arm) is typing.Literal for arm in _arms(self.type))

    @property
    def minimum(self) -> float | None:
        """Of its numbers, inclusive or exclusive, as `maximum`."""
        return next((low for arm in _arms(self.type) if (low := limits_of(arm)[0]) is not None), None)

    @property
    def maximum(self) -> float | None:
        return next((high for arm in _arms(self.type) if (high := limits_of(arm)[1]) is not None), None)


def describe_settings(settings_type: type) -> list[SettingInfo]:
    """The fields of a settings dataclass in the order in which they are written."""
    hints = hints_of(settings_type)
    return [
        SettingInfo(
            name=entry.name,
            type=hints[entry.name],
            default=entry.default,
            doc=entry.metadata.get("doc", ""),
            unit=entry.metadata.get("unit"),
            advanced=entry.metadata.get("advanced", False),
        )
        for entry in dataclasses.fields(settings_type)
    ]


def _arms(annotation: Any) -> tuple[Any, ...]:
    """The alternatives of a union, or the type itself."""
    return typing.get_args(annotation) if typing.get_origin(annotation) in (typing.Union, types.UnionType) else (annotation,)
