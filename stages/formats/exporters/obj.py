"""Wavefront OBJ as text. The capture's frame.

Without a texture one file: `v x y z r g b` with sRGB colours 0-1 (the extension that most readers know), `vn`, `f v//vn`. With one, three or four: `v x y z`,
`vt u v`, `vn`, `f v/vt/vn`; a material file (`map_Kd`, `norm` for a normal map; illum 0: the colour as it is) and the pictures. Readers part names at blanks
and know no encoding: the names of the other files are plain ASCII (`plain_stem`). The OBJ, which refers to the others, appears last.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from efficientnerf.surface.mesh import Mesh
from stages.formats.exporters.textures import EXTENSIONS, Picture, encoded, plain_stem
from stages.formats.exporters.writing import CAPTURE_IS_Z_UP, SourceFrame, check_mesh, write_files, write_parts

_ROWS = 50_000  # lines made at a time
_MATERIAL = "captured_light"


def companions(path: Path, picture: Picture = "png", normal_map: bool = False) -> list[Path]:
    """The files that are written next to an OBJ with a texture, in order: colours, the normal map where there is one, the material."""
    suffixes = (EXTENSIONS[picture], *(("_normal.png",) if normal_map else ()), ".mtl")
    return [path.with_name(plain_stem(path) + suffix) for suffix in suffixes]


def write_mesh(mesh: Mesh, path: Path, frame: SourceFrame = CAPTURE_IS_Z_UP, picture: Picture = "png") -> None:
    """Write a mesh in the capture's frame. Raises BadInput."""
    check_mesh(mesh, path)
    if mesh.texture is None:
        write_parts(path, _coloured(mesh, frame))
        return
    normals = mesh.texture.normals
    colours, *between, material = companions(path, picture, normals is not None)
    files: dict[Path, Iterable[bytes]] = {colours: [encoded(mesh.texture.colours, picture)]}
    if normals is not None:
        files[between[0]] = [encoded(normals, "png")]
    files[material] = [_material(colours.name, between[0].name if between else None)]
    write_files({**files, path: _textured(mesh, frame, material.name)})


def head(frame: SourceFrame) -> bytes:
    """The first line."""
    up = " ".join(f"{value:.9g}" for value in frame.up + 0.0)
    return f"# frame of the capture; up {up}; unit {'metre' if frame.metric else 'unknown'}; colours sRGB\n".encode("ascii")


def _coloured(mesh: Mesh, frame: SourceFrame) -> Iterator[bytes]:
    yield head(frame)
    yield from _lines("v %.9g %.9g %.9g %.4f %.4f %.4f\n", np.hstack([mesh.vertices, np.clip(mesh.colours, 0, 1)]))
    yield from _lines("vn %.5f %.5f %.5f\n", mesh.normals)
    yield from _lines("f %d//%d %d//%d %d//%d\n", np.repeat(mesh.faces + 1, 2, axis=1))


def _textured(mesh: Mesh, frame: SourceFrame, material: str) -> Iterator[bytes]:
    assert mesh.texture is not None
    places = np.ascontiguousarray(mesh.texture.coordinates.reshape(-1, 2), np.float32) + np.float32(0)
    _, first, number = np.unique(places.view(np.uint64).ravel(), return_index=True, return_inverse=True)
    yield head(frame)
    yield f"mtllib {material}\n".encode("ascii")
    yield from _lines("v %.9g %.9g %.9g\n", mesh.vertices)
    yield from _lines("vt %.7f %.7f\n", places[first])
    yield from _lines("vn %.5f %.5f %.5f\n", mesh.normals)
    yield f"usemtl {_MATERIAL}\n".encode("ascii")
    yield from _lines("f %d/%d/%d %d/%d/%d %d/%d/%d\n", np.stack([mesh.faces, number.reshape(-1, 3), mesh.faces], 2).reshape(-1, 9) + 1)


def _material(colours: str, normals: str | None) -> bytes:
    lines = [f"newmtl {_MATERIAL}", "Ka 0 0 0", "Kd 1 1 1", "Ks 0 0 0", "d 1", "illum 0", f"map_Kd {colours}"]
    return "".join(f"{line}\n" for line in [*lines, *([] if normals is None else [f"norm {normals}"])]).encode("ascii")


def _lines(form: str, rows: np.ndarray) -> Iterator[bytes]:
    for start in range(0, len(rows), _ROWS):
        part = rows[start : start + _ROWS]
        yield (form * len(part) % tuple(part.ravel().tolist())).encode("ascii")
