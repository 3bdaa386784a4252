"""The layout `packed` made `compact`, written from section 14 of efficientnerf/asset/FORMAT.md alone: plain numpy, checks no more than it needs."""

from typing import Any

import numpy as np


class Stream:
    """Symbols of a stream, by their contexts."""

    def __init__(self, raw: bytes, contexts: int, slices: int = 1, lanes: int = 1) -> None:
        self.raw, self.at = raw, 1
        tables, self.table = raw[0], []
        while len(self.table) < contexts:
            which = self.byte()
            self.table += [which] * self.number()
        assert len(self.table) == contexts
        self.frequencies = [self.frequency() for _ in range(tables)]
        sizes = [self.number() for _ in range(slices)]
        words = [int(word) for word in np.frombuffer(raw[self.at :], "<u2")]
        assert len(words) == sum(sizes)
        ends = np.cumsum(sizes).tolist()
        self.words = [words[end - size : end] for end, size in zip(ends, sizes, strict=True)]
        self.states = [[own.pop(0) << 16 | own.pop(0) for _ in range(lanes)] for own in self.words]

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

    def symbol(self, context: int, part: int = 0, lane: int = 0) -> int:
        frequency, state = self.frequencies[self.table[context]], self.states[part][lane]
        s = int(np.searchsorted(np.cumsum(frequency), state % 2**14, side="right"))
        state = frequency[s] * (state >> 14) + state % 2**14 - sum(frequency[:s])
        self.states[part][lane] = state << 16 | self.words[part].pop(0) if state < 2**16 else state
        return s

    def end(self) -> None:
        assert all(state == 2**16 for states in self.states for state in states)
        assert not any(self.words)


STEPS = ((1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (1, 0, 1), (0, 1, 1), (1, 1, 1))


def before(at: tuple[int, ...], step: tuple[int, ...]) -> tuple[int, ...]:
    return tuple(a - s for a, s in zip(at, step, strict=True))


def unpacked(meta: dict[str, Any], tensors: dict[str, np.ndarray], nested: bool) -> dict[str, np.ndarray]:
    streams = {name: tensors[f"packed.{name}"].tobytes() for name in ("occupancy", "mask", "density", "base", "sh")}
    b, out = meta["brick"], dict(tensors)
    each = meta["packed"]["slice_bricks"]
    slices = max(1, -(-meta["packed"]["bricks"] // each))
    bits, masks = Stream(streams["occupancy"], 128), Stream(streams["mask"], 128, slices)
    shapes = [meta["shape"], *(cascade["shape"] for cascade in (meta["cascades"] if nested else []))]
    grids = []
    for n, shape in enumerate(shapes):
        cells: dict[tuple[int, ...], int] = {}
        for cell in np.ndindex(*shape):
            cells[cell] = bits.symbol(sum(cells.get(before(cell, step), 0) << i for i, step in enumerate(STEPS)))
        out["coarse.occupancy" + (f".{n}" if n else "")] = np.packbits(list(cells.values()), bitorder="little")
        grids.append([cell for cell, occupied in cells.items() if occupied])
    rows: list[list[int]] = []
    neighbours: list[tuple[int, list[int]]] = []
    for occupied in grids:
        stored: dict[tuple[int, tuple[int, ...]], int] = {}
        number: dict[tuple[int, tuple[int, ...]], int] = {}
        for cell in occupied:
            row, part = [], len(rows) // each
            for local in np.ndindex(b, b, b):
                at = tuple(c * b + p for c, p in zip(cell, local, strict=True))
                near = [(part, before(at, step)) for step in STEPS]
                stored[part, at] = masks.symbol(sum(stored.get(place, 0) << i for i, place in enumerate(near)), part)
                row.append(stored[part, at])
                if row[-1]:
                    number[part, at] = len(neighbours)
                    neighbours.append((part, [number[place] for place in near[:3] if place in number]))
            rows.append(row + [0] * (-len(row) % 64))
    assert (len(rows), len(neighbours)) == (meta["packed"]["bricks"], meta["packed"]["voxels"])
    out["brick.mask"] = np.packbits(np.array(rows, np.uint8).reshape(len(rows), -1), axis=1, bitorder="little").view("<u8")
    coded = (bits, masks, *_codes(meta, tensors, streams, neighbours, slices, out))
    for stream in coded:
        stream.end()
    return out


def _codes(
    meta: dict[str, Any], tensors: dict[str, np.ndarray], streams: dict[str, bytes], neighbours: list[tuple[int, list[int]]], slices: int,
    out: dict[str, np.ndarray],
) -> list[Stream]:  # fmt: skip
    count, width, groups = len(neighbours), meta["packed"]["code_bytes"], len(meta["sh_groups"])
    entries, colours = len(tensors["density.table"]), len(tensors["base.table"])
    densities, bases = Stream(streams["density"], 33, slices), Stream(streams["base"], 136, slices, 3)
    codes = Stream(streams["sh"], max(1, groups * (272 if width == 1 else 528)), slices, max(1, groups))
    density, base, sh = np.zeros(count, int), np.zeros((count, 3), int), np.zeros((count, groups), int)

    def mean(values: list[int]) -> int:
        return sum(values) // len(values) if values else 0

    shift = 8 * (width - 1)
    for n, (part, near) in enumerate(neighbours):
        density[n] = densities.symbol(1 + min(31, 32 * mean([density[m] for m in near]) // entries) if near else 0, part)
        for lane, c in enumerate((1, 0, 2)):
            values = [int(base[m, c]) for m in near]
            predicted, context = mean(values), 1 + min(6, (max(values) - min(values)).bit_length()) if near else 0
            if c != 1:
                g = int(base[n, 1]) - mean([int(base[m, 1]) for m in near])
                predicted, context = min(max(predicted + g, 0), colours - 1), 8 + 32 * c + 8 * context + min(7, abs(g).bit_length())
            base[n, c] = (predicted + bases.symbol(context, part, lane)) % 256
        how = 0
        for j in range(groups):
            values = [int(sh[m, j]) for m in near]
            known, first = list(dict.fromkeys(values)), j * (272 if width == 1 else 528)
            b, k = 4 * how + min(3, 4 * int(density[n]) // entries), len(near)
            symbol = codes.symbol(first + 16 * (k if len(known) < 2 else k + 2 if len(known) == 2 else 6) + b, part, j)
            if symbol < 3:
                sh[n, j], how = known[symbol], 0
                continue
            leading = codes.symbol(first + 112 + 16 * (1 + mean([(v >> shift).bit_length() for v in values]) if near else 0) + b, part, j)
            how = 1 if leading < 8 else 2 if leading < 64 else 3
            sh[n, j] = leading << 8 | codes.symbol(first + 272 + leading, part, j) if width == 2 else leading
    out |= {"voxel.density": density, "voxel.base": base, "voxel.sh": sh}
    return [densities, bases, codes]
