"""Pictures in the formats that cameras and programs write, and mutations that know their structure: EXIF blocks, chunks, TIFF directories."""

import io
import struct
import zlib
from collections.abc import Iterator
from random import Random
from typing import Any

import numpy as np

from benchmarks.fuzz.binary import LARGEST, changed_bytes, number

SIZE = (32, 24)  # as tests/stages/captures.py
EXIF_HEAD = b"Exif\0\0"
_TAGS = (256, 257, 258, 259, 262, 273, 274, 277, 278, 279, 282, 284, 317, 320, 322, 323, 338, 339, 34665, 34853, 0, 65535)  # of TIFF
_CHUNKS = (b"eXIf", b"tRNS", b"PLTE", b"iCCP", b"gAMA", b"acTL", b"fcTL", b"fdAT", b"IDAT")  # of PNG
_LENGTHS = [0, 1, 4, 2**16, 2**31 - 1, 2**31, 2**32 - 1]


def exif_block(order: str = "<", orientation: int = 6) -> bytes:
    """A TIFF header with orientation, maker, and a directory of focal lengths."""
    from PIL import Image

    exif = Image.Exif()
    exif.endian = order
    exif[274], exif[271], exif[272] = orientation, "Maker", "Model"
    exif[34665] = {37386: (50, 1), 41989: 35, 41486: (3000, 1), 41488: 3, 40962: SIZE[0]}
    return exif.tobytes()


def seeds() -> list[bytes]:
    """Small valid pictures of each kind."""
    import pillow_heif
    from PIL import Image

    pillow_heif.register_heif_opener()
    rng = np.random.default_rng(3)
    w, h = SIZE
    rgb = Image.fromarray(rng.integers(0, 256, (h, w, 3), np.uint8))
    rgba = Image.fromarray(rng.integers(0, 256, (h, w, 4), np.uint8))
    grey = Image.fromarray(rng.integers(0, 256, (h, w), np.uint8))
    deep = Image.fromarray(rng.integers(0, 65536, (h, w), np.uint16))
    real = Image.fromarray(rng.random((h, w), np.float32))
    whole = Image.fromarray(rng.integers(0, 2**31 - 1, (h, w), np.int32))
    exif, other = exif_block(), exif_block(">", 3)

    def saved(image: Any, kind: str, **options: Any) -> bytes:
        out = io.BytesIO()
        image.save(out, kind, **options)
        return out.getvalue()

    return [
        saved(rgb, "JPEG", exif=exif), saved(grey, "JPEG", exif=other), saved(rgb, "JPEG", progressive=True),
        saved(rgb.convert("CMYK"), "JPEG"), saved(rgb, "PNG", exif=exif), saved(rgba, "PNG"), saved(deep, "PNG"),
        saved(rgb.quantize(16), "PNG", transparency=3), saved(grey.convert("1"), "PNG"), saved(rgb, "PNG", exif=other),
        saved(rgba.convert("LA"), "PNG"), saved(rgb, "TIFF", exif=exif), saved(real, "TIFF"), saved(deep, "TIFF"),
        saved(whole, "TIFF"), saved(rgb, "TIFF", compression="tiff_lzw"), saved(rgba, "TIFF", compression="tiff_adobe_deflate"),
        saved(rgb, "TIFF", compression="jpeg"), saved(grey.convert("1"), "TIFF", compression="group4"),
        saved(rgb, "WEBP", exif=exif), saved(rgba, "WEBP", lossless=True), saved(rgb, "BMP"),
        # other formats, under the name of a PNG
        saved(rgb.quantize(8), "GIF"), saved(rgb, "PPM"), saved(rgb, "TGA"), saved(rgba, "ICO"),
        saved(rgb, "PDF"), saved(rgb, "EPS"), saved(rgb, "JPEG2000"), saved(rgba, "DDS"),
        saved(rgb, "SGI"), saved(rgb, "PCX"),
        saved(grey, "GIF", save_all=True, append_images=[grey]), saved(rgb, "TIFF"),
        saved(rgb, "PNG"),
        saved(rgb, "HEIF", exif=exif), saved(rgba, "HEIF"), saved(rgb, "HEIF"),
    ]  # fmt: skip


def changed(rng: Random, data: bytes) -> bytes:
    """The picture with its EXIF block, a chunk or a directory changed, or with changed bytes."""
    kind = rng.random()
    if kind < 0.3:
        return changed_bytes(rng, data)
    if kind < 0.4:
        return changed_bytes(rng, data, begin=0, end=min(len(data), 64))
    if data[:8] == b"\x89PNG\r\n\x1a\n":
        return png_changed(rng, data)
    if data[:2] == b"\xff\xd8":
        return jpeg_changed(rng, data)
    if data[:4] in (b"II*\0", b"MM\0*"):
        return tiff_changed(rng, data)
    if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
        return webp_changed(rng, data)
    return changed_bytes(rng, data, begin=0, end=min(len(data), 256))


def tiff_changed(rng: Random, data: bytes) -> bytes:
    """A TIFF header and directories, alone (an EXIF block) or with pixels: entries' tags, types, counts and values, offsets, the number of entries."""
    if rng.random() < 0.08:
        return data[:4]  # the header and nothing else
    if len(data) < 14:
        return changed_bytes(rng, data)
    out = bytearray(data)
    order = "<" if data[:2] == b"II" else ">"
    for _ in range(1 + rng.randrange(3)):
        (at,) = struct.unpack_from(order + "I", out, 4)
        if rng.random() < 0.1 or at + 2 > len(out):
            struct.pack_into(order + "I", out, 4, rng.choice([*_LENGTHS, 8, len(out) - 1, len(out)]))
            continue
        (entries,) = struct.unpack_from(order + "H", out, at)
        if rng.random() < 0.08 or not entries:
            struct.pack_into(order + "H", out, at, rng.choice((0, 1, min(entries + 1, 65535), 255, 65535)))
            continue
        entry = at + 2 + 12 * rng.randrange(min(entries, 64))
        if entry + 12 > len(out):
            continue
        place = rng.randrange(4)
        if place == 0:
            struct.pack_into(order + "H", out, entry, rng.choice(_TAGS))
        elif place == 1:
            struct.pack_into(order + "H", out, entry + 2, rng.choice((0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 16, 65535)))
        elif place == 2:
            struct.pack_into(order + "I", out, entry + 4, rng.choice([*_LENGTHS, 2, 3, 8]))
        else:
            struct.pack_into(order + "I", out, entry + 8, rng.choice([*_LENGTHS, 3, 5, 6, 8, 16, 32, 64, entry, at, len(out) - 1, rng.randrange(len(out))]))
    return bytes(out)


def _exif_changed(rng: Random, block: bytes) -> bytes:
    """The block with or without its six bytes in front."""
    head, body = (EXIF_HEAD, block[6:]) if block[:6] == EXIF_HEAD else (b"", block)
    kind = rng.randrange(6)
    if kind == 0:
        return head + rng.choice((b"II*\0", b"MM\0*", b"II*\0\x08\0\0\0", b"", b"II", b"II+\0", b"II*\0\xff\xff\xff\xff", b"MM\0*\0\0\0\x08\xff\xff"))
    if kind == 1:
        return changed_bytes(rng, head + body)
    return head + tiff_changed(rng, body)


def png_chunks(data: bytes) -> list[tuple[bytes, bytes]]:
    found, at = [], 8
    while at + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, at)
        found.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + length]))
        at += 12 + length
    return found


def png_of(chunks: list[tuple[bytes, bytes]], rng: Random | None = None) -> bytes:
    """Chunks with their lengths and checksums; with `rng`, a wrong one at times."""
    out = b"\x89PNG\r\n\x1a\n"
    for kind, body in chunks:
        length = rng.choice(_LENGTHS) if rng is not None and rng.random() < 0.01 else len(body)
        out += struct.pack(">I", length) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
    return out[:LARGEST]


def png_changed(rng: Random, data: bytes) -> bytes:
    """A chunk changed, removed, repeated or added; checksums are right, so that what is behind them is reached."""
    chunks = png_chunks(data)
    if not chunks:
        return changed_bytes(rng, data)
    for _ in range(1 + rng.randrange(2)):
        at = rng.randrange(len(chunks))
        kind, body = chunks[at]
        what = rng.randrange(8)
        if kind == b"eXIf" and what < 5:
            chunks[at] = kind, _exif_changed(rng, body)
        elif what < 3:
            chunks[at] = kind, changed_bytes(rng, body)
        elif what == 3 and len(chunks) > 1:
            del chunks[at]
        elif what == 4:
            chunks.insert(at, chunks[rng.randrange(len(chunks))])
        elif what == 5:
            chunks.insert(rng.randrange(len(chunks) + 1), (rng.choice(_CHUNKS), _exif_changed(rng, exif_block())))
        elif what == 6:
            profile, large = b"Raw profile type exif\0\0" + zlib.compress(b"\nexif\n      20\n4949"), b"x\0\0" + zlib.compress(b"0" * 2_000_000)
            text = rng.choice((profile, b"a\0b", b"\0" * 5, large, b"k\0\1\0en\0\0" + zlib.compress(b"v")))
            chunks.insert(max(1, len(chunks) - 1), (rng.choice((b"tEXt", b"zTXt", b"iTXt")), text))
        else:
            head = bytearray(chunks[0][1])
            put = rng.choice([struct.pack(">I", value) for value in (0, 1, 65535, 65536, 200000, 2**31 - 1)])
            head[rng.choice((0, 4)) :][:4] = put
            place = rng.choice((0, 4, 8, 9, 10, 11, 12))
            head[place : place + (4 if place < 8 else 1)] = put if place < 8 else bytes([rng.choice((0, 1, 2, 3, 4, 6, 8, 16, 32, 255))])
            chunks[0] = chunks[0][0], bytes(head)
    return png_of(chunks, rng)


def jpeg_segments(data: bytes) -> Iterator[tuple[int, int]]:
    """(begin, end) of each segment before the pixels."""
    at = 2
    while at + 4 <= len(data) and data[at] == 0xFF and data[at + 1] != 0xDA:
        end = at + 2 + struct.unpack_from(">H", data, at + 2)[0]
        yield at, min(end, len(data))
        at = end


def jpeg_changed(rng: Random, data: bytes) -> bytes:
    segments = list(jpeg_segments(data))
    if not segments:
        return changed_bytes(rng, data)
    exif = [span for span in segments if data[span[0] + 4 : span[0] + 10] == EXIF_HEAD]
    begin, end = rng.choice(exif) if exif and rng.random() < 0.6 else rng.choice(segments)
    body = data[begin + 4 : end]
    kind = rng.randrange(5)
    if body[:6] == EXIF_HEAD and kind < 4:
        body = _exif_changed(rng, body)
    elif kind == 4:
        return data[: begin + 2] + struct.pack(">H", rng.choice((0, 1, 2, 3, 100, 65535))) + data[begin + 4 :]
    else:
        body = changed_bytes(rng, body)
    return (data[: begin + 2] + struct.pack(">H", min(len(body) + 2, 65535)) + body + data[end:])[:LARGEST]


def webp_changed(rng: Random, data: bytes) -> bytes:
    chunks, at = [], 12
    while at + 8 <= len(data):
        (length,) = struct.unpack_from("<I", data, at + 4)
        chunks.append([data[at : at + 4], data[at + 8 : at + 8 + length]])
        at += 8 + length + length % 2
    if not chunks:
        return changed_bytes(rng, data)
    chosen = rng.choice(chunks)
    chosen[1] = _exif_changed(rng, chosen[1]) if chosen[0] == b"EXIF" else changed_bytes(rng, chosen[1], end=min(len(chosen[1]), 32) or None)
    if rng.random() < 0.1:
        chunks.insert(rng.randrange(len(chunks) + 1), [rng.choice((b"EXIF", b"XMP ", b"ICCP", b"ANIM", b"ANMF", b"ALPH", b"VP8X")), rng.randbytes(12)])
    body = b"".join(
        kind + (number(rng)[:4].ljust(4, b"\0") if rng.random() < 0.02 else struct.pack("<I", len(part))) + part + b"\0" * (len(part) % 2)
        for kind, part in chunks
    )
    return (b"RIFF" + struct.pack("<I", len(body) + 4) + b"WEBP" + body)[:LARGEST]
