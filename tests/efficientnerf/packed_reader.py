"""The layout `packed` made `compact`, written from section 14 of efficientnerf/asset/FORMAT.md alone: plain numpy, checks no more than it needs."""

from __future__ import annotations

from typing import Any

import numpy as np


class Stream:
    """Symbols of a stream, by their contexts."""

    def __init__(self, raw: bytes, contexts: int) -> None:
        self.raw, self.at = raw, 1
        tables, self.table = raw[0], []
        while len(self.table) < contexts:
            which = self.byte()
            self.table += [which] * self.number()
        assert len(self.table) == contexts
        self.frequencies = [self.frequency() for _ in range(tables)]
        self.words = [int(word) for word in np.frombuffer(raw[self.at :], "<u2")]
        self.state = self.words.pop(0) << 16 | self.words.pop(0)

    def byte(self) -> int:
        self.at += 1
        return self.raw[self.at - 1]

    def number(self) -> int:
        byte = self.byte()
        return byte if byte < 128 else byte - 128 + (self.number() << 7)

    def frequency(self) -> list[int]:
        out: list[int] = []
        while sum(out) < 2**14:
            out.append(self.number())
            out += [0] * (self.number() if out[-1] == 0 else 0)
        assert sum(out) == 2**14
        assert len(out) <= 256
        return out

    def symbol(self, context: int) -> int:
        frequency, slot = self.frequencies[self.table[context]], self.state % 2**14
        s = int(np.searchsorted(np.cumsum(frequency), slot, side="right"))
        self.state = frequency[s] * (self.state >> 14) + slot - sum(frequency[:s])
        if self.state < 2**16:
            self.state = self.state << 16 | self.words.pop(0)
        return s

    def end(self) -> None:
        assert self.state == 2**16
        assert not self.words


STEPS = ((1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (1, 0, 1), (0, 1, 1), (1, 1, 1))


def before(at: tuple[int, ...], step: tuple[int, ...]) -> tuple[int, ...]:
    return tuple(a - s for a, s in zip(at, step, strict=True))


def unpacked(meta: dict[str, Any], tensors: dict[str, np.ndarray], nested: bool) -> dict[str, np.ndarray]:
    streams = {name: tensors[f"packed.{name}"].tobytes() for name in ("occupancy", "mask", "density", "base", "sh")}
    b, out = meta["brick"], dict(tensors)
    bits, masks = Stream(streams["occupancy"], 128), Stream(streams["mask"], 128)
    shapes = [meta["shape"], *(cascade["shape"] for cascade in (meta["cascades"] if nested else []))]
    grids = []
    for n, shape in enumerate(shapes):
        cells: dict[tuple[int, ...], int] = {}
        for cell in np.ndindex(*shape):
            cells[cell] = bits.symbol(sum(cells.get(before(cell, step), 0) << i for i, step in enumerate(STEPS)))
        out["coarse.occupancy" + (f".{n}" if n else "")] = np.packbits(list(cells.values()), bitorder="little")
        grids.append([cell for cell, occupied in cells.items() if occupied])
    rows, neighbours = [], []
    for occupied in grids:
        stored: dict[tuple[int, ...], int] = {}
        number: dict[tuple[int, ...], int] = {}
        for cell in occupied:
            row = []
            for local in np.ndindex(b, b, b):
                at = tuple(c * b + p for c, p in zip(cell, local, strict=True))
                stored[at] = masks.symbol(sum(stored.get(before(at, step), 0) << i for i, step in enumerate(STEPS)))
                row.append(stored[at])
                if stored[at]:
                    number[at] = len(neighbours)
                    neighbours.append([number[p] for p in (before(at, step) for step in STEPS[:3]) if p in number])
            rows.append(row + [0] * (-len(row) % 64))
    assert (len(rows), len(neighbours)) == (meta["packed"]["bricks"], meta["packed"]["voxels"])
    out["brick.mask"] = np.packbits(np.array(rows, np.uint8).reshape(len(rows), -1), axis=1, bitorder="little").view("<u8")
    coded = (bits, masks, *_codes(meta, tensors, streams, neighbours, out))
    for stream in coded:
        stream.end()
    return out


def _codes(
    meta: dict[str, Any], tensors: dict[str, np.ndarray], streams: dict[str, bytes], neighbours: list[list[int]], out: dict[str, np.ndarray]
) -> list[Stream]:
    count, width, groups = len(neighbours), meta["packed"]["code_bytes"], len(meta["sh_groups"])
    entries, colours = len(tensors["density.table"]), len(tensors["base.table"])
    densities, bases, codes = Stream(streams["density"], 33), Stream(streams["base"], 136), Stream(streams["sh"], max(1, groups * (272 if width == 1 else 528)))
    density, base, sh = np.zeros(count, int), np.zeros((count, 3), int), np.zeros((count, groups), int)

    def mean(values: list[int]) -> int:
        return sum(values) // len(values) if values else 0

    for n, near in enumerate(neighbours):
        density[n] = densities.symbol(1 + min(31, 32 * mean([density[m] for m in near]) // entries) if near else 0)
    for c in (1, 0, 2):
        for n, near in enumerate(neighbours):
            values = [int(base[m, c]) for m in near]
            predicted, context = mean(values), 1 + min(6, (max(values) - min(values)).bit_length()) if near else 0
            if c != 1:
                g = int(base[n, 1]) - mean([int(base[m, 1]) for m in near])
                predicted, context = min(max(predicted + g, 0), colours - 1), 8 + 32 * c + 8 * context + min(7, abs(g).bit_length())
            base[n, c] = (predicted + bases.symbol(context)) % 256
    how, shift = [0] * count, 8 * (width - 1)
    for j in range(groups):
        for n, near in enumerate(neighbours):
            values = [int(sh[m, j]) for m in near]
            known, first = list(dict.fromkeys(values)), j * (272 if width == 1 else 528)
            b, k = 4 * how[n] + min(3, 4 * int(density[n]) // entries), len(near)
            symbol = codes.symbol(first + 16 * (k if len(known) < 2 else k + 2 if len(known) == 2 else 6) + b)
            if symbol < 3:
                sh[n, j], how[n] = known[symbol], 0
                continue
            leading = codes.symbol(first + 112 + 16 * (1 + mean([(v >> shift).bit_length() for v in values]) if near else 0) + b)
            how[n] = 1 if leading < 8 else 2 if leading < 64 else 3
            sh[n, j] = leading << 8 | codes.symbol(first + 272 + leading) if width == 2 else leading
    out |= {"voxel.density": density, "voxel.base": base, "voxel.sh": sh}
    return [densities, bases, codes]
