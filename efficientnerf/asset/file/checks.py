"""Numbers of the metadata, which must be numbers, and within bounds."""

from typing import Any

import numpy as np

from efficientnerf.asset.file.container import FormatError

FARTHEST = 2.0**40  # in units of the grid: 64-bit floats tell places to a thousandth of one there
MAX_CELLS = 2**30  # coarse, of all grids together


def number(name: str, meta: dict[str, Any], key: str, low: float, high: float, *, whole: bool) -> float:
    value = meta.get(key)
    if type(value) not in ((int,) if whole else (int, float)) or not low <= value <= high:  # type: ignore[operator]
        raise FormatError(f"{name}: metadata '{key}' is {str(value)[:60]}; expected a {'whole ' if whole else ''}number from {low:g} to {high:g}")
    return value  # type: ignore[return-value]


def numbers(name: str, meta: dict[str, Any], key: str, count: int, low: float, high: float) -> list[float]:
    value = meta.get(key)
    if not (isinstance(value, list) and len(value) == count and all(type(x) in (int, float) and low <= x <= high for x in value)):
        raise FormatError(f"{name}: metadata '{key}' is {str(value)[:60]}; expected {count} numbers from {low:g} to {high:g}")
    return value


def matrix(name: str, meta: dict[str, Any], key: str, rows: int, columns: int, low: float, high: float) -> np.ndarray:
    value = meta.get(key)
    if not (isinstance(value, list) and len(value) == rows):
        raise FormatError(f"{name}: metadata '{key}' is {str(value)[:60]}; expected {rows} rows")
    return np.array([numbers(name, {key: row}, key, columns, low, high) for row in value], np.float64)


def flag(name: str, meta: dict[str, Any], key: str) -> bool:
    value = meta.get(key)
    if type(value) is not bool:
        raise FormatError(f"{name}: metadata '{key}' is {str(value)[:60]}; expected true or false")
    return value


def coarse_shape(name: str, meta: dict[str, Any]) -> tuple[int, int, int]:
    """`shape`: at most 65,536 coarse cells along an axis and MAX_CELLS in all."""
    shape = numbers(name, meta, "shape", 3, 1, 2**16)
    if not all(type(n) is int for n in shape) or shape[0] * shape[1] * shape[2] > MAX_CELLS:
        raise FormatError(f"{name}: shape {shape}; expected whole numbers with a product of at most {MAX_CELLS}")
    x, y, z = (int(n) for n in shape)
    return x, y, z
