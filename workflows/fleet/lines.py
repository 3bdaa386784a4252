"""Lines of keys in a TOML file: tomllib has none."""

import tomllib
from collections.abc import Iterator
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
        is_header = lines[at].lstrip().startswith("[")
        paths = list(_paths(statement, () if is_header else table))
        if is_header:
            table = paths[-1]
        for path in paths:
            found.setdefault(path, at + 1)
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


def _paths(statement: dict[str, Any], above: Path = ()) -> Iterator[Path]:
    """Of all keys of a statement, each after the table that it is in."""
    for name, value in statement.items():
        yield (*above, name)
        if isinstance(value, dict) and len(above) < _DEEPEST:
            yield from _paths(value, (*above, name))
