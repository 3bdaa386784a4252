"""Pictures of newer formats: HEIF, AVIF, and what a camera's sensor took."""

import struct
from pathlib import Path

import numpy as np
import pillow_heif
import pytest
from PIL import Image

from stages.io import photo, pictures, working_images
from stages.io.pictures import UnreadableImage

WIDTH, HEIGHT = 96, 64
BYTE, ASCII, SHORT, LONG, RATIONAL, SRATIONAL = 1, 2, 3, 4, 5, 10
_FORMS = {BYTE: "B", ASCII: "B", SHORT: "H", LONG: "I"}


def _packed(kind: int, values: object) -> tuple[int, bytes]:
    if kind in (RATIONAL, SRATIONAL):
        form = "II" if kind == RATIONAL else "ii"
        data = b"".join(struct.pack("<" + form, round(value * 10_000), 10_000) for value in values)  # type: ignore[attr-defined]
        return len(data) // 8, data
    found = list(values)  # type: ignore[call-overload]
    return len(found), struct.pack(f"<{len(found)}{_FORMS[kind]}", *found)


def directory(entries: dict[int, tuple[int, object]], at: int) -> bytes:
    """A TIFF directory that lies at this offset, with its values behind it."""
    rows, values = [], b""
    behind = at + 2 + 12 * len(entries) + 4
    for tag, (kind, content) in sorted(entries.items()):
        count, data = _packed(kind, content)
        if len(data) <= 4:
            rows.append(struct.pack("<HHI", tag, kind, count) + data.ljust(4, b"\0"))
        else:
            rows.append(struct.pack("<HHII", tag, kind, count, behind + len(values)))
            values += data + b"\0" * (len(data) % 2)
    return struct.pack("<H", len(entries)) + b"".join(rows) + bytes(4) + values


def dng(path: Path, rgb: np.ndarray, orientation: int = 1) -> Path:
    """A DNG of a Bayer sensor (RGGB, 12 bits) that took `rgb` (H, W, 3), linear 0 to 1; 28 mm, 42 mm by the full frame."""
    height, width = rgb.shape[:2]
    mosaic = np.empty((height, width))
    for channel, rows, columns in ((0, 0, 0), (1, 0, 1), (1, 1, 0), (2, 1, 1)):
        mosaic[rows::2, columns::2] = rgb[rows::2, columns::2, channel]
    pixels = np.round(mosaic * 4095).astype("<u2").tobytes()
    exif_at = 8 + len(pixels)
    exif = directory({37386: (RATIONAL, [28.0]), 41989: (SHORT, [42])}, exif_at)
    xyz_to_srgb = np.linalg.inv([[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]])
    main = {
        254: (LONG, [0]), 256: (LONG, [width]), 257: (LONG, [height]), 258: (SHORT, [16]), 259: (SHORT, [1]), 262: (SHORT, [32803]),
        271: (ASCII, b"Maker\0"), 272: (ASCII, b"Camera\0"), 273: (LONG, [8]), 274: (SHORT, [orientation]), 277: (SHORT, [1]), 278: (LONG, [height]),
        279: (LONG, [len(pixels)]), 34665: (LONG, [exif_at]), 33421: (SHORT, [2, 2]), 33422: (BYTE, [0, 1, 1, 2]), 50706: (BYTE, [1, 4, 0, 0]),
        50708: (ASCII, b"Maker Camera\0"), 50717: (LONG, [4095]), 50721: (SRATIONAL, xyz_to_srgb.ravel()), 50728: (RATIONAL, [1.0, 1.0, 1.0]),
        50778: (SHORT, [21]),
    }  # fmt: skip
    at = exif_at + len(exif)
    path.write_bytes(b"II*\0" + struct.pack("<I", at) + pixels + exif + directory(main, at))
    return path


def quarters() -> np.ndarray:
    """(H, W, 3) linear: dark red, green, blue and grey quarters."""
    seen = np.empty((HEIGHT, WIDTH, 3))
    seen[:32, :48], seen[:32, 48:], seen[32:, :48], seen[32:, 48:] = (0.5, 0.05, 0.05), (0.05, 0.5, 0.05), (0.05, 0.05, 0.5), (0.2, 0.2, 0.2)
    return seen


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_raw_pictures_are_developed_upright_with_their_focal_length(orientation: int, tmp_path: Path) -> None:
    pytest.importorskip("rawpy")
    seen = quarters()
    stored = photo.apply_exif_orientation(seen, {1: 1, 3: 3, 6: 8, 8: 6}[orientation])
    path = dng(tmp_path / "a.dng", np.ascontiguousarray(stored), orientation)
    found = photo.read_photo(path, 1000)
    assert (found.width, found.height, found.maker) == (WIDTH, HEIGHT, "Maker Camera")
    assert found.focal == pytest.approx(42 / np.hypot(36, 24) * np.hypot(WIDTH, HEIGHT))
    assert pictures.read_header(path).size == (WIDTH, HEIGHT)
    decoded = working_images.decode(path)
    assert not decoded.verbatim
    np.testing.assert_array_equal(decoded.pixels, found.rgb)
    for (y, x), expected in {(16, 24): "r", (16, 72): "g", (48, 24): "b"}.items():
        assert "rgb"[int(found.rgb[y, x].argmax())] == expected
    grey = found.rgb[48, 72].astype(int)
    assert np.ptp(grey) <= 4
    assert grey.mean() == pytest.approx(255 * (1.055 * 0.2 ** (1 / 2.4) - 0.055), abs=8)  # sRGB, and no brightening by the picture's content


@pytest.mark.parametrize("cut", [0, 10, 1000, 12_000, 12_400])
def test_a_raw_picture_that_is_cut_short_is_unreadable(cut: int, tmp_path: Path) -> None:
    pytest.importorskip("rawpy")
    path = tmp_path / "a.dng"
    path.write_bytes(dng(path, quarters()).read_bytes()[:cut])
    with pytest.raises(UnreadableImage, match="unreadable"):
        photo.read_photo(path, 1000)


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
@pytest.mark.parametrize("kind", ["AVIF", "HEIF"])
def test_photographs_of_phones_are_turned_once(kind: str, orientation: int, tmp_path: Path) -> None:
    pillow_heif.register_heif_opener()
    seen, path = (255 * quarters() ** (1 / 2.2)).astype(np.uint8), tmp_path / "a"
    stored = photo.apply_exif_orientation(seen, {1: 1, 3: 3, 6: 8, 8: 6}[orientation])
    exif = Image.Exif()
    exif[274], exif[271], exif[272] = orientation, "Maker", "Phone"
    exif.get_ifd(34665)[41989] = 26
    Image.fromarray(np.ascontiguousarray(stored)).save(path, kind, exif=exif.tobytes(), quality=95)
    found = photo.read_photo(path, 1000)
    assert (found.width, found.height, found.maker) == (WIDTH, HEIGHT, "Maker Phone")
    assert found.focal == pytest.approx(26 / np.hypot(36, 24) * np.hypot(WIDTH, HEIGHT))
    assert np.abs(found.rgb[8:24, 8:40].astype(int) - seen[8, 8]).max() < 30
    assert np.abs(found.rgb[40:56, 8:40].astype(int) - seen[40, 8]).max() < 30
    assert pictures.read_header(path).size == (WIDTH, HEIGHT)
    decoded = working_images.decode(path)
    assert not decoded.verbatim  # later stages read PNG and JPEG
    np.testing.assert_array_equal(decoded.pixels, found.rgb)
