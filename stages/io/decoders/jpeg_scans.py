"""How many scans a JPEG has: each is a pass over all of its pixels, and an empty one takes 10 bytes of the file."""

import re
from collections.abc import Iterator
from typing import BinaryIO

# Scans of a picture at most: libjpeg's own scripts have 10, other programs up to 64; and times pixels, for a hundred passes over 32 million take a minute.
MOST_SCANS, SCANNED_PIXELS, FEWEST = 100, 100 * 32_000_000, 16
MOST_SEGMENTS = 2**16  # before and between scans; a profile or EXIF data of 64 MB has a thousand

_MARKER = re.compile(rb"\xff+([^\x00\x01\xd0-\xd8\xff])")  # but those that stand alone: of restarts, and of the picture's beginning
_FRAMES = frozenset({*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC})
_PROGRESSIVE = (0xC2, 0xC6, 0xCA, 0xCE)
_SCAN, _END = 0xDA, 0xD9
_BEGINNING = b"\xff\xd8\xff"
OVERLAPS = 16  # bytes that are looked at for each of a file; of tiles side by side two
_HEAD = 2**18  # bytes in which most files come to their first scan


def most_scans(width: int, height: int) -> int:
    """Scans of a picture of this size that are decoded at most."""
    return min(MOST_SCANS, max(FEWEST, SCANNED_PIXELS // max(1, width * height)))


def has_more_scans(file: BinaryIO, limit: int) -> bool:
    """Whether the JPEG that a file begins with has more scans than `limit`, or more segments than any has; the file is left at its beginning.

    Of a picture whose first scan holds all of it, as those of cameras do, only the beginning is read.
    """
    file.seek(0)
    data = file.read(_HEAD)
    several = _of_several_scans(data)
    if several is None or several:
        data += file.read()
        several = _of_several_scans(data)
    file.seek(0)
    return bool(several) and _counted(data, limit)[0] > limit


def _of_several_scans(data: bytes) -> bool | None:
    """Whether a decoder reads on behind the first scan; None where there is none in what was read."""
    progressive, components = False, 0
    for kind, at in _segments(data):
        if kind in _FRAMES:
            progressive, components = kind in _PROGRESSIVE, data[at + 7] if at + 7 < len(data) else 0
        if kind == _SCAN and at + 2 < len(data):
            return progressive or data[at + 2] < components
    return None


def holds_more_scans(data: bytes, limit: int) -> bool:
    """Whether a JPEG somewhere in a file has more scans than `limit`: those of a raw picture's tiles lie where its directories say, unchecked.

    Each possible beginning is checked; a file in which they overlap again and again is refused, too.
    """
    at, left = -1, OVERLAPS * len(data)
    while (at := data.find(_BEGINNING, at + 1)) >= 0:
        scans, end = _counted(data, limit, at)
        left -= end - at
        if scans > limit or left < 0:
            return True
    return False


def _counted(data: bytes, limit: int, begin: int = 0) -> tuple[int, int]:
    """Scans of the JPEG from there, up to one above the limit, and where its last marker lies. More segments than any has count as too many scans."""
    scans, at = 0, begin
    for number, (kind, at) in enumerate(_segments(data, begin)):
        scans += kind == _SCAN
        if scans > limit or number > MOST_SEGMENTS:
            return limit + 1, at
    return scans, at


def _segments(data: bytes, begin: int = 0) -> Iterator[tuple[int, int]]:
    """(kind, offset of its length) of each marker of the JPEG from there; what is between them, coded data too, is passed over, as decoders do. The last one is
    that of the picture's end, whether it is there or not."""
    at, kind = begin + 2, 0
    while kind != _END:
        found = _MARKER.search(data, at)
        kind, at = (found[1][0], found.end()) if found is not None else (_END, len(data))
        yield kind, at
        at += int.from_bytes(data[at : at + 2], "big")
