"""Pictures from anybody: every type of pixel has one meaning or is refused by name, and no file ends more than itself."""

import ast
import errno
import io
import os
import random
import re
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile
from PIL import EpsImagePlugin, Image

from stages.io import photo, pictures, working_images
from stages.io.capture import Photo
from stages.io.decoders.jpeg_scans import holds_more_scans, most_scans
from stages.io.pictures import UnreadableImage, read_header, read_quality
from tests.stages import captures

ROOT = Path(__file__).resolve().parents[3]
RAMP = (np.arange(12, dtype=np.uint16).reshape(3, 4) * 5461).astype(np.uint16)  # 0 to 60071
DIM = np.arange(12, dtype=np.uint16).reshape(3, 4) * 23  # below 256


def read(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    with pictures.opened(path) as image:
        return pictures.rgb_and_alpha(image)


def grey(values: np.ndarray) -> np.ndarray:
    return np.repeat(np.asarray(values, np.uint8)[..., None], 3, -1)


# --- which files are opened, and where


def test_pictures_are_opened_in_one_place() -> None:
    """Only there are the formats limited; tests may open what they wrote."""
    opening = {"open": "Image", "imread": "cv2", "imdecode": "cv2", "imreadmulti": "cv2"}
    wrong = []
    for package in ("pipeline", "efficientnerf", "stages", "workflows", "benchmarks", "docs", "examples"):
        for path in sorted((ROOT / package).rglob("*.py")):
            text = path.read_text(encoding="utf-8")
            if not any(word in text for word in ("Image.open", *opening.keys() - {"open"}, "imageio")):
                continue
            for node in ast.walk(ast.parse(text)):
                name = node.func if isinstance(node, ast.Call) else None
                if isinstance(name, ast.Attribute) and opening.get(name.attr) == ast.unparse(name.value).split(".")[-1]:
                    wrong.append(str(path.relative_to(ROOT)))
                if isinstance(node, ast.Import | ast.ImportFrom) and "imageio" in ast.unparse(node):
                    wrong.append(str(path.relative_to(ROOT)))
    assert wrong == ["stages/io/pictures.py"]


OTHERS = {
    "EPS": b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 32 24\n%%EndComments\n(x) run\n%%EOF\n",
    "GIF": b"GIF89a\1\0\1\0\0\0\0,\0\0\0\0\1\0\1\0\0\2\2L\1\0;",
    "PSD": b"8BPS" + b"\0" * 100,
}


@pytest.mark.parametrize("kind", OTHERS)
def test_other_formats_named_as_photographs_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
    """And Ghostscript is not started for one of them."""
    monkeypatch.setattr(EpsImagePlugin, "Ghostscript", lambda *_, **__: pytest.fail("Ghostscript was started"))
    path = tmp_path / "a.png"
    path.write_bytes(OTHERS[kind])
    for attempt in (pictures.read_header, working_images.decode, lambda path: photo.read_photo(path, 100)):
        with pytest.raises(UnreadableImage):
            attempt(path)


def test_a_pipe_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.png")
    for path in (tmp_path / "a.png", tmp_path):
        with pytest.raises(UnreadableImage):
            pictures.read_header(path)


# --- pixels


def tiff(path: Path, values: np.ndarray, **options: Any) -> None:
    tifffile.imwrite(path, values, photometric=options.pop("photometric", "rgb" if values.ndim == 3 else "minisblack"), **options)


def saved(image: Image.Image, kind: str = "PNG") -> Callable[[Path], None]:
    return lambda path: image.save(path, kind)


PALETTE = Image.fromarray(np.array([[0, 1], [2, 0]], np.uint8)).convert("P")
PALETTE.putpalette([10, 20, 30, 40, 50, 60, 70, 80, 90])
RGB16 = np.stack([RAMP, RAMP[::-1], RAMP[:, ::-1]], -1)
CASES: dict[str, tuple[Callable[[Path], Any], np.ndarray]] = {
    "16-bit grey PNG": (saved(Image.fromarray(RAMP)), grey(np.rint(RAMP / 257))),
    "16-bit grey PNG, all dark": (saved(Image.fromarray(DIM)), grey(np.rint(DIM / 257))),
    "16-bit grey TIFF": (lambda path: tiff(path, RAMP), grey(np.rint(RAMP / 257))),
    "16-bit grey TIFF, big-endian": (lambda path: tiff(path, RAMP, byteorder=">"), grey(np.rint(RAMP / 257))),
    "16-bit grey TIFF, all dark": (lambda path: tiff(path, DIM), grey(np.rint(DIM / 257))),
    "16-bit colour TIFF": (lambda path: tiff(path, RGB16), RGB16 >> 8),
    "16-bit colour PNG": (lambda path: path.write_bytes(cv2.imencode(".png", RGB16[..., ::-1])[1].tobytes()), RGB16 >> 8),
    "1 bit": (saved(Image.fromarray(np.array([[True, False], [False, True]]))), grey(np.array([[255, 0], [0, 255]]))),
    "grey": (saved(Image.fromarray(DIM.astype(np.uint8))), grey(DIM)),
    "palette": (saved(PALETTE), np.array([[[10, 20, 30], [40, 50, 60]], [[70, 80, 90], [10, 20, 30]]])),
    "CMYK TIFF": (saved(Image.new("CMYK", (2, 2), (255, 0, 51, 0)), "TIFF"), np.broadcast_to((0, 255, 204), (2, 2, 3))),
    "white is zero, 8 bits": (lambda path: tiff(path, DIM.astype(np.uint8), photometric="miniswhite"), grey(255 - DIM)),
}


@pytest.mark.parametrize("what", CASES)
def test_types_of_pixels(tmp_path: Path, what: str) -> None:
    write, expected = CASES[what]
    write(tmp_path / "a")
    rgb, alpha = read(tmp_path / "a")
    assert alpha is None
    np.testing.assert_array_equal(rgb, expected)
    np.testing.assert_array_equal(working_images.decode(tmp_path / "a").pixels, expected)
    np.testing.assert_array_equal(photo.read_photo(tmp_path / "a", 100).rgb, expected)


REFUSED: dict[str, tuple[np.ndarray, dict[str, Any]]] = {
    "float in 0 to 1": (np.linspace(0, 1, 12, dtype=np.float32).reshape(3, 4), {}),
    "uint32": (RAMP.astype(np.uint32), {}),
    "int16": (DIM.astype(np.int16), {}),
    "int8": (DIM.astype(np.int8), {}),
    "16 bits, white is zero": (RAMP, {"photometric": "miniswhite"}),
    "float colour": (RGB16.astype(np.float32), {}),
}


@pytest.mark.parametrize("what", REFUSED)
def test_pixels_without_a_known_white_are_refused_by_name(tmp_path: Path, what: str) -> None:
    values, options = REFUSED[what]
    tiff(tmp_path / "a.tif", values, **options)
    for attempt in (read, working_images.decode, lambda path: photo.read_photo(path, 100)):
        with pytest.raises(UnreadableImage, match=None if "colour" in what else "TIFF.*convert it to 8 or 16 bits"):
            attempt(tmp_path / "a.tif")


# --- damage


def jpeg(exif: bytes = b"") -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(captures.picture()).save(buffer, "JPEG", exif=exif)
    return buffer.getvalue()


def assert_reason_or_none(attempt: Callable[[Path], Any], path: Path) -> None:
    """That a file is read, or refused with one line."""
    reason = "unreadable: "
    try:
        attempt(path)
    except UnreadableImage as error:
        reason = str(error)
    assert re.fullmatch("unreadable: .*", reason)


def png_of_size(width: int, height: int) -> bytes:
    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0))
        + chunk(b"IDAT", zlib.compress(b"\0"))
        + chunk(b"IEND", b"")
    )


@pytest.mark.parametrize("exif", [b"Exif\0\0II*\0", b"Exif\0\0", b"Exif\0\0MM", b"II*\0\xff\xff\xff\xff", b"\0"])
def test_exif_that_is_cut_off_leaves_out_that_picture_at_most(tmp_path: Path, exif: bytes) -> None:
    path = tmp_path / "a.jpg"
    path.write_bytes(jpeg(exif))
    for attempt in (pictures.read_header, working_images.decode, lambda path: photo.read_photo(path, 100)):
        assert_reason_or_none(attempt, path)


@pytest.mark.parametrize("size", [(60_000, 60_000), (13_378, 13_378), (65_536, 1), (2**31 - 1, 2**31 - 1)])
def test_sizes_are_bounded_before_anything_is_decoded(tmp_path: Path, size: tuple[int, int]) -> None:
    (tmp_path / "bomb.png").write_bytes(png_of_size(*size))
    captures.write_picture(tmp_path / "a.png", captures.picture())
    fine = photo.read_photo(tmp_path / "a.png", 100)
    for attempt in (
        pictures.read_header,
        working_images.decode,
        lambda path: photo.read_photo(path, 9),
        lambda path: photo.read_mask_file(path, fine),
    ):
        with pytest.raises(UnreadableImage):
            attempt(tmp_path / "bomb.png")
    masked = Photo(captures.cameras(1)[0], tmp_path / "a.png", tmp_path / "bomb.png")
    with pytest.raises(UnreadableImage, match=r"bomb\.png"):
        working_images.write(masked, tmp_path / "out", "a.png", max_side=64)


@pytest.mark.parametrize("kind", ["PNG", "JPEG", "TIFF", "WEBP", "BMP", "HEIF", "AVIF"])
def test_mutated_pictures_are_read_or_unreadable(tmp_path: Path, kind: str) -> None:
    import pillow_heif

    pillow_heif.register_heif_opener()
    buffer, rng = io.BytesIO(), random.Random(kind)
    exif = Image.Exif()
    exif[274], exif[271] = 6, "Maker"
    Image.fromarray(captures.picture()).save(buffer, kind, **({} if kind == "BMP" else {"exif": exif}))
    whole = buffer.getvalue()
    path = tmp_path / "a.png"
    for _ in range(50):
        data = bytearray(whole[: rng.randrange(len(whole))] if rng.random() < 0.2 else whole)
        for _ in range(rng.choice((1, 2, 8))):
            at = rng.randrange(min(len(data), 400) if rng.random() < 0.7 else len(data)) if data else 0
            data[at : at + 1] = bytes([rng.choice((0, 1, 127, 128, 255, rng.randrange(256)))])
        path.write_bytes(data)
        for attempt in (pictures.read_header, working_images.decode, lambda path: photo.read_photo(path, 20)):
            assert_reason_or_none(attempt, path)


EMPTY_SCAN = b"\xff\xda\x00\x08\x01\x01\x00\x01\x3f\x00"  # of refinements of the first component: nothing follows, and all of its coefficients are gone through


def with_scans(count: int, **options: Any) -> bytes:
    found = io.BytesIO()
    Image.fromarray(np.random.default_rng(0).integers(0, 256, (48, 64, 3), np.uint8)).save(found, "JPEG", exif=Image.Exif(), **options)
    return found.getvalue()[:-2] + count * EMPTY_SCAN + b"\xff\xd9"


@pytest.mark.parametrize("between", [b"", b"\xff\xfe\x00\x06\xff\xd9\xff\xd8", b"\xff\xff\xd0", b"\x00\x00"])
def test_scans_of_a_progressive_jpeg_are_counted_before_it_is_decoded(between: bytes, tmp_path: Path) -> None:
    """Whatever stands between them; the markers of an embedded thumbnail are none of the picture's."""
    path = tmp_path / "a.jpg"
    data = with_scans(0, progressive=True)
    for count in (1, 85):
        path.write_bytes(data[:-2] + count * (between + EMPTY_SCAN) + b"\xff\xd9")
        assert read(path)[0].shape == (48, 64, 3)
    path.write_bytes(data[:-2] + 200 * (between + EMPTY_SCAN) + b"\xff\xd9")
    for attempt in (read, read_header, read_quality):
        with pytest.raises(UnreadableImage):
            attempt(path)
    thumbnail = 300 * EMPTY_SCAN
    path.write_bytes(data[:2] + b"\xff\xe5" + (len(thumbnail) + 2).to_bytes(2, "big") + thumbnail + data[2:])
    assert read(path)[0].shape == (48, 64, 3)


def test_scans_of_large_pictures_are_fewer_and_those_of_one_component_each_count(tmp_path: Path) -> None:
    assert most_scans(12_000, 12_000) == 22 < most_scans(8000, 4000) == most_scans(1, 1) == 100
    data = bytearray(with_scans(0))
    at = data.index(b"\xff\xda")
    scan = b"\xff\xda\x00\x08\x01\x01\x00\x00\x3f\x00"
    path = tmp_path / "a.jpg"
    path.write_bytes(bytes(data[:at]) + 200 * scan + b"\xff\xd9")
    with pytest.raises(UnreadableImage):
        read_header(path)


def test_scans_of_any_jpeg_in_a_raw_picture_are_counted() -> None:
    tile, endless = with_scans(0, progressive=True), with_scans(200, progressive=True)
    assert not holds_more_scans(b"II*\0" + 300 * tile, 100)
    assert not holds_more_scans(np.random.default_rng(0).bytes(10**6), 100)
    assert holds_more_scans(b"II*\0" + 3 * tile + endless, 100)
    assert holds_more_scans(b"II*\0\xff\xd8\xff\xe0" + (len(tile) + 9).to_bytes(2, "big") + endless, 100), "one that a segment of another seems to hold"
    assert holds_more_scans(10**5 * b"\xff\xd8\xff\x00", 100), "nor does looking take the square of the size"


class Failing(Exception):
    pass


@pytest.mark.parametrize("raised", [struct.error("x"), KeyError(7), RecursionError(), Failing()])
def test_whatever_a_decoder_raises_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, raised: Exception) -> None:
    captures.write_picture(tmp_path / "a.png", captures.picture()[..., 0])

    def fail(*arguments: Any, **more: Any) -> None:
        raise raised

    monkeypatch.setattr(Image.Image, "convert", fail)
    with pytest.raises(UnreadableImage):
        read(tmp_path / "a.png")


def test_the_true_reason_is_said_and_want_of_memory_stays_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UnreadableImage):
        pictures.read_header(tmp_path / "none.png")
    captures.write_picture(tmp_path / "a.png", captures.picture())
    for raised, expected, text in [
        (OSError(errno.EIO, os.strerror(errno.EIO)), OSError, "Input/output error"),
        (PermissionError(errno.EACCES, os.strerror(errno.EACCES)), OSError, "Permission denied"),
        (OSError(errno.EMFILE, os.strerror(errno.EMFILE)), OSError, "Too many open files"),
        (MemoryError("none left"), MemoryError, "none left"),
    ]:

        def fail(*arguments: Any, raised: BaseException = raised, **more: Any) -> None:
            raise raised

        monkeypatch.setattr(Image, "open", fail)
        with pytest.raises(expected, match=text):
            pictures.read_header(tmp_path / "a.png")
