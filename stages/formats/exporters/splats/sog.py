"""SOG of PlayCanvas, version 2: 3D Gaussians as lossless WebP images in a zip that is not compressed again, right-handed. A pixel is a Gaussian. y is down: so
PlayCanvas' tools and Babylon.js take such files, which turn them over, whatever the format's page says.

    meta.json             number, ranges of positions, codebooks
    means_l, means_u      the low and the high bytes of positions: sign(v) log(1 + |v|), 16 bits within its range on each axis
    scales                codes of their logarithms
    quats                 the three smaller of w x y z in that order, 8 bits within sqrt(1/2), and 252 + the number of the largest
    sh0                   codes of f_dc, and 8 bits of the opacity
    shN_labels            of degree 1 and above: the entry of a palette, 16 bits
    shN_centroids         the palette, 64 entries a row, a pixel for each harmonic: codes of coefficients

Gaussians are in Morton order of their positions' codes, so that neighbours are alike and the images compress. Palettes are trees of two levels: a search
among 65,536 entries for each Gaussian takes many minutes.

https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog
"""

import io
import json
import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from efficientnerf.asset.quantisation import clustered
from efficientnerf.splats.gaussians import Gaussians
from efficientnerf.splats.merging import morton_codes
from pipeline.files import atomic
from stages.formats.exporters.splats.frames import check_gaussians, smallest_three, with_y_down
from stages.formats.exporters.writing import CAPTURE_IS_Z_UP, SourceFrame

VERSION = 2
LEVELS = 256  # of a codebook
PALETTE, BRANCHES, A_ROW = 2**16, 256, 64  # entries: at most; of the upper level; in a row of the image
ROTATION_TAG = 252  # and 0 to 3: which of w x y z is the largest
ITERATIONS, BINS = 16, 4096  # of Lloyd's algorithm; of the histogram that it begins with
OLDEST = (1980, 1, 1, 0, 0, 0)  # no time: the same Gaussians give the same bytes


def write_splats(gaussians: Gaussians, path: Path, frame: SourceFrame = CAPTURE_IS_Z_UP) -> None:
    """Write Gaussians given in the capture's frame. Raises BadInput."""
    check_gaussians(gaussians, path)
    files = files_of(with_y_down(gaussians, frame), frame.unit)
    with atomic(path) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_STORED) as archive:
        for name, content in files.items():
            entry = zipfile.ZipInfo(name, OLDEST)
            entry.create_system = 3
            archive.writestr(entry, content)


def files_of(gaussians: Gaussians, unit: str) -> dict[str, bytes]:
    """The files in the zip; `unit` is stated in meta.json, and readers pass over it."""
    places = gaussians.means.astype(np.float64)
    places = np.sign(places) * np.log1p(np.abs(places))
    low, high = places.min(axis=0), places.max(axis=0)
    codes = np.round((places - low) / np.where(high > low, high - low, 1) * 65535).astype(np.int64)
    order = np.argsort(morton_codes(codes), kind="stable")
    codes, chosen = codes[order], gaussians.subset(order)
    scales, scale_codes = coded(np.log(chosen.scales.astype(np.float64)))
    colours, colour_codes = coded(chosen.harmonics[:, 0].astype(np.float64))
    opacities = np.round(chosen.opacities * 255.0)
    images = {
        "means_l": _picture(codes & 255), "means_u": _picture(codes >> 8), "scales": _picture(scale_codes), "quats": _picture(rotation_codes(chosen.rotations)),
        "sh0": _picture(np.concatenate([colour_codes, opacities[:, None]], axis=1)),
    }  # fmt: skip
    meta: dict[str, Any] = {
        "version": VERSION, "asset": {"generator": "efficientnerf", "unit": unit}, "count": len(chosen), "antialias": False,
        "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": scales, "files": ["scales.webp"]}, "quats": {"files": ["quats.webp"]}, "sh0": {"codebook": colours, "files": ["sh0.webp"]},
    }  # fmt: skip
    if chosen.degree:
        palette, labels = palette_of(chosen.harmonics[:, 1:].reshape(len(chosen), -1), chosen.opacities)
        levels, palette_codes = coded(palette.astype(np.float64))
        images["shN_centroids"] = _picture(palette_codes.reshape(-1, 3), A_ROW * (chosen.harmonics.shape[1] - 1))
        images["shN_labels"] = _picture(np.stack([labels & 255, labels >> 8, np.zeros_like(labels)], axis=1))
        files = ["shN_centroids.webp", "shN_labels.webp"]
        meta["shN"] = {"count": len(palette), "bands": chosen.degree, "codebook": levels, "files": files}
    return {"meta.json": json.dumps(meta).encode("ascii"), **{f"{name}.webp": content for name, content in images.items()}}


def coded(values: np.ndarray) -> tuple[list[float], np.ndarray]:
    """LEVELS numbers in ascending order for float64 values of any shape, and the code of each value: k-means in one dimension (Lloyd), begun with levels as
    dense as the cube root of the values' density, which is best for many levels (Panter and Dite 1951)."""
    ordered = np.sort(values, axis=None)
    number, edges = np.histogram(ordered, BINS)
    reached = np.concatenate([[0], np.cumsum(np.cbrt(number))])
    levels = np.interp((np.arange(LEVELS) + 0.5) / LEVELS * reached[-1], reached, edges)
    total = np.concatenate([[0], np.cumsum(ordered)])
    for _ in range(ITERATIONS):
        begin = np.concatenate([[0], np.searchsorted(ordered, (levels[1:] + levels[:-1]) / 2), [len(ordered)]])
        number = np.diff(begin)
        levels = np.maximum.accumulate(np.where(number > 0, np.diff(total[begin]) / np.maximum(number, 1), levels))
    rounded = levels.astype(np.float32).astype(np.float64)
    return [float(f"{level:.9g}") for level in rounded], np.searchsorted((rounded[1:] + rounded[:-1]) / 2, values).astype(np.uint8)


def rotation_codes(rotations: np.ndarray) -> np.ndarray:
    """(N, 4) codes of unit quaternions w x y z."""
    largest, rest = smallest_three(rotations)
    return np.concatenate([np.clip(np.round((rest * 2**0.5 + 1) * 127.5), 0, 255), largest[:, None] + ROTATION_TAG], axis=1)


def palette_of(vectors: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Entries (P, D) float32, at most PALETTE, and the entry (N,) int64 of each of the vectors (N, D) float32, whose weights (N,) are.

    Each its own where they are few. Else k-means finds BRANCHES clusters, and within each as many entries as its share of the sum of weighted distances."""
    if len(vectors) <= PALETTE:
        return vectors, np.arange(len(vectors))
    vectors = np.ascontiguousarray(vectors)
    centres, branch = clustered(vectors, weight, BRANCHES, seed=0)
    apart = np.bincount(branch, weight * np.linalg.norm(vectors - centres[branch], axis=1), len(centres))
    entries = 1 + np.floor((PALETTE - len(centres)) * apart / max(apart.sum(), 1e-30)).astype(np.int64)
    order, number = np.argsort(branch, kind="stable"), np.bincount(branch, minlength=len(centres))
    palette, labels, count = [], np.zeros(len(vectors), np.int64), 0
    for one, members in enumerate(np.split(order, np.cumsum(number)[:-1])):
        if len(members):
            found, code = clustered(vectors[members], weight[members], min(int(entries[one]), len(members)), seed=1 + one, samples=0)
            palette.append(found)
            labels[members] = count + code
            count += len(found)
    return np.concatenate(palette), labels


def _picture(pixels: np.ndarray, width: int | None = None) -> bytes:
    """Lossless WebP of pixels (N, 3 or 4) of 0 to 255, in rows of `width`, by default about as long as there are rows, both multiples of four. What is left
    is zero."""
    wide = width or 4 * math.ceil(len(pixels) ** 0.5 / 4)
    high = -(-len(pixels) // wide)
    image = np.zeros((high if width else 4 * math.ceil(high / 4), wide, pixels.shape[1]), np.uint8)
    image.reshape(-1, pixels.shape[1])[: len(pixels)] = pixels
    out = io.BytesIO()
    Image.fromarray(image).save(out, "WEBP", lossless=True, exact=True)  # exact: colours where alpha is 0, too
    return out.getvalue()
