"""What is said of files of 3D Gaussians, ours and those of others; and that damaged ones are named, whatever their headers say."""

import gzip
import io
import json
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from efficientnerf.splats.gaussians import Gaussians
from pipeline.errors import BadInput
from stages.formats.exporters import SPLAT_EXPORTERS
from stages.formats.exporters.splats import description
from stages.formats.exporters.splats.description import describe_splats
from stages.formats.exporters.splats.frames import with_y_down, with_y_up
from stages.formats.exporters.splats.spz import zstd
from tests.stages.formats.gaussians import scattered
from tests.stages.io.meshes import Y_DOWN, Z_UP, block, glb_bytes, glb_parts

COUNT = 41


def written(path: Path, gaussians: Gaussians, frame: Any = Z_UP) -> Path:
    SPLAT_EXPORTERS[path.suffix](gaussians, path, frame)
    return path


def same(facts: dict[str, Any] | None, gaussians: Gaussians, coded: bool) -> None:
    assert (facts["gaussians"], facts["sh_degree"], facts["not_finite"]) == (len(gaussians), gaussians.degree, None)
    np.testing.assert_allclose(facts["bounds"], [gaussians.means.min(axis=0), gaussians.means.max(axis=0)], atol=2.0**-12 if coded else 1e-6)
    scales = [gaussians.scales.min(), gaussians.scales.max()]
    np.testing.assert_allclose(np.log(facts["scales"]), np.log(scales), atol=1 / 32 + 1e-6 if coded else 1e-5)
    if facts["format"] == "SOG 2":
        assert facts["opacities"] is None
        return
    opacities = [gaussians.opacities.min(), gaussians.opacities.max()]
    np.testing.assert_allclose(facts["opacities"], opacities, atol=0.5 / 255 + 1e-6 if coded else 1e-6)


@pytest.mark.parametrize(("extension", "degree", "frame", "at_once"), [(each, *how) for each in SPLAT_EXPORTERS for how in [(0, Z_UP, 7), (3, Y_DOWN, 2**16)]])
def test_what_was_written_is_described(extension: str, degree: int, frame: Any, at_once: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In the file's frame, whatever the pieces in which it is read."""
    monkeypatch.setattr(description, "AT_ONCE", at_once)
    gaussians = scattered(COUNT, degree)
    facts = describe_splats(written(tmp_path / f"a{extension}", gaussians, frame))
    same(facts, {".ply": gaussians, ".sog": with_y_down(gaussians, frame)}.get(extension, with_y_up(gaussians, frame)), extension in (".spz", ".sog"))


@pytest.mark.parametrize("order", ["little", "big"])
def test_a_ply_of_others_has_its_columns_in_any_order_and_of_any_type(order: str, tmp_path: Path) -> None:
    gaussians = scattered(COUNT, 1)
    columns = {
        "x": "f8", "segment": "u1", "y": "f4", "z": "f4", "opacity": "f4", "rot_0": "f4", "rot_1": "f4", "rot_2": "f4", "rot_3": "f4", "scale_2": "f4",
        "scale_1": "f4", "scale_0": "f8", **{f"f_dc_{k}": "f4" for k in range(3)}, **{f"f_rest_{k}": "f4" for k in range(9)},
    }  # fmt: skip
    rows = np.zeros(COUNT, [(name, (">" if order == "big" else "<") + kind) for name, kind in columns.items()])
    for k in range(3):
        rows["xyz"[k]], rows[f"scale_{k}"] = gaussians.means[:, k], np.log(gaussians.scales[:, k])
    rows["opacity"] = np.log(gaussians.opacities / (1 - gaussians.opacities))
    names = {"f8": "double", "f4": "float", "u1": "uchar"}
    head = f"ply\r\nformat binary_{order}_endian 1.0\r\ncomment made by \x1b[31m another\r\nelement vertex {COUNT}\r\n"
    head += "".join(f"property {names[kind]} {name}\r\n" for name, kind in columns.items()) + "element face 0\r\nproperty list uchar int i\r\nend_header\r\n"
    path = tmp_path / "a.ply"
    path.write_bytes(head.encode() + rows.tobytes())
    facts = describe_splats(path)
    same(facts, gaussians, coded=False)
    assert len(facts["notes"]) == 1
    assert "\x1b" not in facts["notes"][0]


def spz(version: int, count: int, degree: int, body: bytes, bits: int = 12, flags: int = 0) -> bytes:
    return gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", version, count, degree, bits, flags, 0) + body)


def test_the_older_spz_versions(tmp_path: Path) -> None:
    """1: places of half floats; 1 and 2: rotations of three bytes."""
    path, at = tmp_path / "a.spz", np.array([[1.5, -2, 0.25], [-1, 4, 8]])
    rest = bytes([0, 255]) + bytes(6) + bytes([160] * 6) + bytes(6) + bytes(18)  # opacities, colours, scales, rotations, harmonics of degree 1
    path.write_bytes(spz(1, 2, 1, at.astype("<f2").tobytes() + rest))
    first = describe_splats(path)
    fixed = (at * 2**12).astype("<i4").reshape(-1, 1).view(np.uint8)[:, :3].tobytes()
    path.write_bytes(spz(2, 2, 1, fixed + rest, flags=1))
    second = describe_splats(path)
    assert first["bounds"] == second["bounds"] == [at.min(axis=0).tolist(), at.max(axis=0).tolist()]
    assert first["scales"] == second["scales"] == [1.0, 1.0]
    assert first["opacities"] == second["opacities"] == [0.0, 1.0]
    assert (first["format"], second["format"], first["notes"], second["notes"]) == ("SPZ 1", "SPZ 2", [], ["antialiased"])


def spz4(count: int = 5, degree: int = 1, table: int = 32, most: int = 6, cut: int = 0, change: Callable[[list[bytes]], list[bytes]] = list) -> bytes:
    """Zeros. most: streams; cut: bytes that are not there at the end; change: of the streams before they are compressed."""
    parts = change([bytes(count * width) for width in (9, 1, 3, 3, 4, 3 * ((degree + 1) ** 2 - 1))][:most])
    streams = [zstd.compress(part) for part in parts]
    head = struct.pack("<4sIIBBBBI12x", b"NGSP", 4, count, degree, 12, 0, len(parts), table)
    sizes = b"".join(struct.pack("<QQ", len(stream), len(part)) for stream, part in zip(streams, parts, strict=True))
    whole = head + sizes + b"".join(streams)
    return whole[: len(whole) - cut]


def lying(whole: bytes, stated: int, held: int) -> bytes:
    """The same with a first stream that unpacks to another number of bytes than the table states."""
    stored, unpacked = struct.unpack_from("<QQ", whole, 32)
    assert unpacked == stated
    other, begin = zstd.compress(bytes(held)), 32 + 16 * whole[15]
    return whole[:32] + struct.pack("<QQ", len(other), stated) + whole[48:begin] + other + whole[begin + stored :]


@pytest.mark.parametrize("extension", [".ply", ".glb"])
def test_a_mesh_is_none_of_it(extension: str, tmp_path: Path) -> None:
    from stages.formats.exporters import MESH_EXPORTERS

    MESH_EXPORTERS[extension](block(), tmp_path / f"a{extension}", Z_UP)
    assert describe_splats(tmp_path / f"a{extension}") is None


def test_numbers_that_are_not_finite_are_counted(tmp_path: Path) -> None:
    path = written(tmp_path / "a.ply", scattered(COUNT, 0))
    content = path.read_bytes()
    body = content.index(b"end_header\n") + 11
    path.write_bytes(content[:body] + np.float32(np.nan).tobytes() + content[body + 4 :])
    facts = describe_splats(path)
    assert facts["not_finite"] == 1
    assert np.isfinite(facts["bounds"]).all()


def described_or_refused(path: Path) -> dict[str, Any] | str | None:
    """The facts, or the refusal."""
    try:
        return describe_splats(path)
    except BadInput as error:
        return str(error)


@pytest.mark.parametrize("extension", SPLAT_EXPORTERS)
def test_what_is_cut_short_is_named(extension: str, tmp_path: Path) -> None:
    """At every byte; a header that is cut leaves nothing that could be told from another file of that extension."""
    path = written(tmp_path / f"a{extension}", scattered(2, 1))
    whole = path.read_bytes()
    begin = {".ply": whole.find(b"end_header\n") + 11, ".glb": whole.find(b"BIN\0") + 4, ".spz": 0, ".sog": 0}[extension]
    assert begin >= 0
    for end in range(0, len(whole), 37 if extension in (".glb", ".sog") else 3):
        path.write_bytes(whole[:end])
        if end >= begin:
            with pytest.raises(BadInput, match=rf"a\{extension}"):
                describe_splats(path)
        else:
            found = described_or_refused(path)
            assert found is None or isinstance(found, str)


def glb_with(change: Callable[[dict[str, Any]], None]) -> Callable[[bytes], bytes]:
    def damaged(whole: bytes) -> bytes:
        document, data = glb_parts(whole)
        change(document)
        return glb_bytes(document, data)

    return damaged


def replaced(old: bytes, new: bytes) -> Callable[[bytes], bytes]:
    def damaged(whole: bytes) -> bytes:
        assert old in whole
        return whole.replace(old, new, 1)

    return damaged


def sog_with(change: Callable[[dict[str, Any]], None], compression: int = zipfile.ZIP_STORED, **others: bytes) -> Callable[[bytes], bytes]:
    """With another meta.json, or other images."""

    def damaged(whole: bytes) -> bytes:
        out = io.BytesIO()
        with zipfile.ZipFile(io.BytesIO(whole)) as archive, zipfile.ZipFile(out, "w", compression) as made:
            for name in archive.namelist():
                content = others.get(name.partition(".")[0], archive.read(name))
                if name == "meta.json":
                    meta = json.loads(content)
                    change(meta)
                    content = json.dumps(meta).encode()
                made.writestr(name, content)
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
    "a list": (".ply", replaced(b"property float x", b"property list uchar int x"), "property list"),
    "a column twice": (".ply", replaced(b"property float nx", b"property float x"), "each once"),
    "a type unknown": (".ply", replaced(b"property float nx", b"property quad nx"), "quad"),
    "seven f_rest": (".ply", replaced(b"property float f_rest_0", b"property float other_00"), r"f_rest"),
    "text": (".ply", replaced(b"binary_little_endian", b"ascii"), "not binary"),
    "another element before": (".ply", replaced(b"element vertex", b"element camera 0\nproperty float a\nelement vertex"), "first element"),
    "columns of another element": (".ply", replaced(b"property float x", b"property float y\nelement other 1\nproperty float x"), "lack columns|each once"),
    "of SuperSplat": (".ply", replaced(b"property float nx", b"property uint packed_position\nproperty uint packed_rotation"), "SuperSplat"),
    "no gzip": (".spz", lambda whole: b"\0" * 50, "gzip"),
    "another magic": (".spz", lambda whole: gzip.compress(bytes(50)), "version 0"),
    "a later version": (".spz", lambda whole: spz(9, 1, 0, bytes(20)), "version 9"),
    "degree 9": (".spz", lambda whole: spz(3, 1, 9, bytes(20)), "degree 9"),
    "no Gaussian": (".spz", lambda whole: spz(3, 0, 0, b""), "hold none"),
    "four thousand million": (".spz", lambda whole: spz(3, 2**32 - 1, 0, bytes(20)), "4294967295 Gaussians"),
    "a bomb": (".spz", lambda whole: spz(3, 1, 0, bytes(10_000_000)), "goes on after"),
    "a bomb behind the Gaussians": (".spz", lambda whole: spz(3, 1, 0, bytes(20_000_000), flags=2), "goes on after"),
    "two million Gaussians of nothing": (".spz", lambda whole: spz(3, 2_000_000, 0, bytes(40_000_000)), "not as many"),
    "a wrong checksum": (".spz", lambda whole: whole[:-8] + b"abcd" + whole[-4:], "gzip"),
    "no room for the table": (".spz", lambda whole: spz4(table=2**31), "table of 6 streams"),
    "too few streams": (".spz", lambda whole: spz4(most=1), "table of 1 streams"),
    "streams beyond the end": (".spz", lambda whole: spz4(cut=3), "for its streams"),
    "places of another size": (".spz", lambda whole: spz4(change=lambda parts: [b"seven..", *parts[1:]]), "streams of 7,"),
    "no frame of zstd": (".spz", lambda whole: (made := spz4())[:128] + bytes(len(made) - 128), "zstd"),
    "a frame that holds less": (".spz", lambda whole: lying(spz4(), 9 * 5, 9 * 4), "end before"),
    "a frame that holds more": (".spz", lambda whole: lying(spz4(), 9 * 5, 9 * 6), "goes on"),
    "no zip": (".sog", lambda whole: b"\0" * 50, "BadZipFile"),
    "version 1": (".sog", sog_with(lambda meta: meta.pop("version")), "KeyError"),
    "version 3": (".sog", sog_with(lambda meta: meta.update(version=3)), "no SOG of version 2"),
    "an image that is not there": (".sog", sog_with(lambda meta: meta["quats"].update(files=["other.webp"])), "KeyError"),
    "an image that is none": (".sog", sog_with(lambda meta: None, sh0=b"GIF89a"), "sh0.webp is no WebP"),
    "an image of another checksum": (".sog", replaced(b"WEBPVP8L", b"WEBPVP8M"), "Bad CRC"),
    "a deflated bomb": (".sog", sog_with(lambda meta: None, zipfile.ZIP_DEFLATED, sh0=bytes(10_000_000)), "10000000 bytes"),
    "packed as bzip2": (".sog", sog_with(lambda meta: None, zipfile.ZIP_BZIP2), "compression 12"),
    "a million Gaussians": (".sog", sog_with(lambda meta: meta.update(count=10**8)), "not as many"),
    "a number of Gaussians in words": (".sog", sog_with(lambda meta: meta.update(count="many")), "not as many"),
    "four bands": (".sog", sog_with(lambda meta: meta["shN"].update(bands=4)), "degree 4"),
    "a short codebook": (".sog", sog_with(lambda meta: meta["scales"].update(codebook=[1.0])), "expected 256 numbers"),
    "a range of words": (".sog", sog_with(lambda meta: meta["means"].update(mins=["a", 1, 2])), "expected 3 numbers"),
    "a range beyond all numbers": (".sog", sog_with(lambda meta: meta["means"].update(mins=[10**400, 1, 2])), "OverflowError"),
    "a list for meta.json": (".sog", sog_with(lambda meta: meta.update(means=[])), "TypeError"),
    "an accessor that is not there": (".glb", glb_with(lambda d: d["meshes"][0]["primitives"][0]["attributes"].update(POSITION=99)), "IndexError"),
    "a list for a document": (".glb", glb_with(lambda d: d.update(meshes=3)), "TypeError"),
    "a count of words": (".glb", glb_with(lambda d: d["accessors"][0].update(count="many")), "row by row|of numbers"),
    "two counts": (".glb", glb_with(lambda d: d["accessors"][3].update(count=1)), "as many of each"),
    "matrices": (".glb", glb_with(lambda d: d["accessors"][0].update(type="MAT4")), "MAT4"),
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
