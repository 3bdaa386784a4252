"""Gaussians for tests of splat files, and small readers of these, written from the formats' descriptions."""

from __future__ import annotations

import gzip
import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from efficientnerf.splats.gaussians import Gaussians
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
    data = gzip.decompress(path.read_bytes())
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
