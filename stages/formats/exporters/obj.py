"""Wavefront OBJ as text. The capture's frame.

Without a texture one file: `v x y z r g b` with sRGB colours 0-1 (the extension that most readers know), `vn`, `f v//vn`. With one, three: `v x y z`,
`vt u v`, `vn`, `f v/vt/vn`; a material file (`map_Kd`; illum 0: the colour as it is) and the picture. Readers part names at blanks
and know no encoding: the names of the other files are plain ASCII (`plain_stem`). The OBJ, which refers to the others, appears last.
"""

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from efficientnerf.surface.mesh import Mesh
from stages.formats.exporters import textures
from stages.formats.exporters.textures import Picture, distinct_places, picture_of, plain_stem
from stages.formats.exporters.writing import CAPTURE_IS_Z_UP, SourceFrame, check_mesh, text_rows, write_files, write_parts

_MATERIAL = "captured_light"


def companions(path: Path, picture: Picture = "png") -> list[Path]:
    """The files that are written next to an OBJ with a texture, in order: colours, the material."""
    return [*textures.companions(path, picture), path.with_name(plain_stem(path) + ".mtl")]


def write_mesh(mesh: Mesh, path: Path, frame: SourceFrame = CAPTURE_IS_Z_UP, picture: Picture = "png") -> None:
    """Write a mesh in the capture's frame. Raises BadInput."""
    check_mesh(mesh, path)
    texture = picture_of(mesh, picture)
    if texture is None:
        write_parts(path, _coloured(mesh, frame))
        return
    colours, material = companions(path, picture)
    described = f"newmtl {_MATERIAL}\nKa 0 0 0\nKd 1 1 1\nKs 0 0 0\nd 1\nillum 0\nmap_Kd {colours.name}\n".encode("ascii")
    files: dict[Path, Iterable[bytes]] = {colours: [texture], material: [described], path: _textured(mesh, frame, material.name)}
    write_files(files)


def head(frame: SourceFrame) -> bytes:
    """The first line."""
    return f"# {frame.comment}; colours sRGB\n".encode("ascii")


def _coloured(mesh: Mesh, frame: SourceFrame) -> Iterator[bytes]:
    yield head(frame)
    yield from text_rows("v %.9g %.9g %.9g %.4f %.4f %.4f\n", np.hstack([mesh.vertices, np.clip(mesh.colours, 0, 1)]))
    yield from text_rows("vn %.5f %.5f %.5f\n", mesh.normals)
    yield from text_rows("f %d//%d %d//%d %d//%d\n", np.repeat(mesh.faces + 1, 2, axis=1))


def _textured(mesh: Mesh, frame: SourceFrame, material: str) -> Iterator[bytes]:
    assert mesh.texture is not None
    places, number = distinct_places(mesh.texture)
    yield head(frame)
    yield f"mtllib {material}\n".encode("ascii")
    yield from text_rows("v %.9g %.9g %.9g\n", mesh.vertices)
    yield from text_rows("vt %.7f %.7f\n", places)
    yield from text_rows("vn %.5f %.5f %.5f\n", mesh.normals)
    yield f"usemtl {_MATERIAL}\n".encode("ascii")
    yield from text_rows("f %d/%d/%d %d/%d/%d %d/%d/%d\n", np.stack([mesh.faces, number, mesh.faces], 2).reshape(-1, 9) + 1)
