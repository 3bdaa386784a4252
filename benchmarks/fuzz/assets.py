"""The asset's file, of every layout: what is read is described, rendered from inside, outside and far away, looked up at points, meshed and written again."""

import hashlib
import json
from contextlib import suppress
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from benchmarks.fuzz import safetensors_bytes
from benchmarks.fuzz.reader import Opened, Reader
from benchmarks.project import ROOT

SIZE = 12  # pixels along a side of a picture


def seeds() -> list[bytes]:
    return [path.read_bytes() for path in sorted((ROOT / "tests" / "data" / "golden").glob("*.nerftree"))]


def changed(rng: Random, data: bytes) -> bytes:
    """A change of the tensors, the metadata or the file, the digests put right in most."""
    found = safetensors_bytes.with_metadata(rng, data, "nerftree") if rng.random() < 0.35 else safetensors_bytes.changed(rng, data)
    return found if rng.random() < 0.15 else safetensors_bytes.restated(found, with_digests)


def with_digests(header: dict[str, Any], body: bytes) -> dict[str, str]:
    about = json.loads(header["__metadata__"]["nerftree"])
    for name in about["sha256"]:
        begin, end = header[name]["data_offsets"]
        about["sha256"][name] = hashlib.sha256(body[begin:end]).hexdigest()
    return {"nerftree": json.dumps(about)}


def use(tree: Any) -> None:
    """Raise AssertionError where a picture is none; FormatError where no layout holds the asset."""
    from efficientnerf.asset import queries
    from efficientnerf.asset.format import serialize
    from efficientnerf.asset.rendering import render
    from efficientnerf.geometry.cameras import Camera
    from efficientnerf.surface.extraction import surface
    from efficientnerf.surface.isosurface import NoSurface
    from efficientnerf.surface.volume import volume_of

    middle, extent = (tree.bounds_min + tree.bounds_max) / 2, float(np.max(tree.bounds_max - tree.bounds_min))
    for distance, focal in ((0.0, SIZE), (2.0, SIZE), (1e6, 1e9), (1e15, 1e-6)):
        pose = np.eye(4)
        pose[:3, 3] = middle - np.array([0.1, 0.2, 1.0]) * distance * extent
        seen = render(tree, Camera("view", SIZE, SIZE, "SIMPLE_PINHOLE", (focal, SIZE / 2, SIZE / 2), pose))
        assert (np.abs(seen.opacity - 0.5) <= 0.5 + 1e-6).all(), "an opacity outside of 0 to 1"
        assert np.isfinite(seen.colour).all(), "a colour that is not finite"
    points = np.array([middle, tree.bounds_min, tree.bounds_max * 1e20, [np.nan] * 3, [np.inf] * 3])
    queries.density_at(tree, points), queries.normal_at(tree, points), queries.colour_at(tree, points, np.tile([0.0, 0.0, 1.0], (len(points), 1)))
    with suppress(NoSurface):
        surface(volume_of(tree), None, faces=200)
    serialize(tree)


def open_asset(folder: Path) -> Opened:
    from efficientnerf.asset.format import FormatError, describe, load

    path = folder / "a.nerftree"

    def read(data: bytes) -> None:
        path.write_bytes(data)
        with np.errstate(all="ignore"):
            tree = load(path)
            try:
                describe(path)
            except FormatError as error:
                raise AssertionError("read, but not described") from error
            use(tree)

    for data in seeds():  # compiles or loads the kernels, for which there is no limit of time
        read(data)
    return Opened(read, (("inspect", str(path)), ("inspect", str(path), "--json")))


READERS = (Reader("asset", "the asset, every layout", seeds, changed, open_asset, refusals=("FormatError", "PipelineError")),)
