"""3D Gaussians that `inspect` describes: SPZ, SOG, and the PLY of 3DGS."""

import io
import struct
import zipfile
import zlib
from collections.abc import Callable
from random import Random

from benchmarks.fuzz import json_text
from benchmarks.fuzz.binary import changed_bytes
from benchmarks.fuzz.meshes import glb_changed, open_described, ply_changed
from benchmarks.fuzz.reader import Reader, bytes_of

HEADER = 16  # bytes of SPZ: magic, version, number, degree, bits, flags, 0


def seeds(suffix: str) -> Callable[[], list[bytes]]:
    def made() -> list[bytes]:
        from stages.formats.exporters import SPLAT_EXPORTERS
        from stages.formats.exporters.writing import CAPTURE_IS_Z_UP
        from tests.stages.formats.gaussians import scattered

        write = SPLAT_EXPORTERS[suffix]
        return [bytes_of(lambda path, n=degree: write(scattered(40, n), path, CAPTURE_IS_Z_UP), f"a{suffix}") for degree in (0, 1, 3)]  # type: ignore[misc]

    return made


def spz_changed(rng: Random, data: bytes) -> bytes:
    """What is stored, or what it unpacks to: its header, its rows, or how many there are."""
    try:
        inside = zlib.decompress(data, 16 + zlib.MAX_WBITS)
    except zlib.error:
        return changed_bytes(rng, data)
    kind = rng.random()
    if kind < 0.3:
        return changed_bytes(rng, data)
    if kind < 0.6:
        inside = changed_bytes(rng, inside[:HEADER]) + inside[HEADER:]
    elif kind < 0.8:
        count, flags = rng.choice((0, 1, 39, 41, 2**20, 2**31, 2**32 - 1)), rng.choice((0, 1, 2, 128, 255))
        inside = inside[:8] + struct.pack("<I", count) + inside[12:14] + bytes([flags]) + inside[15:] + bytes(rng.choice((0, 1, 2**16, 2**24)))
    else:
        inside = changed_bytes(rng, inside, begin=HEADER)
    packed = zlib.compressobj(6, zlib.DEFLATED, 16 + zlib.MAX_WBITS)
    return packed.compress(inside) + packed.flush()


def sog_changed(rng: Random, data: bytes) -> bytes:
    """The zip as it is stored, or its meta.json, or an image, with right checksums."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            files = {name: archive.read(name) for name in archive.namelist()}
    except Exception:  # of an input that was changed before
        return changed_bytes(rng, data)
    kind = rng.random()
    if kind < 0.4 or "meta.json" not in files:
        return changed_bytes(rng, data, begin=0 if kind < 0.1 else max(0, len(data) - 600))
    if kind < 0.9:
        files["meta.json"] = json_text.changed(rng, files["meta.json"])
    else:
        name = rng.choice([*files])
        files[name] = changed_bytes(rng, files[name])
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))) as archive:
        for name, content in files.items():
            archive.writestr(zipfile.ZipInfo(name), content, archive.compression)
    return out.getvalue()


READERS = (
    Reader("spz", "SPZ of 3D Gaussians", seeds(".spz"), spz_changed, open_described(".spz")),
    Reader("sog", "SOG of 3D Gaussians", seeds(".sog"), sog_changed, open_described(".sog")),
    Reader("splats_ply", "PLY of 3D Gaussians", seeds(".ply"), ply_changed, open_described(".ply"), share=0.25),
    Reader("splats_glb", "GLB of 3D Gaussians", seeds(".glb"), glb_changed, open_described(".glb"), share=0.25),
)
