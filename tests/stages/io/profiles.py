"""ICC profiles, byte by byte (version 2), and the arithmetic of the simple ones."""

import struct
from collections.abc import Callable

import numpy as np

# Columns: red, green, blue as XYZ with D50 as white (the profile connection space).
SRGB = np.array([[0.43607, 0.38515, 0.14307], [0.22249, 0.71687, 0.06061], [0.01392, 0.09708, 0.71410]])
DISPLAY_P3 = np.array([[0.51512, 0.29198, 0.15710], [0.24120, 0.69225, 0.06657], [-0.00105, 0.04189, 0.78407]])
ADOBE_RGB = np.array([[0.60974, 0.20528, 0.14919], [0.31111, 0.62567, 0.06322], [0.01947, 0.06087, 0.74457]])
PROPHOTO = np.array([[0.79767, 0.13519, 0.03135], [0.28804, 0.71188, 0.00009], [0.0, 0.0, 0.82510]])
D50 = (0.96420, 1.0, 0.82491)
Curve = Callable[[np.ndarray], np.ndarray]


def srgb_to_linear(values: np.ndarray) -> np.ndarray:
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(values: np.ndarray) -> np.ndarray:
    values = np.clip(values, 0, 1)
    return np.where(values <= 0.0031308, values * 12.92, 1.055 * values ** (1 / 2.4) - 0.055)


def power(gamma: float) -> Curve:
    return lambda values: values**gamma


def to_srgb(pixels: np.ndarray, primaries: np.ndarray, curve: Curve) -> np.ndarray:
    """(..., 3) float levels of 255 in sRGB, of pixels (..., 3) uint8 of another space."""
    linear = curve(pixels / 255.0) @ primaries.T @ np.linalg.inv(SRGB).T
    return np.asarray(255 * linear_to_srgb(linear))


def _fixed(*values: float) -> bytes:
    return b"".join(struct.pack(">i", round(value * 65536)) for value in values)


def _curve(curve: Curve) -> bytes:
    levels = np.rint(65535 * curve(np.linspace(0, 1, 1024))).astype(">u2")
    return b"curv" + bytes(4) + struct.pack(">I", len(levels)) + levels.tobytes()


def _profile(kind: bytes, space: bytes, connection: bytes, tags: dict[bytes, bytes]) -> bytes:
    about = b"desc" + bytes(4) + struct.pack(">I", 2) + b"x\0" + bytes(78)
    tags = {b"desc": about, b"cprt": b"text" + bytes(4) + b"x\0", b"wtpt": b"XYZ " + bytes(4) + _fixed(*D50), **tags}
    table, data, at = b"", b"", 128 + 4 + 12 * len(tags)
    for name, content in tags.items():
        content += bytes(-len(content) % 4)
        table += name + struct.pack(">II", at + len(data), len(content))
        data += content
    body = struct.pack(">I", len(tags)) + table + data
    head = struct.pack(">I", 128 + len(body)) + b"lcms" + b"\x02\x40\0\0" + kind + space + connection + struct.pack(">6H", 2026, 1, 1, 0, 0, 0)
    head += b"acsp" + bytes(28) + _fixed(*D50)
    return head.ljust(128, b"\0") + body


def of_colours(primaries: np.ndarray, curve: Curve) -> bytes:
    """A profile of an RGB space."""
    columns = {name: b"XYZ " + bytes(4) + _fixed(*primaries[:, index]) for index, name in enumerate((b"rXYZ", b"gXYZ", b"bXYZ"))}
    return _profile(b"mntr", b"RGB ", b"XYZ ", columns | dict.fromkeys((b"rTRC", b"gTRC", b"bTRC"), _curve(curve)))


def of_greys(curve: Curve) -> bytes:
    return _profile(b"mntr", b"GRAY", b"XYZ ", {b"kTRC": _curve(curve)})


def of_inks(paper_to_black: Curve) -> bytes:
    """A CMYK profile whose lightness falls with the sum of the inks alone: L = 100 (1 - f(K)) without C, M, Y; inks of colour make it as dark as black."""
    ramp = np.arange(256, dtype=np.uint8)
    inks = np.rint(255 * paper_to_black(ramp / 255.0)).astype(np.uint8)
    nodes = np.zeros((2, 2, 2, 2, 3), np.uint8)
    nodes[..., 1:] = 128
    nodes[0, 0, 0, 0, 0] = 255
    tables = inks.tobytes() * 4 + nodes.tobytes() + ramp.tobytes() * 3
    lut = b"mft1" + bytes(4) + bytes((4, 3, 2, 0)) + _fixed(1, 0, 0, 0, 1, 0, 0, 0, 1) + tables
    return _profile(b"prtr", b"CMYK", b"Lab ", {b"A2B0": lut, b"A2B1": lut})
