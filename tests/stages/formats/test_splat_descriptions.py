"""What is said of files of 3D Gaussians, ours and those of others; and that damaged headers are refused, whatever they say."""

import gzip
import io
import json
import random
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from efficientnerf.splats.gaussians import Gaussians
from pipeline.errors import BadInput
from stages.formats.exporters import MESH_EXPORTERS, SPLAT_EXPORTERS
from stages.formats.exporters.splats.description import describe_splats
from tests.stages.formats.gaussians import scattered
from tests.stages.io.meshes import Z_UP, block

COUNT = 41


def written(path: Path, gaussians: Gaussians) -> Path:
    SPLAT_EXPORTERS[path.suffix](gaussians, path, Z_UP)
    return path


@pytest.mark.parametrize("degree", [0, 3])
@pytest.mark.parametrize("extension", SPLAT_EXPORTERS)
def test_what_was_written_is_described(extension: str, degree: int, tmp_path: Path) -> None:
    facts = describe_splats(written(tmp_path / f"a{extension}", scattered(COUNT, degree)))
    assert (facts["gaussians"], facts["sh_degree"]) == (COUNT, degree)


@pytest.mark.parametrize("order", ["little", "big"])
def test_a_ply_of_others_has_its_columns_in_any_order_and_of_any_type(order: str, tmp_path: Path) -> None:
    columns = {
        "x": "f8", "segment": "u1", "y": "f4", "z": "f4", "opacity": "f4", "rot_0": "f4", "rot_1": "f4", "rot_2": "f4", "rot_3": "f4", "scale_2": "f4",
        "scale_1": "f4", "scale_0": "f8", **{f"f_dc_{k}": "f4" for k in range(3)}, **{f"f_rest_{k}": "f4" for k in range(9)},
    }  # fmt: skip
    rows = np.zeros(COUNT, [(name, (">" if order == "big" else "<") + kind) for name, kind in columns.items()])
    names = {"f8": "double", "f4": "float", "u1": "uchar"}
    head = f"ply\r\nformat binary_{order}_endian 1.0\r\ncomment made by \x1b[31m another\r\nelement vertex {COUNT}\r\n"
    head += "".join(f"property {names[kind]} {name}\r\n" for name, kind in columns.items()) + "element face 0\r\nproperty list uchar int i\r\nend_header\r\n"
    path = tmp_path / "a.ply"
    path.write_bytes(head.encode() + rows.tobytes())
    facts = describe_splats(path)
    assert (facts["gaussians"], facts["sh_degree"], len(facts["notes"])) == (COUNT, 1, 1)
    assert "\x1b" not in facts["notes"][0]


def spz(version: int, count: int, degree: int, flags: int = 0) -> bytes:
    return gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", version, count, degree, 12, flags, 0) + bytes(19 * min(count, 1000)))


def test_the_older_spz_versions(tmp_path: Path) -> None:
    path = tmp_path / "a.spz"
    for version, flags, notes in ((1, 0, []), (2, 1, ["antialiased"])):
        path.write_bytes(spz(version, 2, 1, flags))
        assert describe_splats(path) == {"format": f"SPZ {version}", "gaussians": 2, "sh_degree": 1, "notes": notes}


@pytest.mark.parametrize("extension", [".ply", ".glb"])
def test_a_mesh_is_none_of_it(extension: str, tmp_path: Path) -> None:
    MESH_EXPORTERS[extension](block(), tmp_path / f"a{extension}", Z_UP)
    assert describe_splats(tmp_path / f"a{extension}") is None


def described_or_refused(path: Path) -> dict[str, Any] | str | None:
    """The facts, or the refusal."""
    try:
        return describe_splats(path)
    except BadInput as error:
        return str(error)


@pytest.mark.parametrize("extension", SPLAT_EXPORTERS)
def test_no_altered_byte_does_more_than_a_refusal(extension: str, tmp_path: Path) -> None:
    """Facts that are finite, or BadInput."""
    path, draw = written(tmp_path / f"a{extension}", scattered(3, 1)), random.Random(1)
    whole = path.read_bytes()
    for _ in range(300):
        altered = bytearray(whole)
        for _ in range(draw.randrange(1, 4)):
            altered[draw.randrange(len(whole) if draw.random() < 0.3 else min(len(whole), 1200))] = draw.choice([0, 1, 2, 45, 48, 57, 127, 128, 255])
        path.write_bytes(altered)
        found = described_or_refused(path)
        if isinstance(found, str):
            assert found.startswith(f"{path}: ")
            assert found.isprintable()
        else:
            json.dumps(found, allow_nan=False)


def glb_with(change: Callable[[dict[str, Any]], None]) -> Callable[[bytes], bytes]:
    def damaged(whole: bytes) -> bytes:
        size = struct.unpack_from("<I", whole, 12)[0]
        document = json.loads(whole[20 : 20 + size])
        change(document)
        text = json.dumps(document).encode()
        text += b" " * (-len(text) % 4)
        rest = whole[20 + size :]
        return struct.pack("<4sII", b"glTF", 2, 20 + len(text) + len(rest)) + struct.pack("<I4s", len(text), b"JSON") + text + rest

    return damaged


def replaced(old: bytes, new: bytes) -> Callable[[bytes], bytes]:
    def damaged(whole: bytes) -> bytes:
        assert old in whole
        return whole.replace(old, new, 1)

    return damaged


def sog_with(change: Callable[[dict[str, Any]], None], compression: int = zipfile.ZIP_STORED) -> Callable[[bytes], bytes]:
    """With another meta.json."""

    def damaged(whole: bytes) -> bytes:
        out = io.BytesIO()
        with zipfile.ZipFile(io.BytesIO(whole)) as archive, zipfile.ZipFile(out, "w", compression) as made:
            meta = json.loads(archive.read("meta.json"))
            change(meta)
            made.writestr("meta.json", json.dumps(meta))
        return out.getvalue()

    return damaged


def test_a_deflated_sog_of_others_is_described(tmp_path: Path) -> None:
    path = written(tmp_path / "a.sog", scattered(COUNT, 1))
    before = describe_splats(path)
    path.write_bytes(sog_with(lambda meta: meta.update(antialias=True), zipfile.ZIP_DEFLATED)(path.read_bytes()))
    assert describe_splats(path) == {**before, "notes": ["antialiased", *before["notes"]]}


PREFIX = "KHR_gaussian_splatting"
HOSTILE: dict[str, tuple[str, Callable[[bytes], bytes], str]] = {
    "more Gaussians than bytes": (".ply", replaced(b"vertex 4", b"vertex 999999999999"), "expected"),
    "a list": (".ply", replaced(b"property float nx", b"property list uchar int nx"), "columns of numbers"),
    "a type unknown": (".ply", replaced(b"property float nx", b"property quad nx"), "quad"),
    "seven f_rest": (".ply", replaced(b"property float f_rest_0", b"property float other_00"), r"f_rest"),
    "text": (".ply", replaced(b"binary_little_endian", b"ascii"), "in text"),
    "another element before": (".ply", replaced(b"element vertex", b"element camera 0\nproperty float a\nelement vertex"), "first element"),
    "of SuperSplat": (".ply", replaced(b"property float nx", b"property uint packed_position\nproperty uint packed_rotation"), "SuperSplat"),
    "no gzip": (".spz", lambda whole: b"\0" * 50, "damaged header"),
    "cut short": (".spz", lambda whole: whole[:9], "damaged header"),
    "another magic": (".spz", lambda whole: gzip.compress(bytes(50)), "version 0"),
    "a later version": (".spz", lambda whole: spz(9, 1, 0), "version 9"),
    "degree 9": (".spz", lambda whole: spz(3, 1, 9), "degree 9"),
    "no Gaussian": (".spz", lambda whole: spz(3, 0, 0), "0 Gaussians"),
    "no zip": (".sog", lambda whole: b"\0" * 50, "BadZipFile"),
    "version 1": (".sog", sog_with(lambda meta: meta.pop("version")), "KeyError"),
    "version 3": (".sog", sog_with(lambda meta: meta.update(version=3)), "no SOG of version 2"),
    "a bomb": (".sog", sog_with(lambda meta: meta.update(more="a" * 10_000_000), zipfile.ZIP_DEFLATED), "10[0-9]* bytes"),
    "a number of Gaussians in words": (".sog", sog_with(lambda meta: meta.update(count="many")), "many Gaussians"),
    "five bands": (".sog", sog_with(lambda meta: meta["shN"].update(bands=5)), "degree 5"),
    "an accessor that is not there": (".glb", glb_with(lambda d: d["meshes"][0]["primitives"][0]["attributes"].update(POSITION=99)), "IndexError"),
    "a list for a document": (".glb", glb_with(lambda d: d.update(meshes=3)), "TypeError"),
    "a count of words": (".glb", glb_with(lambda d: d["accessors"][0].update(count="many")), "TypeError"),
    "compressed": (
        ".glb",
        glb_with(lambda d: d["meshes"][0]["primitives"][0]["extensions"][PREFIX].update(extensions={f"{PREFIX}_compression_spz_2": {}})),
        "compressed by KHR_gaussian_splatting_compression_spz_2",
    ),
    "not a number": (".glb", lambda whole: whole.replace(b'"scene":0', b'"scene":NaN', 1), "JSON"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_files_are_refused(name: str, tmp_path: Path) -> None:
    extension, damaged, message = HOSTILE[name]
    path = written(tmp_path / f"a{extension}", scattered(4, 1))
    path.write_bytes(damaged(path.read_bytes()))
    with pytest.raises(BadInput, match=message) as caught:
        describe_splats(path)
    assert str(caught.value).startswith(str(path))
