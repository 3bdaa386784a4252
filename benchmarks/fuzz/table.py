"""Every reader by its name."""

from benchmarks.fuzz import assets, datasets, meshes, pictures, requests, runs, scratch, splats
from benchmarks.fuzz.reader import Reader

MODULES = (assets, datasets, meshes, pictures, requests, runs, scratch, splats)
READERS: dict[str, Reader] = {reader.name: reader for module in MODULES for reader in module.READERS}
