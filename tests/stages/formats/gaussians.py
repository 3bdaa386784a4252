"""Gaussians for tests of splat files, and small readers of these, written from the formats' descriptions."""

import gzip
import io
import json
import math
import struct
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from efficientnerf.splats.gaussians import Gaussians
from stages.formats.exporters.splats.spz import zstd
from tests.stages.io.meshes import accessor, glb_document


def scattered(count: int = 50, degree: int = 2, seed: int = 0) -> Gaussians:
    """Of all shapes, colours and opacities, flat and long ones too."""
    rng = np.random.default_rng(seed)
    quaternions = rng.normal(size=(count, 4))
    harmonics = rng.normal(0, 0.3, (count, (degree + 1) ** 2, 3))
    return Gaussians(
        means=rng.normal(0, 2, (count, 3)).astype(np.float32),
        scales=np.exp(rng.uniform(-7, 0, (count, 3))).astype(np.float32),
        rotations=(quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)).astype(np.float32),
        opacities=rng.uniform(0.01, 0.99, count).astype(np.float32),
        harmonics=np.clip(harmonics, -0.9, 0.9).astype(np.float32),
    )


@dataclass(frozen=True)
class SpzHeader:
    version: int
    count: int
    degree: int
    bits: int
    flags: int


def read_spz(path: Path) -> tuple[SpzHeader, Gaussians]:
    data = path.read_bytes()
    data = joined_streams(data) if data[:4] == b"NGSP" else gzip.decompress(data)
    magic, version, count, degree, bits, flags, reserved = struct.unpack_from("<IIIBBBB", data)
    assert (magic, reserved) == (0x5053474E, 0)
    above = (degree + 1) ** 2 - 1
    sizes = [9, 1, 3, 3, 4, 3 * above]
    assert len(data) == 16 + count * sum(sizes)
    starts = 16 + count * np.cumsum([0, *sizes])
    raw = [np.frombuffer(data, np.uint8, count * size, start).reshape(count, size) for size, start in zip(sizes, starts)]
    signed = np.zeros((count, 3, 4), np.uint8)
    signed[:, :, 1:] = raw[0].reshape(count, 3, 3)
    places = (signed.view("<i4")[..., 0] >> 8) / 2.0**bits
    quaternions = np.array([_quaternion(int(code)) for code in raw[4].copy().view("<u4")[:, 0]])
    first = (raw[2] / 255 - 0.5) / 0.15
    rest = (raw[5].astype(float) - 128) / 128
    harmonics = np.concatenate([first[:, None], rest.reshape(count, above, 3)], axis=1)
    opacities = np.clip(raw[1][:, 0] / 255, 1e-3, 1 - 1e-3)
    arrays = (places, np.exp(raw[3] / 16 - 10), quaternions, opacities, harmonics)
    return SpzHeader(version, count, degree, bits, flags), Gaussians(*(array.astype(np.float32) for array in arrays))


def joined_streams(data: bytes) -> bytes:
    """What version 4 holds, as version 3 has it before its compression."""
    streams, table, *reserved = struct.unpack_from("<BI3I", data, 15)
    assert reserved == [0, 0, 0]
    at, parts = table + 16 * streams, [data[:15] + b"\0"]
    for n in range(streams):
        stored, unpacked = struct.unpack_from("<QQ", data, table + 16 * n)
        parts.append(zstd.decompress(data[at : at + stored]))
        assert len(parts[-1]) == unpacked
        at += stored
    assert at == len(data)
    return b"".join(parts)


def _quaternion(code: int) -> list[float]:
    """w x y z."""
    largest, parts = code >> 30, [0.0] * 4
    for place in reversed([k for k in range(4) if k != largest]):
        parts[place] = (-1 if code & 512 else 1) * (code & 511) / 511 / 2**0.5
        code >>= 10
    parts[largest] = (1 - sum(part**2 for part in parts)) ** 0.5
    return [parts[3], *parts[:3]]


def read_glb_splats(path: Path) -> tuple[dict, Gaussians]:
    """The document, and what its one primitive holds."""
    document, blob = glb_document(path)
    primitive = document["meshes"][0]["primitives"][0]
    attributes = {name: accessor(document, blob, index) for name, index in primitive["attributes"].items()}
    prefix = "KHR_gaussian_splatting:"
    names = sorted(name for name in attributes if name.startswith(f"{prefix}SH_DEGREE_"))
    harmonics = np.stack([attributes[name] for name in names], axis=1)
    rotations = attributes[f"{prefix}ROTATION"][:, [3, 0, 1, 2]].copy()
    arrays = (attributes["POSITION"], attributes[f"{prefix}SCALE"], rotations, attributes[f"{prefix}OPACITY"][:, 0], harmonics)
    return document, Gaussians(*(np.ascontiguousarray(array) for array in arrays))


def read_sog(path: Path) -> tuple[dict, Gaussians]:
    """meta.json and the Gaussians, one after the other, in the order of the file."""
    with zipfile.ZipFile(path) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    meta = json.loads(files["meta.json"])
    pictures = {name: Image.open(io.BytesIO(data)) for name, data in files.items() if name != "meta.json"}
    assert all(picture.format == "WEBP" for picture in pictures.values())

    def pixel(part: str, index: int, which: int = 0) -> tuple[int, ...]:
        picture = pictures[meta[part]["files"][which]]
        return picture.getpixel((index % picture.width, index // picture.width))

    rows = [_sog_gaussian(meta, pixel, index, pictures) for index in range(meta["count"])]
    return meta, Gaussians(*(np.array([row[k] for row in rows], np.float32) for k in range(5)))


def _sog_gaussian(meta: dict, pixel: Callable[..., tuple[int, ...]], index: int, pictures: dict) -> list:
    """Position, scales, rotation w x y z, opacity, harmonics."""
    place = []
    for low, high, below, above in zip(meta["means"]["mins"], meta["means"]["maxs"], pixel("means", index), pixel("means", index, 1)):
        shrunk = low + (high - low) * (256 * above + below) / 65535
        place.append(math.copysign(math.exp(abs(shrunk)) - 1, shrunk))
    *rest, mode = pixel("quats", index)
    smaller = [(code / 255 * 2 - 1) / 2**0.5 for code in rest]
    turn = [*smaller[: mode - 252], max(0, 1 - sum(x * x for x in smaller)) ** 0.5, *smaller[mode - 252 :]]
    *colour, opacity = pixel("sh0", index)
    harmonics = [[meta["sh0"]["codebook"][code] for code in colour]]
    if "shN" in meta:
        low, high, _ = pixel("shN", index, 1)
        entry, each = 256 * high + low, (meta["shN"]["bands"] + 1) ** 2 - 1
        assert entry < meta["shN"]["count"]
        palette = pictures[meta["shN"]["files"][0]]
        assert palette.width == 64 * each
        codes = [palette.getpixel((entry % 64 * each + k, entry // 64)) for k in range(each)]
        harmonics += [[meta["shN"]["codebook"][code] for code in three] for three in codes]
    scales = [math.exp(meta["scales"]["codebook"][code]) for code in pixel("scales", index)]
    return [place, scales, turn, min(max(opacity / 255, 1e-3), 1 - 1e-3), harmonics]
