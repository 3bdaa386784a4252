"""OpenVDB: written by us, read by OpenVDB's own library where there is one, and the same."""

import hashlib
import importlib.util
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from efficientnerf.asset.cascades import cascade_grids, nested
from efficientnerf.asset.tree import NerfTree, tree_from_voxels
from efficientnerf.geometry.cameras import Camera
from efficientnerf.geometry.ndc import Ndc
from efficientnerf.rendering.colour import linear_from_srgb
from pipeline.errors import BadInput, UsageError
from stages.formats.exporters import VOLUME_EXPORTERS
from stages.formats.exporters.vdb import Grid, grids_of, write_grids
from tests.stages.io.meshes import Y_DOWN, Z_UP

# An interpreter that has OpenVDB's library: `openvdb`, or Blender as a module (`pip install bpy`), which brings it.
READER = os.environ.get("BLENDER_PYTHON") or (sys.executable if importlib.util.find_spec("openvdb") or importlib.util.find_spec("bpy") else None)
READ = """
import sys
try:
    import openvdb
except ImportError:
    import bpy, glob, os
    sys.path += glob.glob(os.path.join(bpy.utils.system_resource("SCRIPTS"), "..", "python", "lib", "python*", "site-packages"))
    import openvdb
import numpy
grids, about = openvdb.readAll(sys.argv[1])
out = {}
for grid in grids:
    where = numpy.load(sys.argv[2])[grid.name]
    look = grid.getConstAccessor()
    places = [tuple(int(c) for c in row) for row in where]
    out[grid.name] = numpy.array([look.getValue(place) for place in places])
    out[grid.name + " on"] = numpy.array([look.isValueOn(place) for place in places])
    out[grid.name + " at"] = numpy.array([grid.transform.indexToWorld(tuple(map(float, place))) for place in places])
    out[grid.name + " count"] = grid.activeVoxelCount()
    out[grid.name + " class"] = str(grid.metadata["class"])
out["unit"] = about["unit"]
numpy.savez(sys.argv[3], **out)
"""


def scattered() -> list[Grid]:
    """Voxels far apart and in a block that crosses nodes of all levels, in disorder; turned, scaled and moved."""
    rng = np.random.default_rng(0)
    at = np.concatenate([rng.integers(-40, 5000, (300, 3)), np.argwhere(np.ones((9, 17, 10), bool)) + np.array([120, 4090, -5])])
    at = np.unique(at, axis=0)[rng.permutation(len(np.unique(at, axis=0)))]
    matrix = np.eye(4)
    matrix[:3] = [[0.15, -0.2, 0, 1], [0.2, 0.15, 0, 2], [0, 0, 0.25, 3]]
    values = np.round(rng.random((len(at), 4)) * 1024) / 1024
    return [Grid("density", at, values[:, 0].astype(np.float32), matrix), Grid("color", at, values[:, 1:].astype(np.float16), matrix)]


@pytest.mark.skipif(READER is None, reason="needs OpenVDB's library: set BLENDER_PYTHON to an interpreter with bpy")
def test_openvdb_reads_what_was_written(tmp_path: Path) -> None:
    grids = scattered()
    write_grids(grids, tmp_path / "a.vdb", "metre")
    np.savez(tmp_path / "at.npz", **{grid.name: grid.coordinates for grid in grids})
    done = subprocess.run([str(READER), "-c", READ, *(str(tmp_path / name) for name in ("a.vdb", "at.npz", "out.npz"))], capture_output=True, check=False)
    assert (tmp_path / "out.npz").is_file(), done.stderr  # Blender's library may end with complaints of its own
    found = np.load(tmp_path / "out.npz")
    for grid in grids:
        np.testing.assert_array_equal(found[grid.name].astype(np.float32), grid.values.astype(np.float32))
        assert found[f"{grid.name} on"].all()
        assert found[f"{grid.name} count"] == len(grid.coordinates)
        np.testing.assert_allclose(found[f"{grid.name} at"], grid.coordinates @ grid.matrix[:3, :3].T + grid.matrix[:3, 3], atol=1e-9)
    assert found["density class"] == "fog volume"
    assert found["unit"] == "metre"


def test_the_bytes_are_those_that_openvdb_has_read(tmp_path: Path) -> None:
    """In whatever order voxels are given."""
    grids = scattered()
    write_grids(grids, tmp_path / "a.vdb")
    content = (tmp_path / "a.vdb").read_bytes()
    assert hashlib.sha256(content).hexdigest() == "71500d7a3bea462ccb3d663cb3368b10e270252d35ce813b83cd5fc58b21a1d9"
    other = np.random.default_rng(1).permutation(len(grids[0].coordinates))
    write_grids([replace(grid, coordinates=grid.coordinates[other], values=grid.values[other]) for grid in grids], tmp_path / "b.vdb")
    assert (tmp_path / "b.vdb").read_bytes() == content
    assert len(content) < 1.3 * sum(grid.values.nbytes for grid in grids) + 200 * (64 * 2 + 1024 + 2 * 8192), "nothing is written of empty space"


def tree(voxel: float = 0.25, low: float = -1.0, shape: tuple[int, int, int] = (2, 2, 2), seed: int = 0) -> NerfTree:
    rng = np.random.default_rng(seed)
    at = np.argwhere(rng.random(np.array(shape) * 4) < 0.3)
    density = np.where(rng.random(len(at)) < 0.2, 0, rng.random(len(at)) * 100).astype(np.float32)
    return tree_from_voxels(shape, voxel, np.full(3, low), at, density, rng.normal(0, 3, (len(at), 4, 3)).astype(np.float32))


def test_density_and_colour_lie_where_the_asset_has_them() -> None:
    """What light loses along a way is the same in either frame; of harmonics of degree 0 alone colours are as they are, in linear light."""
    from efficientnerf.asset.queries import colour_at, density_at

    asset = tree()
    asset = replace(asset, harmonics=np.ascontiguousarray(asset.sh[:, :1]))
    density, colour = grids_of(asset, Y_DOWN, Path("a.vdb"))
    assert (density.name, colour.name) == ("density", "color")
    np.testing.assert_array_equal(density.coordinates, colour.coordinates)
    assert len(density.values) == (asset.density_values > 0).sum()
    centres = density.coordinates @ density.matrix[:3, :3].T + density.matrix[:3, 3]
    world = Y_DOWN.world_from_capture.points(centres)
    np.testing.assert_allclose(density.values / Y_DOWN.world_from_capture.scale, density_at(asset, world), rtol=1e-5)
    np.testing.assert_allclose(colour.values, linear_from_srgb(colour_at(asset, world)), atol=1e-3)


def test_colours_are_those_that_the_captured_cameras_see() -> None:
    """Two cameras above: yellow from there, blue from below."""
    from efficientnerf.asset.captured import captured_metadata

    poses = [np.array([[1.0, 0, 0, x], [0, -1, 0, 0], [0, 0, -1, 5], [0, 0, 0, 1]]) for x in (-0.5, 0.5)]
    path = captured_metadata([Camera("", 8, 8, "SIMPLE_PINHOLE", (8.0, 4.0, 4.0), pose) for pose in poses])
    at = np.argwhere(np.ones((4, 4, 4), bool))
    sh = np.zeros((64, 4, 3), np.float32)
    sh[:, 2] = (-12, -12, 12)  # times z of a ray's direction
    slab = tree_from_voxels((1, 1, 1), 0.25, np.full(3, -0.5), at, np.full(64, 9, np.float32), sh, metadata={"captured_path": path})
    _, colour = grids_of(slab, Z_UP, Path("a.vdb"))
    assert colour.values[:, :2].min() > 0.9
    assert colour.values[:, 2].max() < 0.1


def test_cascades_are_grids_of_their_own_that_do_not_overlap() -> None:
    parts = []
    for shape, voxel, low in cascade_grids(np.array([[-1.0] * 3, [1.0] * 3]), 0.125, 4, 2):
        at = np.argwhere(np.ones(np.array(shape) * 4, bool))
        parts.append(tree_from_voxels(shape, voxel, low, at, np.full(len(at), 5.0), np.zeros((len(at), 1, 3), np.float32)))
    grids = {grid.name: grid for grid in grids_of(nested(parts), Z_UP, Path("a.vdb"))}
    assert list(grids) == ["density", "color", "density_1", "color_1"]
    assert len(grids["density"].values) == 16**3
    assert len(grids["density_1"].values) == 16**3 - 8**3, "the inner box is left out"
    assert grids["density_1"].matrix[0, 0] == 2 * grids["density"].matrix[0, 0]


def test_what_makes_no_volume_is_refused(tmp_path: Path) -> None:
    forward_facing = replace(tree(), ndc=Ndc(np.eye(4), 50.0, 60, 40, 1.0))
    with pytest.raises(UsageError):
        VOLUME_EXPORTERS[".vdb"](forward_facing, tmp_path / "a.vdb", Z_UP)
    with pytest.raises(BadInput, match="density"):
        VOLUME_EXPORTERS[".vdb"](replace(tree(), density_values=np.zeros_like(tree().density_values)), tmp_path / "a.vdb", Z_UP)
    endless = replace(tree(), density_values=np.full_like(tree().density_values, 3e38))
    with pytest.raises(BadInput):
        VOLUME_EXPORTERS[".vdb"](endless, tmp_path / "a.vdb", replace(Z_UP, world_from_capture=replace(Z_UP.world_from_capture, scale=10.0)))
    assert not list(tmp_path.iterdir())
