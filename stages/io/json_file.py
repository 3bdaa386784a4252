"""Reading JSON files from anybody: bounded in size, fields by type; errors name the file and the place."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

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


@dataclass(frozen=True)
class JsonReader:
    """A JSON object whose fields are read by type. Raises BadInput with the place and the remedy.

    where  names the object in errors, as `scene.json: views[3]`
    """

    value: Any
    where: str
    remedy: str

    def _take(self, name: str, kinds: type | tuple[type, ...], expected: str) -> Any:
        found = self.value.get(name) if isinstance(self.value, dict) else None
        if not isinstance(found, kinds) or (isinstance(found, bool) and kinds is not bool):
            raise BadInput(f"{self.where}.{name}: expected {expected}, found {str(found)[:40]!r}. {self.remedy}")
        return found

    def text(self, name: str) -> str:
        return str(self._take(name, str, "text"))

    def flag(self, name: str) -> bool:
        return bool(self._take(name, bool, "true or false"))

    def integer(self, name: str) -> int:
        return int(self._take(name, int, "a whole number"))

    def number(self, name: str) -> float:
        return float(self.numbers(name, ()))

    def items(self, name: str) -> list[Any]:
        return list(self._take(name, list, "a list"))

    def reader(self, name: str) -> JsonReader:
        return JsonReader(self._take(name, dict, "an object"), f"{self.where}.{name}", self.remedy)

    def numbers(self, name: str, shape: tuple[int, ...]) -> np.ndarray:
        """Finite float64 of this shape; (-1,) any length."""
        found = self._take(name, (list, int, float), "numbers")
        try:
            array = np.array(found)
        except ValueError:
            array = np.array(None)
        if array.dtype.kind not in "if" or not (array.shape == shape or (shape == (-1,) and array.ndim == 1)) or not all(map(math.isfinite, array.ravel())):
            raise BadInput(f"{self.where}.{name}: expected finite numbers of shape {shape}, found {str(found)[:40]}. {self.remedy}")
        return array.astype(np.float64)
