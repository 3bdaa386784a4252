"""Files of 3D Gaussians: written by us, read by the letter of their formats, and by others where there are any."""

import gzip
import io
import json
import os
import shutil
import subprocess
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numba
import numpy as np
import pytest
from PIL import Image

from efficientnerf.geometry.cameras import Similarity
from efficientnerf.rendering.colour import linear_from_srgb
from efficientnerf.rendering.harmonics import basis_numpy
from efficientnerf.splats.gaussians import Gaussians
from pipeline.errors import BadInput, CorruptArtifact
from stages.formats.exporters import SPLAT_EXPORTERS
from stages.formats.exporters.glb import gltf_from_capture
from stages.formats.exporters.splats import sog
from stages.formats.exporters.splats.description import describe_splats
from stages.formats.exporters.splats.frames import moved
from stages.formats.exporters.splats.ply import property_names, read_splats
from stages.formats.exporters.writing import SourceFrame
from tests.efficientnerf.splats_reference import covariances
from tests.stages.formats.gaussians import joined_streams, read_glb_splats, read_sog, read_spz, scattered
from tests.stages.io.meshes import Y_DOWN, Z_UP, accessor, glb_document

Y_UP = SourceFrame(Similarity(1, np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]), np.zeros(3)))
SPLAT_TRANSFORM = os.environ.get("SPLAT_TRANSFORM") or shutil.which("splat-transform")
def turn(seed: int) -> np.ndarray:
    found, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return found * np.linalg.det(found)


def colours(gaussians: Gaussians, directions: np.ndarray) -> np.ndarray:
    """(D, N, 3), unclipped."""
    return np.einsum("dk,nkc->dnc", basis_numpy(directions, gaussians.degree), gaussians.harmonics.astype(np.float64))


@pytest.mark.parametrize(("degree", "seed"), [(0, 0), (1, 1), (3, 2)])
def test_a_gaussian_looks_the_same_to_an_eye_that_moves_along(degree: int, seed: int) -> None:
    """Colours to each side, places, sizes and axes; and there and back is nothing."""
    before, similarity = scattered(20, degree), Similarity(0.37, turn(seed), np.array([1.0, -2, 3]))
    after = moved(before, similarity)
    directions = np.random.default_rng(1).normal(size=(30, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    np.testing.assert_allclose(colours(after, directions @ similarity.rotation.T), colours(before, directions), atol=1e-6)
    np.testing.assert_allclose(after.means, similarity.points(before.means), rtol=1e-5, atol=1e-6)
    spread = similarity.scale**2 * np.einsum("ij,njk,lk->nil", similarity.rotation, covariances(before), similarity.rotation)
    np.testing.assert_allclose(covariances(after), spread, atol=1e-6 * spread.max())
    back = moved(after, similarity.inverse())
    np.testing.assert_allclose(back.harmonics, before.harmonics, atol=1e-6)
    np.testing.assert_allclose(np.abs((back.rotations * before.rotations).sum(axis=1)), 1, atol=1e-6)


def test_the_ply_is_that_of_3dgs(tmp_path: Path) -> None:
    """Names and their order; logarithms, logits, and f_rest by channel."""
    one = replace(scattered(1, degree=1), opacities=np.array([0.75], np.float32), scales=np.array([[1.0, np.e, 0.5]], np.float32))
    SPLAT_EXPORTERS[".ply"](one, tmp_path / "a.ply", Y_DOWN)
    head, body = (tmp_path / "a.ply").read_bytes().split(b"end_header\n", 1)
    lines = head.decode().splitlines()
    assert lines[:4] == ["ply", "format binary_little_endian 1.0", "comment frame of the capture; up 0 -1 0; unit metre", "element vertex 1"]
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{k}" for k in range(9)), "opacity", "scale_0", "scale_1", "scale_2"]
    assert lines[4:] == [f"property float {name}" for name in [*names, "rot_0", "rot_1", "rot_2", "rot_3"]]
    row = np.frombuffer(body, "<f4")
    np.testing.assert_array_equal(row[:9], [*one.means[0], 0, 0, 0, *one.harmonics[0, 0]])
    np.testing.assert_array_equal(row[9:18], [one.harmonics[0, k, c] for c in range(3) for k in (1, 2, 3)])
    np.testing.assert_allclose(row[18:22], [np.log(3), 0, 1, np.log(0.5)], atol=1e-6)
    np.testing.assert_array_equal(row[22:], one.rotations[0])


def from_y_up(gaussians: Gaussians, frame: SourceFrame) -> Gaussians:
    return moved(gaussians, Similarity(1.0, gltf_from_capture(frame.up).T, np.zeros(3)))


def from_y_down(gaussians: Gaussians, frame: SourceFrame) -> Gaussians:
    return from_y_up(moved(gaussians, Similarity(1.0, np.diag([1.0, -1, -1]), np.zeros(3))), frame)


READERS: dict[str, Callable[[Path, SourceFrame], Gaussians]] = {
    ".ply": lambda path, _: read_splats(path),
    ".spz": lambda path, frame: from_y_up(read_spz(path)[1], frame),
    ".sog": lambda path, frame: from_y_down(read_sog(path)[1], frame),
    ".glb": lambda path, frame: from_y_up(read_glb_splats(path)[1], frame),
}
# What a format keeps: places, the logarithms of scales, opacities, first harmonics, those above.
FINE, CODED = (1e-6, 1e-6, 1e-6, 1e-6, 2e-6), (2.0**-12, 1 / 32 + 1e-3, 0.5 / 255 + 1e-3, 0.5 / 255 / 0.15 + 1e-3, 4 / 128)
LIMITS = {".ply": FINE, ".spz": CODED, ".sog": (2.0**-11, 1e-3, 0.5 / 255 + 1e-6, 1e-3, 0.06), ".glb": FINE}
ANGLES = {".ply": 0.1, ".spz": 0.4, ".sog": 1.0, ".glb": 0.1}  # degrees


def differs_by(found: Gaussians, expected: Gaussians) -> tuple[float, ...]:
    pairs = [
        (found.means, expected.means), (np.log(found.scales), np.log(expected.scales)), (found.opacities, expected.opacities),
        (found.harmonics[:, 0], expected.harmonics[:, 0]), (found.harmonics[:, 1:], expected.harmonics[:, 1:]),
    ]  # fmt: skip
    return tuple(float(np.abs(a - b).max(initial=0)) for a, b in pairs)


def in_order_of(found: Gaussians, gaussians: Gaussians) -> Gaussians:
    """Each where the nearest one is."""
    order = np.linalg.norm(found.means[:, None] - gaussians.means, axis=2).argmin(axis=1)
    assert sorted(order) == list(range(len(gaussians)))
    return gaussians.subset(order)


@pytest.mark.parametrize(("degree", "frame"), [(0, Z_UP), (2, Z_UP), (3, Y_DOWN)], ids=["0", "2", "3, y down"])
@pytest.mark.parametrize("extension", SPLAT_EXPORTERS)
def test_what_was_written_is_read_again(extension: str, degree: int, frame: SourceFrame, tmp_path: Path) -> None:
    """In the capture's frame; the same Gaussians are the same bytes, and nothing else is left beside."""
    gaussians = scattered(40, degree)
    for name in ("a", "b"):
        SPLAT_EXPORTERS[extension](gaussians, tmp_path / f"{name}{extension}", frame)
    found = READERS[extension](tmp_path / f"a{extension}", frame)
    assert (len(found), found.degree) == (40, degree)
    if extension == ".sog":
        gaussians = in_order_of(found, gaussians)
    limits = LIMITS[extension]
    assert all(off <= limit for off, limit in zip(differs_by(found, gaussians), limits, strict=True)), (differs_by(found, gaussians), limits)
    angles = np.abs((found.rotations.astype(float) * gaussians.rotations).sum(axis=1))
    assert np.degrees(2 * np.arccos(np.minimum(angles, 1))).max() < ANGLES[extension]
    assert (tmp_path / f"a{extension}").read_bytes() == (tmp_path / f"b{extension}").read_bytes()
    assert len([*tmp_path.iterdir()]) == 2


def test_spz_codes_are_niantic_s(tmp_path: Path) -> None:
    """By hand: no turn, a quarter about each axis in both senses; colours and harmonics at the ends of their ranges."""
    h = 0.5**0.5
    turns = np.array([[1, 0, 0, 0], [-1, 0, 0, 0], [h, h, 0, 0], [h, -h, 0, 0], [0, 0, 1, 0], [0.5, 0.5, -0.5, 0.5]], np.float32)
    some = replace(scattered(6, degree=2), rotations=turns)
    some.harmonics[:, 0], some.harmonics[:, 1:4], some.harmonics[:, 4:] = 3.4, 5.0, -0.05
    some.scales[:], some.opacities[:] = np.exp(-10), 1 - 2**-24
    SPLAT_EXPORTERS[".spz"](some, tmp_path / "a.spz", Y_UP)
    data = (tmp_path / "a.spz").read_bytes()
    assert data[:10] == bytes.fromhex("1f8b08000000000002ff")
    raw = gzip.decompress(data)
    assert raw[:13] == b"NGSP" + bytes([3, 0, 0, 0, 6, 0, 0, 0, 2])
    codes = np.frombuffer(raw, "<u4", 6, 16 + 6 * (9 + 1 + 3 + 3))
    one, half = 511, 361  # 1 and 0.7071 of the square root of a half
    assert codes.tolist() == [3 << 30, 3 << 30, one, 512 | one, 1 << 30, (512 | half) << 20 | half << 10 | half]
    assert set(raw[16 + 6 * 9 : 16 + 6 * 10]) == {255}
    assert set(raw[16 + 6 * 10 : 16 + 6 * 13]) == {255}
    assert set(raw[16 + 6 * 13 : 16 + 6 * 16]) == {0}
    above = np.frombuffer(raw[-6 * 24 :], np.uint8).reshape(6, 8, 3)
    assert set(above[:, :3].ravel()) == {255}
    assert set(above[:, 3:].ravel()) == {124}, "-0.05 is -6 of 128, and that as near to -4 as to -8"


@pytest.mark.parametrize("degree", range(4))
def test_spz_4_holds_what_spz_3_does(degree: int, tmp_path: Path) -> None:
    some = scattered(300, degree)
    for version in (3, 4):
        SPLAT_EXPORTERS[".spz"](some, tmp_path / f"{version}.spz", Y_UP, version=version)
    new, old = (tmp_path / "4.spz").read_bytes(), gzip.decompress((tmp_path / "3.spz").read_bytes())
    joined = joined_streams(new)
    assert new[15] == (6 if degree else 5)
    assert (joined[:4], joined[4], joined[8:]) == (old[:4], 4, old[8:])
    described = [describe_splats(tmp_path / f"{version}.spz") for version in (3, 4)]
    assert [facts.pop("format") for facts in described if facts] == ["SPZ 3", "SPZ 4"]
    assert described[0] == described[1]


@pytest.mark.parametrize(("size", "at"), [(1e-3, 0.0), (500.0, 0.0), (1e-4, 7e6)])
def test_places_in_spz_are_as_fine_as_their_bits_allow(size: float, at: float, tmp_path: Path) -> None:
    """Finer than the thinnest Gaussians, unless they lie too far away for 24 bits."""
    some = scattered(30)
    some = replace(some, means=(size * some.means + at).astype(np.float32), scales=(size * some.scales).astype(np.float32))
    SPLAT_EXPORTERS[".spz"](some, tmp_path / "a.spz", Z_UP)
    header, found = read_spz(tmp_path / "a.spz")
    off = np.abs(from_y_up(found, Z_UP).means.astype(float) - some.means).max()
    reach = np.abs(some.means).max()
    assert off <= max(0.25 * np.quantile(some.scales.min(axis=1), 0.05), reach * 2.0**-22)
    assert 0 <= header.bits <= 22


def test_spz_refuses_what_lies_beyond_its_places(tmp_path: Path) -> None:
    far = scattered(3)
    far = replace(far, means=far.means + np.float32(2e7))
    with pytest.raises(BadInput, match=r"\.ply or \.glb"):
        SPLAT_EXPORTERS[".spz"](far, tmp_path / "a.spz", Z_UP)
    assert not list(tmp_path.iterdir())


def test_sog_codes_are_playcanvas_s(tmp_path: Path) -> None:
    """By hand: no turn, a quarter about x in both senses; the ends of positions, opacities of 0 and 1; images of four Gaussians a row."""
    h = 0.5**0.5
    turns = np.array([[1, 0, 0, 0], [h - 1e-3, h + 1e-3, 0, 0], [h + 1e-3, 1e-3 - h, 0, 0]], np.float32)
    places = np.array([[0, 0, 0], [np.e - 1, 0, 0], [1 - np.e, 0, 0]], np.float32)
    some = replace(scattered(3, degree=1), rotations=turns, means=places, opacities=np.array([1e-6, 0.5, 1 - 2**-24], np.float32))
    SPLAT_EXPORTERS[".sog"](some, tmp_path / "a.sog", Y_DOWN)
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        assert {(each.compress_type, each.date_time) for each in archive.infolist()} == {(zipfile.ZIP_STORED, (1980, 1, 1, 0, 0, 0))}
        meta = json.loads(archive.read("meta.json"))
        pixels = {name: np.asarray(Image.open(io.BytesIO(archive.read(name)))) for name in archive.namelist() if name != "meta.json"}
    assert (meta["version"], meta["count"], meta["shN"]["bands"], meta["shN"]["count"]) == (2, 3, 1, 3)
    assert meta["asset"] == {"generator": "efficientnerf", "unit": Y_DOWN.unit}
    np.testing.assert_allclose([meta["means"]["mins"], meta["means"]["maxs"]], [[-1, 0, 0], [1, 0, 0]], atol=1e-7)
    assert pixels.pop("shN_centroids.webp").shape == (1, 192, 3)
    assert {image.shape[:2] for image in pixels.values()} == {(4, 4)}
    order = [2, 0, 1]  # by x
    assert [pixels[f"means_{part}.webp"][0, :3, 0].tolist() for part in "lu"] == [[0, 0, 255], [0, 128, 255]]
    assert pixels["quats.webp"][0, :3].tolist() == [[[128, 128, 128, 252], [255, 128, 128, 253], [0, 128, 128, 252]][k] for k in order]
    assert pixels["sh0.webp"][0, :3, 3].tolist() == [[0, 128, 255][k] for k in order]
    for axis in range(3):
        exact = [some.harmonics[k, 0, axis] for k in order]
        np.testing.assert_allclose([meta["sh0"]["codebook"][code] for code in pixels["sh0.webp"][0, :3, axis]], exact, atol=1e-6)


def test_sog_shares_harmonics_in_a_palette_on_any_number_of_threads(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As many entries as are allowed, few Gaussians far from theirs; the same bytes."""
    monkeypatch.setattr(sog, "PALETTE", 200)
    monkeypatch.setattr(sog, "BRANCHES", 8)
    some, threads = scattered(1000, degree=1), numba.get_num_threads()
    kinds = np.random.default_rng(3).normal(0, 0.3, (150, 3, 3))
    some.harmonics[:, 1:] = np.repeat(kinds, 7, axis=0)[:1000] + np.random.default_rng(4).normal(0, 0.01, (1000, 3, 3))
    contents = []
    for number in (1, threads):
        numba.set_num_threads(number)
        SPLAT_EXPORTERS[".sog"](some, tmp_path / "a.sog", Z_UP)
        contents.append((tmp_path / "a.sog").read_bytes())
    assert contents[0] == contents[1]
    meta, found = read_sog(tmp_path / "a.sog")
    assert 150 < meta["shN"]["count"] <= 200
    found = from_y_down(found, Z_UP)
    off = np.linalg.norm(found.harmonics[:, 1:] - in_order_of(found, some).harmonics[:, 1:], axis=(1, 2))
    assert np.median(off) < 0.05
    assert np.quantile(off, 0.9) < 0.5


@pytest.mark.parametrize("values", [[0.25], [1.0, 1.0, 3.0], [*np.linspace(-2, 2, 200)], [*np.random.default_rng(0).normal(size=5000), 40.0]])
def test_a_codebook_of_sog_has_each_value_s_nearest_level(values: list[float]) -> None:
    """Few values are exact; an outlier does not coarsen the others."""
    levels, codes = sog.coded(np.array(values))
    assert len(levels) == 256
    assert levels == sorted(levels)
    off = np.abs(np.array(levels)[codes] - values)
    np.testing.assert_allclose(off, np.abs(np.array(levels) - np.array(values)[:, None]).min(axis=1), atol=1e-12)
    assert off.max() < (0.2 if len(values) > 256 else 1e-6)
    assert np.sqrt(np.mean(off**2)) < 0.01


def test_glb_has_the_extension_by_its_letter(tmp_path: Path) -> None:
    """Linear scales and opacities, y up; and for viewers without it points in linear light."""
    some = scattered(5, degree=1)
    SPLAT_EXPORTERS[".glb"](some, tmp_path / "a.glb", Z_UP)
    document, blob = glb_document(tmp_path / "a.glb")
    primitive = document["meshes"][0]["primitives"][0]
    assert document["extensionsUsed"] == ["KHR_gaussian_splatting"]
    assert primitive["mode"] == 0
    assert primitive["extensions"] == {
        "KHR_gaussian_splatting": {"kernel": "ellipse", "colorSpace": "srgb_rec709_display", "projection": "perspective", "sortingMethod": "cameraDistance"}
    }
    names = [f"KHR_gaussian_splatting:{name}" for name in ("ROTATION", "SCALE", "OPACITY", "SH_DEGREE_0_COEF_0", *(f"SH_DEGREE_1_COEF_{n}" for n in range(3)))]
    assert list(primitive["attributes"]) == ["POSITION", "COLOR_0", *names]
    x, y, z = some.means.T
    np.testing.assert_array_equal(accessor(document, blob, primitive["attributes"]["POSITION"]), np.stack([x, z, -y], axis=1))
    np.testing.assert_array_equal(accessor(document, blob, primitive["attributes"][names[1]]), some.scales)
    plain = linear_from_srgb(np.clip(0.5 + 0.28209479 * some.harmonics[:, 0].astype(float), 0, 1))
    colour = accessor(document, blob, primitive["attributes"]["COLOR_0"]) / 65535
    np.testing.assert_allclose(colour, np.concatenate([plain, some.opacities[:, None]], axis=1), atol=1e-5)
    assert document["nodes"][0]["extras"]["source_frame"]["gltf_from_capture"][1] == [0, 0, 1, 0]


@pytest.mark.parametrize("extension", SPLAT_EXPORTERS)
def test_no_gaussians_are_refused(extension: str, tmp_path: Path) -> None:
    path = tmp_path / f"a{extension}"
    path.write_bytes(b"older")
    with pytest.raises(BadInput):
        SPLAT_EXPORTERS[extension](scattered(3).subset(np.zeros(0, int)), path, Z_UP)
    assert path.read_bytes() == b"older"


def test_a_damaged_ply_is_named(tmp_path: Path) -> None:
    """Cut short at every byte, and with what no Gaussian has."""
    path, some = tmp_path / "a.ply", scattered(2, degree=0)
    SPLAT_EXPORTERS[".ply"](some, path, Z_UP)
    whole = path.read_bytes()
    body = whole.index(b"end_header\n") + 11
    nan, huge = np.float32(np.nan).tobytes(), np.float32(1000).tobytes()
    scale = body + 4 * property_names(1).index("scale_0")
    damaged = [whole[:end] for end in range(0, len(whole), 7)] + [
        whole + b"\0", whole.replace(b"vertex 2", b"vertex 3"), whole.replace(b"vertex 2", b"vertex -2"), whole.replace(b"vertex 2", b"vertex 99999999999"),
        whole.replace(b"little", b"big"), whole.replace(b"f_dc_0", b"f_dc_9"), whole[:body] + nan + whole[body + 4 :],
        whole[:scale] + huge + whole[scale + 4 :], whole[:-16] + bytes(16), b"x" * 20000,
    ]  # fmt: skip
    for content in damaged:
        path.write_bytes(content)
        with pytest.raises(CorruptArtifact, match=r"a\.ply: "):
            read_splats(path)
    path.unlink()
    with pytest.raises(CorruptArtifact):
        read_splats(path)


def read_any_ply(path: Path) -> Gaussians:
    """A PLY of 3DGS with its properties in any order."""
    head, body = path.read_bytes().split(b"end_header\n", 1)
    names = [line.split()[-1] for line in head.decode().splitlines() if line.startswith("property float ")]
    rows = np.frombuffer(body, "<f4").reshape(-1, len(names))

    def columns(name: str, count: int) -> np.ndarray:
        return np.stack([rows[:, names.index(f"{name}{k}")] for k in range(count)], axis=1)

    rest = sum(name.startswith("f_rest_") for name in names)
    harmonics = np.concatenate([columns("f_dc_", 3)[:, None], columns("f_rest_", rest).reshape(len(rows), 3, -1).transpose(0, 2, 1)], axis=1)
    quaternions = columns("rot_", 4)
    opacities = np.clip(1 / (1 + np.exp(-rows[:, names.index("opacity")])), 1e-6, 1 - 1e-6)
    return Gaussians(
        np.ascontiguousarray(rows[:, [names.index(axis) for axis in "xyz"]]), np.exp(columns("scale_", 3)),
        quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True), opacities, np.ascontiguousarray(harmonics),
    )  # fmt: skip


@pytest.mark.skipif(SPLAT_TRANSFORM is None, reason="needs PlayCanvas' reader: npm install -g @playcanvas/splat-transform, or SPLAT_TRANSFORM=its path")
@pytest.mark.parametrize(
    ("extension", "to", "options"),
    [(".ply", ".ply", {}), (".spz", ".ply", {"version": 3}), (".spz", ".ply", {"version": 4}), (".sog", ".ply", {}), (".ply", ".glb", {})],
)
def test_splat_transform_reads_what_was_written(extension: str, to: str, options: dict[str, int], tmp_path: Path) -> None:
    """Without a warning, and its own PLY and GLB hold the same. In a GLB it turns a PLY by half a turn about z, harmonics too."""
    some = scattered(200, degree=3)
    SPLAT_EXPORTERS[extension](some, tmp_path / f"a{extension}", Z_UP, **options)
    done = subprocess.run([str(SPLAT_TRANSFORM), f"a{extension}", f"b{to}"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "warn" not in (done.stdout + done.stderr).lower()
    if to == ".glb":
        document, found = read_glb_splats(tmp_path / "b.glb")
        expected = moved(some, Similarity(1.0, np.diag([-1.0, -1, 1]), np.zeros(3)))
        SPLAT_EXPORTERS[to](some, tmp_path / "c.glb", Z_UP)
        ours = glb_document(tmp_path / "c.glb")[0]["meshes"][0]["primitives"][0]
        theirs = document["meshes"][0]["primitives"][0]
        assert (theirs["extensions"], theirs["mode"], [*theirs["attributes"]]) == (ours["extensions"], ours["mode"], [*ours["attributes"]])
    else:
        found = read_any_ply(tmp_path / "b.ply")
        expected = some if extension == ".ply" else {".spz": read_spz, ".sog": read_sog}[extension](tmp_path / f"a{extension}")[1]
    assert max(differs_by(found, expected)) < 2e-3
    np.testing.assert_allclose(np.abs((found.rotations.astype(float) * expected.rotations).sum(axis=1)), 1, atol=1e-5)
