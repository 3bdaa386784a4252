"""A reader of NerfTree files, all layouts, written from FORMAT.md alone in 150 lines and those of `packed_reader`: plain numpy, few checks."""

from __future__ import annotations

import hashlib
import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from tests.efficientnerf.packed_reader import unpacked

KINDS = {"U8": "<u1", "U16": "<u2", "U64": "<u8", "F16": "<f2", "F32": "<f4"}


class Grid:
    """One cascade: the set of occupied cells, and the stored voxels by coordinate, numbered in the order of the file."""

    def __init__(self, shape: list[int], voxel: float, low: list[float], occupancy: np.ndarray) -> None:
        self.shape, self.voxel, self.low = shape, voxel, np.array(low)
        self.occupied = [cell for c, cell in enumerate(np.ndindex(*shape)) if int(occupancy[c // 8]) >> c % 8 & 1]
        self.stored: dict[tuple[int, ...], int] = {}

    def crossed(self, origin: np.ndarray, direction: np.ndarray, brick: int) -> tuple[float, float]:
        with np.errstate(divide="ignore"):
            crossings = np.sort([(self.low - origin) / direction, (self.low + np.array(self.shape) * brick * self.voxel - origin) / direction], axis=0)
        return max(0.0, crossings[0].max()), crossings[1].min()


class Tree:
    """The cascades, the innermost first; densities and coefficients of the stored voxels of all of them; the environment map and the region's bricks."""

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
        name = meta["layout"].removeprefix("nearest-")
        nested, layout = name.startswith("nested-"), name.removeprefix("ndc-").removeprefix("nested-")
        self.meta, self.brick = meta, meta["brick"]
        if layout == "packed":
            tensors, layout = unpacked(meta, tensors, nested), "compact"
        self.grids = [Grid(meta["shape"], meta["voxel"], meta["bounds_min"], tensors["coarse.occupancy"])]
        for n, cascade in enumerate(meta["cascades"] if nested else [], 1):
            self.grids.append(Grid(cascade["shape"], 2**n * meta["voxel"], cascade["bounds_min"], tensors[f"coarse.occupancy.{n}"]))
        count = 0
        for row, (owner, (x, y, z)) in enumerate((grid, cell) for grid in self.grids for cell in grid.occupied):
            for v, (p, q, r) in enumerate(np.ndindex(self.brick, self.brick, self.brick)):
                if layout == "full" or int(tensors["brick.mask"][row, v // 64]) >> (v % 64) & 1:
                    owner.stored[x * self.brick + p, y * self.brick + q, z * self.brick + r] = count
                    count += 1
        if layout == "compact":
            densities, sh = tensors["density.table"][tensors["voxel.density"]], np.empty((count, (meta["sh_degree"] + 1) ** 2, 3))
            groups = [g for g, size in enumerate(meta["sh_groups"]) for _ in range(size)]
            for c in range(3):
                sh[:, 0, c] = tensors["base.table"][tensors["voxel.base"][:, c], c]
                for k in range(1, sh.shape[1]):
                    sh[:, k, c] = tensors["sh.palette"][tensors["voxel.sh"][:, groups[k - 1]], k - 1, c]
        elif layout == "full":
            densities, sh = tensors["brick.density"].reshape(-1), tensors["brick.sh"].reshape(count, -1, 3)
        else:
            densities, sh = tensors["voxel.density"], tensors["voxel.sh"]
        self.densities, self.sh = densities.astype(np.float64), sh.astype(np.float64)
        assert count == len(self.densities) == len(self.sh)
        self.environment = tensors["environment"] / 255 if nested and meta["environment"] else None
        self.region, bricks = None, sum(len(grid.occupied) for grid in self.grids)
        if meta.get("region", {}).get("bricks"):
            self.region = [bool(int(tensors["x.region.bricks"][n // 8]) >> n % 8 & 1) for n in range(bricks)]

    def around(self, grid: Grid, point: np.ndarray) -> list[tuple[int, float]]:
        u = (point - grid.low) / grid.voxel
        u = np.floor(u) + 0.5 if self.meta.get("lookup") == "nearest" else u
        low = np.floor(u - 0.5).astype(int)
        f = u - 0.5 - low
        found = []
        for offset in np.ndindex(2, 2, 2):
            if (voxel := grid.stored.get(tuple(int(n) for n in low + offset))) is not None:
                found.append((voxel, math.prod(a if o else 1 - a for a, o in zip(f, offset, strict=True))))
        return found

    def grid_of(self, point: np.ndarray) -> Grid | None:
        return next((g for g in self.grids if all(0 <= u < n for u, n in zip((point - g.low) / (g.voxel * self.brick), g.shape, strict=True))), None)

    def density(self, point: np.ndarray, grid: Grid | None = None) -> float:
        grid = grid or self.grid_of(point)
        if grid is None or tuple(int(n) for n in np.floor((point - grid.low) / grid.voxel / self.brick)) not in grid.occupied:
            return 0.0
        return sum(weight * self.densities[voxel] for voxel, weight in self.around(grid, point))

    def colour(self, point: np.ndarray, direction: np.ndarray, grid: Grid | None = None) -> np.ndarray:
        found = self.around(grid or self.grid_of(point) or self.grids[-1], point)
        total = sum(weight for _, weight in found)
        if total == 0:
            return np.full(3, 0.5)
        coefficients = sum(weight * self.sh[voxel] for voxel, weight in found) / total  # (K, 3)
        return 1 / (1 + np.exp(-(harmonics(direction, self.meta["sh_degree"]) @ coefficients)))

    def parts(self, origin: np.ndarray, direction: np.ndarray) -> list[tuple[Grid, float, float]]:
        met = [grid.crossed(origin, direction, self.brick) for grid in self.grids]
        front, back = [], []
        for grid, (enter, leave), (inner_enter, inner_leave) in zip(self.grids[1:], met[1:], met, strict=False):
            meets = inner_leave > inner_enter
            front.append((grid, enter, inner_enter if meets else leave))
            back.append((grid, inner_leave if meets else leave, leave))
        return [*reversed(front), (self.grids[0], *met[0]), *back]

    def ray(self, origin: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, float]:
        light, colour = 1.0, np.zeros(3)
        for grid, enter, leave in self.parts(origin, direction):
            n, step = 0, self.meta.get("step_size", 0.5) * grid.voxel
            while (t := enter + (n + 0.5) * step) < leave:
                alpha = 1 - math.exp(-self.density(origin + t * direction, grid) * step)
                if alpha > 0:
                    colour = colour + light * alpha * self.colour(origin + t * direction, direction, grid)
                light *= 1 - alpha
                n += 1
        return (colour if self.environment is None else colour + light * self.behind(direction)), 1 - light

    def behind(self, direction: np.ndarray) -> np.ndarray:
        rows, columns, _ = self.environment.shape
        column = (math.atan2(direction[1], direction[0]) / (2 * math.pi) + 0.5) * columns - 0.5
        row = min(max(math.acos(direction[2]) / math.pi * rows - 0.5, 0), rows - 1)
        i, j = math.floor(row), math.floor(column)
        upper, lower = (self.environment[min(n, rows - 1)] for n in (i, i + 1))
        first, second = (line[j % columns] * (1 - column + j) + line[(j + 1) % columns] * (column - j) for line in (upper, lower))
        return first * (1 - row + i) + second * (row - i)


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
