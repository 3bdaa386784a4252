"""Arrays in the scratch folder: an interrupted bake goes on from them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipeline.files import atomic


def write_npy(values: np.ndarray, path: Path) -> None:
    with atomic(path, durable=False) as temporary, open(temporary, "wb") as file:
        np.save(file, values, allow_pickle=False)


def read_npy(path: Path) -> np.ndarray | None:
    """The array; None where there is none that can be read."""
    try:
        return np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError):
        return None
