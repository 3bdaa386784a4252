"""A reader of NerfTree files, all layouts, written from efficientnerf/asset/FORMAT.md alone in 100 lines: plain numpy, checks no more than it needs."""

from __future__ import annotations

import hashlib
import json
import math
from pathlib import Path
from typing import Any

import numpy as np

KINDS = {"U8": "<u1", "U16": "<u2", "U64": "<u8", "F16": "<f2", "F32": "<f4"}


class Tree:
    """Stored voxels by coordinate, in the order of the file, with their densities and coefficients; and the set of occupied cells."""

    def __init__(self, path: Path) -> None:
        data = path.read_bytes()
        length = int.from_bytes(data[:8], "little")
        header = json.loads(data[8 : 8 + length].decode("utf-8"))
        meta: dict[str, Any] = json.loads(header["__metadata__"]["nerftree"])
        tensors = {}
        for name, digest in meta["sha256"].items():
            begin, end = header[name]["data_offsets"]
            raw = data[8 + length + begin : 8 + length + end]
            assert hashlib.sha256(raw).hexdigest() == digest
            tensors[name] = np.frombuffer(raw, KINDS[header[name]["dtype"]]).reshape(header[name]["shape"])
        self.meta, self.brick, self.voxel, layout = meta, meta["brick"], meta["voxel"], meta["layout"].removeprefix("nearest-").removeprefix("ndc-")
        self.low, self.shape = np.array(meta["bounds_min"]), meta["shape"]
        occupancy = [int(byte) for byte in tensors["coarse.occupancy"]]
        self.occupied = [cell for c, cell in enumerate(np.ndindex(*self.shape)) if occupancy[c // 8] >> c % 8 & 1]
        self.stored: dict[tuple[int, ...], int] = {}
        for row, (x, y, z) in enumerate(self.occupied):
            for v, (p, q, r) in enumerate(np.ndindex(self.brick, self.brick, self.brick)):
                if layout == "full" or int(tensors["brick.mask"][row, v // 64]) >> (v % 64) & 1:
                    self.stored[x * self.brick + p, y * self.brick + q, z * self.brick + r] = len(self.stored)
        if layout == "compact":
            densities, sh = tensors["density.table"][tensors["voxel.density"]], np.empty((len(self.stored), (meta["sh_degree"] + 1) ** 2, 3))
            groups = [g for g, size in enumerate(meta["sh_groups"]) for _ in range(size)]
            for c in range(3):
                sh[:, 0, c] = tensors["base.table"][tensors["voxel.base"][:, c], c]
                for k in range(1, sh.shape[1]):
                    sh[:, k, c] = tensors["sh.palette"][tensors["voxel.sh"][:, groups[k - 1]], k - 1, c]
        elif layout == "full":
            densities, sh = tensors["brick.density"].reshape(-1), tensors["brick.sh"].reshape(len(self.stored), -1, 3)
        else:
            densities, sh = tensors["voxel.density"], tensors["voxel.sh"]
        self.densities, self.sh = densities.astype(np.float64), sh.astype(np.float64)
        assert len(self.stored) == len(self.densities) == len(self.sh)

    def around(self, u: np.ndarray) -> list[tuple[int, float]]:
        u = np.floor(u) + 0.5 if self.meta.get("lookup") == "nearest" else u
        low = np.floor(u - 0.5).astype(int)
        f = u - 0.5 - low
        found = []
        for offset in np.ndindex(2, 2, 2):
            if (voxel := self.stored.get(tuple(int(n) for n in low + offset))) is not None:
                found.append((voxel, math.prod(a if o else 1 - a for a, o in zip(f, offset, strict=True))))
        return found

    def density(self, point: np.ndarray) -> float:
        u = (point - self.low) / self.voxel
        if tuple(int(n) for n in np.floor(u / self.brick)) not in self.occupied:
            return 0.0
        return sum(weight * self.densities[voxel] for voxel, weight in self.around(u))

    def colour(self, point: np.ndarray, direction: np.ndarray) -> np.ndarray:
        found = self.around((point - self.low) / self.voxel)
        total = sum(weight for _, weight in found)
        if total == 0:
            return np.full(3, 0.5)
        coefficients = sum(weight * self.sh[voxel] for voxel, weight in found) / total  # (K, 3)
        return 1 / (1 + np.exp(-(harmonics(direction, self.meta["sh_degree"]) @ coefficients)))

    def ray(self, origin: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, float]:
        with np.errstate(divide="ignore"):
            crossings = np.sort([(self.low - origin) / direction, (self.low + np.array(self.shape) * self.brick * self.voxel - origin) / direction], axis=0)
        enter, leave = max(0.0, crossings[0].max()), crossings[1].min()
        light, colour, n = 1.0, np.zeros(3), 0
        while (t := enter + (n + 0.5) * self.voxel / 2) < leave:
            alpha = 1 - math.exp(-self.density(origin + t * direction) * self.voxel / 2)
            if alpha > 0:
                colour = colour + light * alpha * self.colour(origin + t * direction, direction)
            light *= 1 - alpha
            n += 1
        return colour, 1 - light


def harmonics(direction: np.ndarray, degree: int) -> np.ndarray:
    (x, y, z), out = direction, []
    for l in range(degree + 1):
        for m in range(-l, l + 1):
            a = abs(m)
            derived = (np.polynomial.Polynomial([-1, 0, 1]) ** l).deriv(l + a) if l + a else np.polynomial.Polynomial([1])
            p = (-1) ** a * (1 - z * z) ** (a / 2) / (2**l * math.factorial(l)) * derived(z)
            n = math.sqrt((2 * l + 1) / (4 * math.pi) * math.factorial(l - a) / math.factorial(l + a))
            out.append(n * p * (1.0 if m == 0 else math.sqrt(2) * (math.cos(m * math.atan2(y, x)) if m > 0 else math.sin(a * math.atan2(y, x)))))
    return np.array(out)
