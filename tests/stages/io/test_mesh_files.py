"""The mesh of a run, read again from its files: what was written, or a word about what is wrong."""

import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from efficientnerf.surface.mesh import Mesh, Texture
from pipeline.errors import CorruptArtifact
from stages.artifacts import MeshOutputs
from stages.formats.exporters import MESH_EXPORTERS
from stages.formats.exporters.writing import MOST_TEXELS
from stages.io.png import write_png
from stages.mesh.files import read_mesh
from tests.stages.io.meshes import Y_DOWN, block, glb_bytes, glb_document


def textured() -> Mesh:
    """The block with a texture of noise at places that differ from corner to corner."""
    rng = np.random.default_rng(0)
    return replace(block(), texture=Texture(rng.random((12, 3, 2)).round(3), rng.integers(0, 256, (32, 32, 3), dtype=np.uint8)))


def written(folder: Path, mesh: Mesh) -> MeshOutputs:
    folder.mkdir(exist_ok=True)
    outputs = MeshOutputs(folder)
    for path in (outputs.ply, outputs.glb, outputs.obj):
        MESH_EXPORTERS[path.suffix](mesh, path, Y_DOWN)
    return outputs


@pytest.mark.parametrize("mesh", [block(), textured()], ids=["vertex colours", "texture"])
def test_what_is_read_is_what_was_written(mesh: Mesh, tmp_path: Path) -> None:
    found = read_mesh(written(tmp_path, mesh))
    np.testing.assert_allclose(found.vertices, mesh.vertices, rtol=1e-6)
    np.testing.assert_array_equal(found.faces, mesh.faces)
    np.testing.assert_allclose(found.normals, mesh.normals, atol=1e-6)
    np.testing.assert_allclose(found.colours, mesh.colours, atol=0.5 / 255 + 1e-6)
    assert (found.texture is None) == (mesh.texture is None)
    if mesh.texture is not None and found.texture is not None:
        np.testing.assert_allclose(found.texture.coordinates, mesh.texture.coordinates, atol=1e-6)
        np.testing.assert_array_equal(found.texture.colours, mesh.texture.colours)


def rewritten(path: Path, change: Callable[[dict], None]) -> None:
    """The JSON part of a GLB, changed."""
    document, data = glb_document(path)
    change(document)
    path.write_bytes(glb_bytes(document, data))


SPOILT: dict[str, Callable[[MeshOutputs], object]] = {
    "no ply": lambda outputs: outputs.ply.unlink(),
    "no glb": lambda outputs: outputs.glb.unlink(),
    "a ply cut off": lambda outputs: outputs.ply.write_bytes(outputs.ply.read_bytes()[:-5]),
    "an empty ply": lambda outputs: outputs.ply.write_bytes(b""),
    "a ply of large numbers": lambda outputs: outputs.ply.write_bytes(outputs.ply.read_bytes().replace(b"element face 12", b"element face 99999999999999")),
    "faces beyond the vertices": lambda outputs: outputs.ply.write_bytes(outputs.ply.read_bytes()[:-4] + struct.pack("<i", 8)),
    "an empty glb": lambda outputs: outputs.glb.write_bytes(b""),
    "a glb cut off": lambda outputs: outputs.glb.write_bytes(outputs.glb.read_bytes()[:-2000]),
    "a glb of another mesh": lambda outputs: MESH_EXPORTERS[".glb"](replace(textured(), vertices=block().vertices * 2), outputs.glb, Y_DOWN),
    "no meshes": lambda outputs: rewritten(outputs.glb, lambda document: document.pop("meshes")),
    "an accessor out of range": lambda outputs: rewritten(outputs.glb, lambda document: document["accessors"][2].update(count=10**9)),
    "no picture": lambda outputs: outputs.texture.unlink(),
    "a picture cut off": lambda outputs: outputs.texture.write_bytes(outputs.texture.read_bytes()[:-40]),
    "a picture without colours": lambda outputs: write_png(np.zeros((8, 8), np.uint8), outputs.texture),
    "a picture of too many texels": lambda outputs: write_png(np.zeros((1, MOST_TEXELS + 1, 3), np.uint8), outputs.texture),
}


@pytest.mark.parametrize("how", SPOILT)
def test_damaged_files_are_said(how: str, tmp_path: Path) -> None:
    outputs = written(tmp_path, textured())
    SPOILT[how](outputs)
    with pytest.raises(CorruptArtifact):
        read_mesh(outputs)
