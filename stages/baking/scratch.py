"""Arrays in the scratch folder: an interrupted bake goes on from them."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path

import numpy as np

from pipeline.files import atomic
from stages.scratch import Warn, note, noted


def write_arrays(arrays: Mapping[str, np.ndarray], path: Path) -> None:
    """Write PATH_NAME.npy of each, then the note PATH.json that says they are whole."""
    outputs = []
    for name, values in arrays.items():
        outputs.append(path.with_name(f"{path.name}_{name}.npy"))
        with atomic(outputs[-1], durable=False) as temporary, open(temporary, "wb") as file:
            np.save(file, values, allow_pickle=False)
    note(_note(path), list(arrays), outputs)


def read_arrays(path: Path, expected: Mapping[str, tuple[str, int]], warn: Warn) -> dict[str, np.ndarray] | None:
    """What `write_arrays` wrote, mapped from the files; None where something is missing, or not as it was written.

    expected  type and number of dimensions of each by name
    """
    arrays: dict[str, np.ndarray] = {}

    def check(names: list[str], outputs: Collection[str]) -> None:
        for name, (dtype, dimensions) in expected.items():
            output = path.with_name(f"{path.name}_{name}.npy")
            if output.name not in outputs:
                raise ValueError(f"{output.name} is missing")
            arrays[name] = np.load(output, mmap_mode="r", allow_pickle=False)
            if not isinstance(arrays[name], np.ndarray) or arrays[name].dtype != dtype or arrays[name].ndim != dimensions:
                raise ValueError(f"{output.name} is no array of {dtype} with {dimensions} dimensions")

    return None if noted(_note(path), list[str], warn, check) is None else arrays


def _note(path: Path) -> Path:
    return path.with_name(f"{path.name}.json")
