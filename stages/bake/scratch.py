"""Arrays in the scratch folder: an interrupted bake goes on from them."""

from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import BinaryIO, TypeVar

import numpy as np

from pipeline.files import atomic
from pipeline.stage import Job
from stages.scratch import Warn, note, noted, unusable

T = TypeVar("T")


def write_arrays(arrays: Mapping[str, np.ndarray], path: Path) -> None:
    """Write PATH_NAME.npy of each, then the note PATH.json that says they are complete."""
    outputs = []
    for name, values in arrays.items():
        outputs.append(path.with_name(f"{path.name}_{name}.npy"))
        with atomic(outputs[-1], durable=False) as temporary, open(temporary, "wb") as file:
            _write_array(values, file)
    note(_note(path), list(arrays), outputs)


def _write_array(values: np.ndarray, file: BinaryIO) -> None:
    """The bytes of `np.save`, which writes past Python's file: its errors have no number, and a full disk reads "1501528 requested and 475104 written"."""
    values = np.asarray(values, order="C")
    np.lib.format.write_array_header_1_0(file, np.lib.format.header_data_from_array_1_0(values))
    file.write(values.reshape(-1).view(np.uint8).data)


def read_arrays(path: Path, expected: Mapping[str, tuple[str, int]], warn: Warn) -> dict[str, np.ndarray] | None:
    """The arrays of `write_arrays`, mapped from the files; None where something is missing, or not as it was written.

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


def rendered_once(
    job: Job, name: str, kind: type[T], kinds: Mapping[str, tuple[str, int]], fits: Callable[[T], bool], render: Callable[[Callable[[int, int], None]], T]
) -> T:
    """What `render` makes of the field: a `kind` of the arrays `kinds`, as for `read_arrays`; that of an earlier attempt where it `fits`."""
    stored = read_arrays(job.work / name, kinds, job.warn)
    if stored is not None:
        found = kind(**{part: np.array(values) for part, values in stored.items()})
        if fits(found):
            return found
        job.warn(unusable(job.work / name, "of other images or another grid"))

    def progress(done: int, total: int) -> None:
        job.progress(done, total, "rendering for visible voxels")
        job.safe_point()

    found = render(progress)
    write_arrays({part: getattr(found, part) for part in kinds}, job.work / name)
    return found


def _note(path: Path) -> Path:
    return path.with_name(f"{path.name}.json")
