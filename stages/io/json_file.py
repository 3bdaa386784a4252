"""Reading JSON files from anybody: bounded in size; errors name the file and the place."""

from pathlib import Path
from typing import Any

from pipeline import files
from pipeline.errors import BadInput
from pipeline.text import printable

MAX_BYTES = 256 << 20  # bytes; scene.json of a hundred thousand views fits
LARGEST_NUMBER = 1e12  # of lengths and parameters: UTM coordinates in millimetres fit, and no product of a few overflows


def read_json(path: Path, remedy: str, *, limit: int = MAX_BYTES) -> Any:
    """The value in a JSON file of at most `limit` bytes, without NaN and Infinity; BadInput says what is wrong with the file, then the remedy."""
    try:
        return files.read_json(path, limit)
    except FileNotFoundError as error:
        raise BadInput(f"{printable(path)}: {error.strerror}. {remedy}".strip()) from error
    except files.Unreadable as error:
        raise BadInput(f"{printable(path)}: {error}. {remedy}".strip()) from error


def read_object(path: Path, where: str, remedy: str, *, limit: int = MAX_BYTES) -> dict[str, Any]:
    """The object in a JSON file, which messages call `where`; BadInput where it holds another value."""
    found = read_json(path, remedy, limit=limit)
    if not isinstance(found, dict):
        raise BadInput(f"{where}: {shown(found)}; expected an object. {remedy}")
    return found


def finite(value: Any, largest: float = LARGEST_NUMBER) -> float | None:
    """A number of a JSON file as a float; None for what is no number, not finite, or of an absolute value above `largest`."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= largest:  # integers of any size compare exactly
        return None
    return float(value)


def number(document: dict[str, Any], key: str, where: str, remedy: str, default: Any = None) -> float:
    """A finite number of an object; BadInput says where it is none, then the remedy."""
    value = document.get(key, default)
    found = finite(value)
    if found is None:
        raise BadInput(f"{where}: {key} is {shown(value)}, expected a finite number. {remedy}")
    return found


def numbers(value: Any, count: int, where: str, remedy: str) -> list[float]:
    """A list of finite numbers of a JSON file; BadInput says where it is another, then the remedy."""
    found = [finite(entry) for entry in value] if isinstance(value, list) and len(value) == count else [None]
    if None in found:
        raise BadInput(f"{where} is {shown(value)}; expected {count} finite numbers. {remedy}")
    return [entry for entry in found if entry is not None]


def shown(value: Any) -> str:
    """A value of a JSON file for a message: what it is, where it is large or nested."""
    if isinstance(value, list):
        return f"a list of {len(value)}"
    if isinstance(value, dict):
        return "an object"
    return "nothing" if value is None else printable(repr(value), 40)
