"""Every reader by its name."""

from __future__ import annotations

from benchmarks.fuzz import datasets, meshes, pictures, requests, runs, scratch, splats
from benchmarks.fuzz.reader import Reader

READERS: dict[str, Reader] = {**datasets.READERS, **meshes.READERS, **pictures.READERS, **requests.READERS, **runs.READERS, **scratch.READERS, **splats.READERS}
