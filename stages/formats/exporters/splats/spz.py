"""SPZ of Niantic, versions 3 and 4: 3D Gaussians in about 20 bytes each, quantised and compressed, right-handed with y up.

    header     magic NGSP, version, number, degree, fractional bits of places, flags, 0; in version 4 the last is the number of streams, and there follow
               where their table begins and 12 bytes 0
    places     3 times 24 bits, whole numbers of 2^-bits; the number of bits is chosen for the scene
    opacities  8 bits
    colours    3 times 8 bits: 0.5 + 0.15 f_dc
    scales     3 times 8 bits: their logarithms in sixteenths, from -10
    rotations  32 bits: which of x y z w is the largest, and 10 bits for each other one
    harmonics  8 bits for each coefficient above f_dc, in 128ths from -1 to 1; rounded to multiples of BUCKET, so that they compress

Version 3 is all this as gzip. Version 4 is its header as it stands, a table of the streams' bytes as stored and as unpacked, and each part as a zstd frame.

https://github.com/nianticlabs/spz
"""

import math
import struct
import sys
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from efficientnerf.splats.gaussians import Gaussians
from pipeline.errors import BadInput
from stages.formats.exporters.splats.frames import check_gaussians, smallest_three, with_y_up
from stages.formats.exporters.writing import CAPTURE_IS_Z_UP, SourceFrame, write_parts

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

MAGIC = b"NGSP"
LARGEST = 2**23 - 1  # of a place, in its steps
BITS = 12  # fractional bits of places that other writers have; here there are at least as many where they fit
STEPS = 4  # of places, in the thickness of the thinnest Gaussians but a twentieth
COLOUR = 0.15
SCALE_STEPS, SMALLEST_SCALE = 16, -10
BUCKET = 4  # of 256: what harmonics are rounded to; Niantic's writer has 8 for degree 1 and 16 above. docs/experiments/splat-formats.md
LEVEL, ZSTD_LEVEL = 6, 12  # of the compression; the latter is that of Niantic's writer
HEADER = struct.Struct("<4sIIBBBBI12x")  # of version 4
_GZIP = b"\x1f\x8b\x08\x00\x00\x00\x00\x00\x02\xff"  # no time, no name, no system: the same Gaussians give the same bytes


def write_splats(gaussians: Gaussians, path: Path, frame: SourceFrame = CAPTURE_IS_Z_UP, version: int = 3) -> None:
    """Write Gaussians given in the capture's frame. Raises BadInput."""
    check_gaussians(gaussians, path)
    gaussians = with_y_up(gaussians, frame)
    reach = float(np.abs(gaussians.means).max())
    if reach > LARGEST:
        raise BadInput(f"{path}: Gaussians at up to {reach:g} units; SPZ has places up to {LARGEST}. Write .ply or .glb.")
    thin = float(np.quantile(gaussians.scales.min(axis=1), 0.05))
    bits = min(max(BITS, math.ceil(math.log2(STEPS / thin))), math.floor(math.log2(LARGEST / max(reach, 2**-20))), 22)
    count = len(gaussians)
    places = np.round(gaussians.means.astype(np.float64) * 2**bits).astype("<i4")
    above = gaussians.harmonics[:, 1:].astype(np.float64)
    codes = (np.round(above * 128).astype(np.int64) + 128 + BUCKET // 2) // BUCKET * BUCKET
    parts = [
        places.view(np.uint8).reshape(count, 3, 4)[:, :, :3].tobytes(),
        _bytes(gaussians.opacities * 255.0),
        _bytes(gaussians.harmonics[:, 0] * (COLOUR * 255) + 127.5),
        _bytes((np.log(gaussians.scales.astype(np.float64)) - SMALLEST_SCALE) * SCALE_STEPS),
        rotation_codes(gaussians.rotations).tobytes(),
        np.clip(codes, 0, 255).astype(np.uint8).tobytes(),
    ]
    write_parts(path, {3: _as_gzip, 4: _as_zstd}[version](count, gaussians.degree, bits, parts))


def places(raw: bytes, bits: int) -> np.ndarray:
    """(N, 3) float64 of the places as versions 2 and 3 write them."""
    padded = np.zeros((len(raw) // 3, 4), np.uint8)
    padded[:, 1:] = np.frombuffer(raw, np.uint8).reshape(-1, 3)
    return np.asarray((padded.view("<i4")[:, 0] >> 8).reshape(-1, 3) / 2.0**bits)


def scales(raw: bytes) -> np.ndarray:
    """(N, 3) float64 of the scales."""
    return np.asarray(np.exp(np.frombuffer(raw, np.uint8).reshape(-1, 3) / SCALE_STEPS + SMALLEST_SCALE))


def rotation_codes(rotations: np.ndarray) -> np.ndarray:
    """(N,) uint32 of unit quaternions w x y z: the number of the largest of x y z w, then the others in that order, a sign and 9 bits each."""
    largest, rest = smallest_three(rotations[:, [1, 2, 3, 0]])
    size = np.minimum(np.floor(np.abs(rest) * (511 * 2**0.5) + 0.5), 511).astype(np.uint32)
    code = largest.astype(np.uint32)
    for column in range(3):
        code = code << 10 | (rest[:, column] < 0).astype(np.uint32) << 9 | size[:, column]
    return code.astype("<u4")


def _bytes(values: np.ndarray) -> bytes:
    return np.clip(np.round(values), 0, 255).astype(np.uint8).tobytes()


def _as_gzip(count: int, degree: int, bits: int, parts: list[bytes]) -> Iterator[bytes]:
    """Version 3."""
    deflate, check, size = zlib.compressobj(LEVEL, zlib.DEFLATED, -zlib.MAX_WBITS), 0, 0
    yield _GZIP
    for part in (struct.pack("<4sIIBBBB", MAGIC, 3, count, degree, bits, 0, 0), *parts):
        check, size = zlib.crc32(part, check), size + len(part)
        yield deflate.compress(part)
    yield deflate.flush() + struct.pack("<II", check, size & 0xFFFFFFFF)


def _as_zstd(count: int, degree: int, bits: int, parts: list[bytes]) -> Iterator[bytes]:
    """Version 4. Without harmonics there is no stream of them."""
    there = [part for part in parts if part]
    streams = [zstd.compress(part, ZSTD_LEVEL) for part in there]
    yield HEADER.pack(MAGIC, 4, count, degree, bits, 0, len(streams), HEADER.size)
    yield b"".join(struct.pack("<QQ", len(stream), len(part)) for stream, part in zip(streams, there, strict=True))
    yield from streams
