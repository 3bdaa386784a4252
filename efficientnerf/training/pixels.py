"""The pixels that a field is trained on, in little memory: bytes, and directions by lookup. R rays, C views, P pixels of all views."""

import itertools
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, Protocol

import numpy as np
import torch

from efficientnerf.backends import dispatch
from efficientnerf.backends.layout import PixelTables
from efficientnerf.geometry.cameras import Camera, rays

EXACT = 2**23  # pixels of all lenses together up to which each has a direction of its own (12 bytes each)
STRIDE = 8  # beyond it: pixels between knots
LISTED_SHARE = 1 / 8  # of the pixels that masks allow, below which these are listed: else most that are drawn would be thrown away
PART = 2**24  # pixels whose bits are unpacked at a time
BORDER, BORDER_TRIES = 0.05, 4096  # of the sides; pixels that are drawn of each view to find some there


class PixelRows(Protocol):
    """Rows (P, 3 or 4) uint8 that are indexed like an array, by slices and by arrays of row numbers; they may lie elsewhere than in memory."""

    @property
    def shape(self) -> tuple[int, ...]: ...
    @property
    def nbytes(self) -> int: ...
    def __len__(self) -> int: ...
    def __getitem__(self, index: Any) -> Any: ...
    def __setitem__(self, index: slice, rows: Any) -> None: ...


class Pixels:
    """All training pixels, and the rays that they see.

    images    (P, 3 or 4) uint8 of all views end to end, sRGB, straight alpha; an array, or the rows that were given for it
    allowed   (P / 8,) uint8 or None: a bit for each pixel, set where masks allow it
    usable    the same, and set of no view that is left out
    listed    the usable pixels, in order, where they are few; else None
    lookup    (K, 3) float32: unit directions in the camera at knots, `stride` pixels apart; one table for all views that share a lens

    Between knots 8 apart directions are interpolated: with a focal length of f pixels that is off by less than about 8 / f pixels.
    """

    def __init__(
        self, cameras: list[Camera], images: Iterable[np.ndarray], masks: Iterable[np.ndarray | None], near: np.ndarray, far: np.ndarray, channels: int = 0,
        rows: PixelRows | None = None,
    ) -> None:  # fmt: skip
        """
        images, masks  of each view, (H, W, 3 or 4) uint8, and (H, W) bool or None; taken one after the other, so that they may come from disk
        near, far      (C,) along the view axis
        channels       3, or 4 if any image has alpha; 0: found from the images, all of which are then held at once
        rows           where the pixels are put; None: an array is made
        """
        self.near, self.far = near.astype(np.float32), far.astype(np.float32)
        if not channels:
            images = list(images)
            channels = max(image.shape[-1] for image in images)
        self.width = np.array([camera.width for camera in cameras], np.int64)
        self.height = np.array([camera.height for camera in cameras], np.int64)
        self.offsets = np.concatenate([[0], np.cumsum(self.width * self.height)]).astype(np.int64)
        self.images: PixelRows = np.empty((int(self.offsets[-1]), channels), np.uint8) if rows is None else rows
        for at, image in zip(self.offsets[:-1].tolist(), images, strict=True):
            part = image.reshape(-1, image.shape[-1])
            if part.shape[1] < channels:
                part = np.concatenate([part, np.full((len(part), channels - part.shape[1]), 255, np.uint8)], axis=1)
            self.images[at : at + len(part)] = part
        self.allowed = self._usable(masks)
        self._use(self.allowed)
        self.set_cameras(cameras)

    def _use(self, usable: np.ndarray | None) -> None:
        self.usable = usable
        self.usable_count = len(self) if self.usable is None else sum(map(len, self._usable_parts()))
        if not self.usable_count:
            raise ValueError("the masks leave no pixel of the training images. Check them: white (255) is what is used.")
        few = self.usable_count < LISTED_SHARE * len(self)
        kind = np.uint32 if len(self) <= 2**32 else np.int64
        self.listed = np.concatenate([part.astype(kind) for part in self._usable_parts()]) if few else None

    def leave_out(self, views: np.ndarray) -> None:
        """Choose no pixels of these views, (C,) bool, and of the others as masks allow."""
        if not views.any():
            self._use(self.allowed)
            return
        keep = (None if not left_out else np.zeros((height, width), bool) for left_out, width, height in zip(views, self.width, self.height, strict=True))
        bits = self._usable(keep)
        assert bits is not None
        self._use(bits if self.allowed is None else bits & self.allowed)

    def set_cameras(self, cameras: Sequence[Camera]) -> None:
        """Make the rays those of these cameras, of the same sizes."""
        self.rotation = np.stack([camera.world_from_camera[:3, :3] for camera in cameras]).astype(np.float32)
        self.centre = np.stack([camera.centre for camera in cameras]).astype(np.float32)
        self._build_lookup(cameras)

    def _usable(self, masks: Iterable[np.ndarray | None]) -> np.ndarray | None:
        bits = None
        for (at, end), mask in zip(itertools.pairwise(self.offsets.tolist()), masks, strict=True):
            if mask is None:
                continue
            if bits is None:
                bits = np.full(-(-len(self) // 8), 255, np.uint8)
            # The bytes at both ends may hold pixels of the views next to this one.
            first, last = at // 8, -(-end // 8)
            whole = np.unpackbits(bits[first:last])
            whole[at - 8 * first : end - 8 * first] = mask.reshape(-1)
            bits[first:last] = np.packbits(whole)
        return bits

    def _usable_parts(self) -> Iterator[np.ndarray]:
        """The pixels that masks allow, in order, a part at a time."""
        assert self.usable is not None
        for begin in range(0, len(self), PART):
            count = min(PART, len(self) - begin)
            yield begin + np.flatnonzero(np.unpackbits(self.usable[begin // 8 : -(-(begin + count) // 8)], count=count))

    def usable_pixels(self, rank: np.ndarray) -> np.ndarray:
        """The pixels of these ranks (R,), ascending, among all that masks allow."""
        if self.usable is None:
            return rank
        found, first = [], 0
        for part in self._usable_parts():
            begin, end = np.searchsorted(rank, [first, first + len(part)])
            found.append(part[rank[begin:end] - first])
            first += len(part)
        return np.concatenate(found)

    def _build_lookup(self, cameras: Sequence[Camera]) -> None:
        """The tables of directions, and for each view where its own begins and how many knots a row has."""
        lenses: dict[tuple, list[int]] = {}
        for n, camera in enumerate(cameras):
            lenses.setdefault((camera.width, camera.height, camera.model, camera.params), []).append(n)
        self.stride = 1 if sum(width * height for width, height, *_ in lenses) <= EXACT else STRIDE
        self.lens, self.knots = np.empty(len(cameras), np.int64), np.empty(len(cameras), np.int64)
        tables, at = [], 0
        for (width, height, model, params), views in lenses.items():
            columns, rows = (-(-(side - 1) // self.stride) + 1 for side in (width, height))  # the last knot lies at the last pixel or beyond it
            y, x = np.mgrid[0:rows, 0:columns] * self.stride + 0.5
            still = Camera(cameras[views[0]].name, width, height, model, params, np.eye(4))
            tables.append(rays(still, np.stack([x.ravel(), y.ravel()], axis=-1))[1].astype(np.float32))
            self.lens[views], self.knots[views] = at, columns
            at += rows * columns
        self.lookup = np.concatenate(tables)

    def __len__(self) -> int:
        return len(self.images)

    def choose(self, count: int, rng: np.random.Generator, *, middle: bool = False) -> np.ndarray:
        """Indices of `count` usable pixels, with replacement; with `middle`, of the middle half of the images' sides where any is usable there."""
        if self.usable is None and not middle:
            return rng.integers(len(self), size=count)
        if self.listed is not None and not middle:
            return self.listed[rng.integers(len(self.listed), size=count)].astype(np.int64)
        found = np.empty(0, np.int64)
        while len(found) < count:
            tried = self.choose(2 * count, rng) if self.listed is not None else rng.integers(len(self), size=2 * count)
            if self.usable is not None and self.listed is None:
                tried = tried[self.usable_at(tried)]
            if middle:
                tried = tried[self._in_middle(tried)] if self._in_middle(tried).any() else tried
            found = np.concatenate([found, tried])
        return found[:count]

    def usable_at(self, index: np.ndarray) -> np.ndarray:
        """(R,) bool: whether these pixels are usable."""
        return _set_at(self.usable, index)

    def usable_of(self, view: int) -> np.ndarray:
        """(H, W) bool: the usable pixels of a view."""
        begin, end, size = int(self.offsets[view]), int(self.offsets[view + 1]), (self.height[view], self.width[view])
        if self.usable is None:
            return np.ones(size, bool)
        bits = np.unpackbits(self.usable[begin // 8 : -(-end // 8)])
        return bits[begin % 8 :][: end - begin].view(bool).reshape(size)

    def allowed_at(self, index: np.ndarray) -> np.ndarray:
        """(R,) bool: whether masks allow these pixels, those of views that are left out, too."""
        return _set_at(self.allowed, index)

    def view_of(self, index: np.ndarray) -> np.ndarray:
        """(R,) the view of each pixel."""
        return np.searchsorted(self.offsets, index, side="right") - 1

    def _in_middle(self, index: np.ndarray) -> np.ndarray:
        """(N,) bool: whether pixels are at least a quarter of their image's width and height from its sides."""
        view = self.view_of(index)
        y, x = np.divmod(index - self.offsets[view], self.width[view])
        return (np.abs(2 * x + 1 - self.width[view]) < self.width[view] / 2) & (np.abs(2 * y + 1 - self.height[view]) < self.height[view] / 2)

    def border_colours(self, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
        """Of the strip along the borders of each view that is BORDER of its sides wide: the median colour (C, 3), 0-1, NaN where no pixel there is usable; and
        the share (C,) of its pixels whose channels are no farther from that."""
        rng = np.random.Generator(np.random.Philox(key=0))
        colours, shares = np.full((len(self.width), 3), np.nan), np.zeros(len(self.width))
        for view, (begin, width, height) in enumerate(zip(self.offsets[:-1].tolist(), self.width.tolist(), self.height.tolist(), strict=True)):
            x, y = rng.integers(width, size=BORDER_TRIES), rng.integers(height, size=BORDER_TRIES)
            near = (np.minimum(x, width - 1 - x) < BORDER * width) | (np.minimum(y, height - 1 - y) < BORDER * height)
            index = begin + (y * width + x)[near]
            index = index[self.usable_at(index)]
            if len(index):
                seen = self.images[index][:, :3] / 255.0
                colours[view] = np.median(seen, axis=0)
                shares[view] = (np.abs(seen - colours[view]).max(axis=1) <= tolerance).mean()
        return colours, shares

    def bundle(self, index: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """origins (R, 3), directions (R, 3), near (R,), far (R,) distances along the rays, and colours (R, 3 or 4) in 0-1 of some pixels."""
        tables = PixelTables(*map(torch.from_numpy, self.tables))
        origins, directions, near, far = (t.numpy() for t in dispatch.pixel_rays(tables, self.stride, torch.from_numpy(index)))
        return origins, directions, near, far, self.images[index].astype(np.float32) / np.float32(255)

    @property
    def tables(self) -> PixelTables:
        """What rays are made of, as arrays."""
        return PixelTables(self.lookup, self.lens, self.knots, self.offsets, self.width, self.rotation, self.centre, self.near, self.far)


def _set_at(bits: np.ndarray | None, index: np.ndarray) -> np.ndarray:
    return np.ones(len(index), bool) if bits is None else (bits[index >> 3] >> (7 - (index & 7)) & 1).astype(bool)
