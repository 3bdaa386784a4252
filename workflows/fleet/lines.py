"""Lines of keys in a TOML file: tomllib has none."""

from __future__ import annotations

import tomllib
from typing import Any

_LONGEST = 200  # lines of one value; what follows a longer one is not looked for
_DEEPEST = 8  # tables in tables

Path = tuple[str, ...]


def lines_of(text: str) -> dict[Path, int]:
    """Key, as the names that lead to it -> the line where it is first mentioned, from 1. Of tables too; without tables in lists.

    text  a valid document. Each statement is parsed alone by tomllib, so that quotes, comments and lists over several lines are read as TOML has them.
    """
    found: dict[Path, int] = {}
    table: Path = ()
    lines = text.split("\n")
    at = 0
    while at < len(lines):
        statement, used = _statement(lines, at)
        if statement is None:
            break
        if lines[at].lstrip().startswith("["):
            table = _deepest(statement)
            statement = _nested_in(table, {})
        else:
            statement = _nested_in(table, statement)
        _put(found, (), statement, at + 1)
        at += used
    return found


def _statement(lines: list[str], at: int) -> tuple[dict[str, Any] | None, int]:
    """(the statement that begins in this line, how many lines it has); None where it has no end."""
    for used in range(1, min(_LONGEST, len(lines) - at) + 1):
        try:
            return tomllib.loads("\n".join(lines[at : at + used])), used
        except tomllib.TOMLDecodeError:
            continue
    return None, 0


def _deepest(statement: dict[str, Any]) -> Path:
    """The path of a table's header."""
    path: list[str] = []
    value: Any = statement
    while isinstance(value, dict) and value:
        name = next(iter(value))
        path.append(name)
        value = value[name]
    return tuple(path)


def _nested_in(table: Path, statement: dict[str, Any]) -> dict[str, Any]:
    for name in reversed(table):
        statement = {name: statement}
    return statement


def _put(found: dict[Path, int], path: Path, statement: dict[str, Any], line: int) -> None:
    for name, value in statement.items():
        found.setdefault((*path, name), line)
        if isinstance(value, dict) and len(path) < _DEEPEST:
            _put(found, (*path, name), value, line)
