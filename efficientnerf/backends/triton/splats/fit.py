"""Gaussians rendered, and fitted to pictures, on CUDA: the twin of `efficientnerf.backends.numba.splats.fit`.

The host waits for the device once a step, for the number of pairs.
"""

from __future__ import annotations

import numpy as np
import torch
import triton
from torch import Tensor

from efficientnerf.backends import splat_layout as layout
from efficientnerf.backends.splat_layout import Picture, Rates, SplatState
from efficientnerf.backends.transfer import to_device
from efficientnerf.backends.triton.launch import LANES, blocks
from efficientnerf.backends.triton.splats import raster
from efficientnerf.backends.triton.splats.projection import Lens, project
from efficientnerf.backends.triton.splats.raster import Pairs, Target
from efficientnerf.backends.triton.splats.steps import Rule, step


def lens_of(lens: layout.Lens) -> Lens:
    """For the kernels."""
    parts = lens.turn, lens.centre, lens.numbers, lens.limits, (lens.width, lens.height)
    return Lens(*(tuple(float(number) for number in part) for part in parts))


def projected(values: Tensor, lens: layout.Lens, degree: int) -> tuple[Tensor, Tensor, Pairs]:
    """Records (N, RECORD) of Gaussians (11 + 3 K, N), how many tiles each is in (N,), and the pairs, those of one tile and depth by number."""
    count, device = values.shape[1], values.device
    records, boxes = torch.empty(count, layout.RECORD, device=device), torch.zeros(4, count, dtype=torch.int32, device=device)
    project[(blocks(count),)](values, records, boxes, count, lens_of(lens), FISHEYE=lens.fisheye, K=(degree + 1) ** 2, BLOCK=LANES)
    columns, rows = triton.cdiv(lens.width, layout.TILE), triton.cdiv(lens.height, layout.TILE)
    ends = boxes[3].cumsum(0)
    total = int(boxes[3].sum())
    gaussian = torch.repeat_interleave(torch.arange(count, device=device), boxes[3], output_size=total)
    left, top, across, tiles = boxes[:, gaussian].long()
    number = torch.arange(total, device=device) - ends[gaussian] + tiles
    tile = (top + number // across) * columns + left + number % across
    depth = records[:, layout.DEPTH].contiguous().view(torch.int32)  # depths are positive: their bits have the same order
    key, order = torch.sort(tile << 32 | depth[gaussian], stable=True)
    begin = torch.searchsorted(key, torch.arange(columns * rows + 1, device=device) << 32)
    return records, boxes[3], Pairs(begin, gaussian[order], columns)


def splat_image(rows: np.ndarray, degree: int, lens: layout.Lens, device: str = "cuda") -> tuple[np.ndarray, np.ndarray]:
    """See `efficientnerf.backends.numba.splats.fit.splat_image`."""
    values = columns_of(rows, device)
    records, _, pairs = projected(values, lens, degree)
    colour, light = torch.empty(lens.height, lens.width, 3, device=device), torch.empty(lens.height, lens.width, device=device)
    raster.render_tiles[(len(pairs.begin) - 1, raster.BLOCKS)](records, pairs, colour, light, lens.width, lens.height, num_warps=1)
    return colour.cpu().numpy(), light.cpu().numpy()


def columns_of(rows: np.ndarray, device: str) -> Tensor:
    """(N, C) as (C, N) on a device."""
    return to_device(torch.from_numpy(np.ascontiguousarray(rows)), torch.device(device)).T.contiguous()


class SplatFit:
    """See `efficientnerf.backends.numba.splats.fit.SplatFit`."""

    def __init__(self, rows: np.ndarray, moments: np.ndarray, degree: int, device: str = "cuda") -> None:
        self.values, self.moments, self._degree = columns_of(rows, device), columns_of(moments, device), degree
        self.errors = torch.zeros(len(rows), device=device)
        self._draws: Tensor | None = None  # of all steps the same

    def step(self, lens: layout.Lens, picture: Picture, rates: Rates) -> None:
        """A step of all Gaussians that are in the image."""
        records, tiles, pairs = projected(self.values, lens, self._degree)
        pixels, mask = (to_device(torch.tensor(part), self.values.device) for part in (picture.pixels, picture.mask))
        sums = torch.zeros(len(records), layout.SUMS, device=self.values.device)
        target = Target(pixels, mask, tuple(picture.background.tolist()), float(picture.structure), float(picture.huber_delta))
        raster.fit_tiles[(len(pairs.begin) - 1, raster.BLOCKS)](
            records, pairs, target, sums, lens.width, lens.height, OVER_ALL=picture.over_all, num_warps=1
        )  # fmt: skip
        numbers = rates.momentum, rates.decay, rates.epsilon, rates.fade, rates.noise, rates.least, rates.greatest
        if self._draws is None:
            self._draws = to_device(torch.from_numpy(rates.draws), self.values.device)
        step[(blocks(len(tiles)),)](
            self.values, self.moments, self.errors, sums, tiles, len(tiles), lens_of(lens), Rule(tuple(rates.rates.tolist()), *map(float, numbers)),
            self._draws, rates.shift, FISHEYE=lens.fisheye, K=(self._degree + 1) ** 2, BLOCK=LANES,
        )  # fmt: skip

    def state(self) -> SplatState:
        return SplatState(*(part.t().contiguous().cpu().numpy() for part in (self.values, self.moments, self.errors)))
