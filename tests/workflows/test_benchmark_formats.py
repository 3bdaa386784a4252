"""benchmarks/formats.py: that no format is left out, and that its differences are seen."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from benchmarks import format_readers as readers
from benchmarks.formats import ROWS, apart, farthest, splats_apart
from efficientnerf.splats.gaussians import covariances
from efficientnerf.surface.mesh import PointCloud
from stages.formats.exporters import MESH_EXPORTERS, POINT_EXPORTERS
from tests.stages.formats.gaussians import scattered
from tests.stages.io.meshes import Z_UP, block
from workflows.exporting import formats


def test_every_format_that_is_listed_is_compared() -> None:
    assert {(each["of"], each["extension"]) for each in formats()} == {*ROWS}


def test_differences_of_places() -> None:
    places = np.random.default_rng(0).random((30, 3))
    moved = places.copy()
    moved[7, 1] += 0.01 * np.ptp(places, axis=0).max()
    assert apart(places, places) == farthest(places[::-1], places) == 0
    assert apart(moved, places) == pytest.approx(0.01)
    assert 0 < farthest(moved, places) <= 0.01 + 1e-9
    assert farthest(places[1:], places) > 0  # a place is missing
    with pytest.raises(SystemExit, match="29 places, expected 30"):
        apart(places[1:], places)


def test_differences_of_gaussians() -> None:
    """In any order; sizes, opacities and colours each in their own figure."""
    some = scattered(40)
    found = readers.Splats("a", some.means[::-1], covariances(some)[::-1], some.opacities[::-1], some.harmonics[::-1, 0], some.harmonics[::-1])
    assert max(splats_apart(found, some).values()) == 0
    figures = {"covariances": "covariances_median", "opacities": "opacities", "base": "base_colours"}
    for name, figure in figures.items():
        other = splats_apart(replace(found, **{name: getattr(found, name) * 1.1}), some)
        assert [key for key, value in other.items() if value > 0] == [figure]


def test_readers_of_others(tmp_path: Path) -> None:
    mesh = block()
    for extension in (".ply", ".obj", ".glb"):
        MESH_EXPORTERS[extension].write(mesh, tmp_path / f"a{extension}", Z_UP)
        found = readers.mesh_by_trimesh(tmp_path / f"a{extension}")
        assert len(found.faces) == len(mesh.faces)
    POINT_EXPORTERS[".xyz"].write(PointCloud(mesh.vertices, mesh.normals, mesh.colours), tmp_path / "a.xyz", Z_UP)
    np.testing.assert_allclose(readers.points_by_numpy(tmp_path / "a.xyz").places, mesh.vertices, rtol=1e-6)
    pixels = np.random.default_rng(0).integers(0, 256, (5, 7, 3), np.uint8)
    cv2.imwrite(str(tmp_path / "a.png"), pixels[..., ::-1])
    np.testing.assert_array_equal(readers.picture_by_opencv(tmp_path / "a.png").pixels, pixels)


def test_a_reader_that_is_not_there_is_said(tmp_path: Path) -> None:
    tools = readers.Tools(None, None)
    for call in (lambda: readers.splats_by_transform(tmp_path, tools), lambda: readers.points_by_copc(tmp_path, tools),
                 lambda: readers.volume_by_openvdb(tmp_path, {}, tools)):  # fmt: skip
        with pytest.raises(readers.Missing):
            call()
    assert "missing" in readers.validated(tmp_path, tools)
