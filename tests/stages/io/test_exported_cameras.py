"""Exports of other programs: a known point lies at the known pixel in every image, and each folder is taken by one importer."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from efficientnerf.geometry.cameras import project
from stages.io import importers
from stages.io.capture import Capture
from stages.io.importers.description import describe_source
from tests.stages import captures, exports
from tests.stages.captures import Settings
from tests.stages.exports import EXPORTS, POINTS


def read(folder: Path, **settings: object) -> Capture:
    return importers.IMPORTERS[importers.detect(folder)].read(folder, Settings(**settings))  # type: ignore[arg-type]


def assert_seen(capture: Capture, pixels: exports.Pixels, atol: float = 1e-6) -> None:
    """The points lie where they should in every image, and in front of it."""
    found = {photo.image.name: project(photo.camera, POINTS) for photo in capture.photos}
    assert set(found) == set(pixels)
    for name, (where, depth) in found.items():
        np.testing.assert_allclose(where, pixels[name], atol=atol, err_msg=name)
        assert (depth > 0).all()


# A fourth radial coefficient becomes a quotient of polynomials.
TOLERANCE = {"metashape": 0.03, "realitycapture csv": 0.01, "realitycapture xmp": 0.01}


@pytest.mark.parametrize("how", EXPORTS)
def test_a_known_point_lies_at_the_known_pixel_in_every_image(how: str, tmp_path: Path) -> None:
    name, write = EXPORTS[how]
    folder, pixels = write(tmp_path / "source")
    assert importers.detect(folder) == name
    capture = read(folder)
    assert capture.kind == name
    assert len(capture.photos) == 6
    assert_seen(capture, pixels, TOLERANCE.get(how, 1e-6))
    listed = importers.files(folder, Settings())
    assert {photo.image for photo in capture.photos} < set(listed)
    assert all(path.is_file() for path in listed)
    described = describe_source(folder)
    json.dumps(described, allow_nan=False)
    assert (described["count"], described["format"]) == (6, name)


EVERY = {how: (name, write) for how, (name, write) in EXPORTS.items()} | {
    how: (name, lambda folder, write=write: (write(folder), {})) for how, (name, write) in captures.WRITERS.items()
}


@pytest.mark.parametrize("how", EVERY)
def test_one_importer_takes_a_folder(how: str, tmp_path: Path) -> None:
    name, write = EVERY[how]
    folder, _ = write(tmp_path / "source")
    assert [other for other in importers.candidates(folder) if other != "photographs"] == [name]
