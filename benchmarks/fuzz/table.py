"""Every reader by its name."""

from __future__ import annotations

from benchmarks.fuzz import datasets, pictures, requests, runs, scratch
from benchmarks.fuzz.reader import Reader

READERS: dict[str, Reader] = {**datasets.READERS, **pictures.READERS, **requests.READERS, **runs.READERS, **scratch.READERS}
