"""JSON files from anybody: bounded in size, and refused by name."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pipeline import files
from pipeline.errors import BadInput

LARGEST = 256 << 20  # bytes; scene.json of a hundred thousand views fits


def read_json(path: Path, remedy: str, *, missing: str | None = None, limit: int = LARGEST) -> Any:
    """The value in a JSON file of at most `limit` bytes, without NaN and Infinity; BadInput says what is wrong with the file, then the remedy.

    missing  the remedy where there is no such file, if that is another
    """
    try:
        return files.read_json(path, limit)
    except FileNotFoundError as error:
        raise BadInput(f"{path}: {error.strerror}. {remedy if missing is None else missing}".strip()) from error
    except files.Unreadable as error:
        raise BadInput(f"{path}: {error}. {remedy}".strip()) from error
