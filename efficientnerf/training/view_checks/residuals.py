"""How badly the field explains each training photograph, whatever its exposure, sharpness and contrast, and how far that stands out from its neighbours.

Photographs and renders are compared in cells that average many pixels, so that blur and fine texture hardly matter. The error is what is left of a
photograph's variance once the render's colours are fitted to it by channel: exposure and white balance do not matter. C views, H x W cells of a view.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from efficientnerf.geometry.cameras import Camera, rays
from efficientnerf.model import UNSEEN, Model, render_rays
from efficientnerf.training.pixels import Pixels

# docs/experiments/wrong-cameras.md
RAYS = 65536  # of all photographs together, a ray for a cell
MIN_CELLS, MAX_CELLS = 300, 1200  # of a photograph
TILE = 6  # cells along a side of a tile, whose colours are fitted by themselves
NOISE = 0.02  # standard deviation of colours that means nothing
LOW_CONTRAST = 0.5  # of the median contrast, which a photograph counts as having at least: a plain wall's noise is no error
NEIGHBOURS = 8
ROWS_AT_A_TIME = 256  # of a photograph
FAR = 1e4  # world units: where points are put that lie beyond all samples
RAYS_AT_A_TIME = 4096
SPREAD = 0.2  # of the logarithm of neighbours' errors, at least: photographs of one thing differ by as much


@dataclass(frozen=True)
class Cells:
    """The cells of the photographs."""

    size: tuple[int, ...]  # (C,) side in pixels
    colour: tuple[np.ndarray, ...]  # of each view (H, W, 3), means of the pixels, over the background where the photograph has alpha
    weight: tuple[np.ndarray, ...]  # of each view (H, W), share of a cell's pixels that masks allow


def photograph(pixels: Pixels, view: int, background: np.ndarray, rows: tuple[int, int] | None = None) -> tuple[np.ndarray, np.ndarray]:
    """A training photograph (H, W, 3) in 0-1, float32, over the background (3,) where it has alpha, and (H, W) 1 where masks allow it, 0 elsewhere; or some
    rows of both, from the first to before the last."""
    width, (first, last) = int(pixels.width[view]), rows or (0, int(pixels.height[view]))
    begin, end = (int(pixels.offsets[view]) + row * width for row in (first, last))
    shape = last - first, width
    image = np.asarray(pixels.images[begin:end], np.float32).reshape(*shape, -1) / 255
    usable = pixels.allowed_at(np.arange(begin, end)).reshape(shape).astype(np.float32)
    if image.shape[-1] == 4:
        image = image[..., :3] * image[..., 3:] + background.astype(np.float32) * (1 - image[..., 3:])
    return image, usable


def averaged(image: np.ndarray, usable: np.ndarray, side: int) -> tuple[np.ndarray, np.ndarray]:
    """Means (h, w, 3) of a photograph over cells of a side in pixels, and shares (h, w) of their pixels that are usable."""
    h, w = max(1, image.shape[0] // side), max(1, image.shape[1] // side)
    parts = np.dstack([image * usable[..., None], usable])[: h * side, : w * side]
    sums = parts.reshape(h, parts.shape[0] // h, w, parts.shape[1] // w, 4).sum(axis=(1, 3), dtype=np.float64)
    return sums[..., :3] / np.maximum(sums[..., 3:], 1e-9), sums[..., 3] / side**2


def cells_of(pixels: Pixels, background: np.ndarray) -> Cells:
    """The cells of training photographs, one of which is held at a time; `background` (3,) shows behind those with alpha."""
    count = int(np.clip(RAYS // len(pixels.width), MIN_CELLS, MAX_CELLS))
    size = tuple(max(1, int(np.ceil(np.sqrt(w * h / count)))) for w, h in zip(pixels.width.tolist(), pixels.height.tolist(), strict=True))
    found = [_averaged_in_bands(pixels, view, background, side) for view, side in enumerate(size)]
    return Cells(size, tuple(colour for colour, _ in found), tuple(weight for _, weight in found))


def _averaged_in_bands(pixels: Pixels, view: int, background: np.ndarray, side: int) -> tuple[np.ndarray, np.ndarray]:
    """`averaged` of a photograph, of which some rows at a time are held as numbers: as bytes it may be large already."""
    height, rows = int(pixels.height[view]), max(1, ROWS_AT_A_TIME // side) * side
    last = height // side * side or height  # the rest fills no cell
    bands = [averaged(*photograph(pixels, view, background, (row, min(row + rows, last))), side) for row in range(0, last, rows)]
    return np.concatenate([colour for colour, _ in bands]), np.concatenate([weight for _, weight in bands])


@torch.no_grad()
def shown(m: Model, bundle: np.ndarray, grey: bool) -> tuple[np.ndarray, np.ndarray]:
    """Renders of the field along rays (R, 8), origin, unit direction, near and far: colours (R, 3) and distances (R,) of the surface, float64; FAR without one.

    grey  whether that lies behind the scene; else what the model has there
    """
    colours, distances = [np.empty((0, 3))], [np.empty(0)]
    block = m.rays_at_once(RAYS_AT_A_TIME)
    for begin in range(0, len(bundle), block):
        part = torch.from_numpy(np.ascontiguousarray(bundle[begin : begin + block], np.float32)).to(m.device)
        directions = part[:, 3:6]
        behind = torch.full_like(directions, UNSEEN) if grey else m.behind(directions)
        outputs = render_rays(m, part[:, :3], directions, part[:, 6], part[:, 7], torch.full_like(part[:, 6], 0.5), behind)
        colours.append(outputs.fine_colour.double().cpu().numpy())
        distances.append(outputs.surface_distance(outputs.fine_ray).clamp(max=FAR).double().cpu().numpy())
    return np.concatenate(colours), np.concatenate(distances)


def bundle_of(camera: Camera, at: np.ndarray, near: float, far: float) -> np.ndarray:
    """(N, 8) rays of pixels (N, 2) for `shown`; near and far along the view axis."""
    origins, directions = rays(camera, at)
    slant = np.maximum(directions @ camera.forward, 1e-3)
    return np.column_stack([np.broadcast_to(origins, directions.shape), directions, near / slant, far / slant])


def middles(camera: Camera, side: int) -> tuple[np.ndarray, tuple[int, int]]:
    """(N, 2) the middles of a photograph's cells, row by row, and how many rows and columns there are."""
    h, w = max(1, camera.height // side), max(1, camera.width // side)
    y, x = (np.mgrid[0:h, 0:w] + 0.5) * side
    return np.stack([x.ravel(), y.ravel()], axis=-1), (h, w)


def rendered(m: Model, cameras: Sequence[Camera], near: np.ndarray, far: np.ndarray, size: Sequence[int], grey: bool) -> list[np.ndarray]:
    """(H, W, 3) of each camera what the field shows in the middles of its cells; near and far (C,) along the view axis."""
    at = [middles(camera, side) for camera, side in zip(cameras, size, strict=True)]
    bundle = np.concatenate([bundle_of(c, pixels, n, f) for c, (pixels, _), n, f in zip(cameras, at, near, far, strict=True)])
    ends = np.cumsum([len(pixels) for pixels, _ in at])[:-1]
    return [part.reshape(*shape, 3) for part, (_, shape) in zip(np.split(shown(m, bundle, grey)[0], ends), at, strict=True)]


def global_error(photograph: np.ndarray, render: np.ndarray, weight: np.ndarray) -> tuple[float, float]:
    """The mean square left of cells (H, W, 3) with weights (H, W) after a fit of gain >= 0 and offset of each channel, and the variance."""
    total = weight.sum()
    if total <= 0:
        return 0.0, 0.0
    p, r, w = photograph.reshape(-1, 3), render.reshape(-1, 3), (weight / total).reshape(-1, 1)
    p, r = p - (w * p).sum(0), r - (w * r).sum(0)
    variance, covariance, own = (w * p * p).sum(0), (w * p * r).sum(0), (w * r * r).sum(0)
    left = variance - np.maximum(covariance, 0) ** 2 / (own + NOISE**2)
    return float(left.sum()), float(variance.sum())


def local_error(photograph: np.ndarray, render: np.ndarray, weight: np.ndarray, tile: int = TILE) -> float:
    """Share of the variance inside tiles that is left, the median over tiles by their variance: an occluder in a part of the view does not change it."""
    shares, worth = [], []
    for y in range(0, photograph.shape[0], tile):
        for x in range(0, photograph.shape[1], tile):
            at = slice(y, y + tile), slice(x, x + tile)
            left, variance = global_error(photograph[at], render[at], weight[at])
            shares.append(left / (variance + 3 * NOISE**2))
            worth.append(variance * weight[at].sum())
    order = np.argsort(shares, kind="stable")
    sums = np.cumsum(np.array(worth)[order])
    return float(shares[order[np.searchsorted(sums, sums[-1] / 2)]]) if sums[-1] > 0 else 0.0


def view_errors(cells: Cells, renders: list[np.ndarray]) -> np.ndarray:
    """(C, 2): of each photograph the share of its variance that its render does not explain, as one picture and inside tiles."""
    found = [global_error(*each) for each in zip(cells.colour, renders, cells.weight, strict=True)]
    left, variance = np.array(found).T
    inside = [local_error(*each) for each in zip(cells.colour, renders, cells.weight, strict=True)]
    return np.stack([left / np.maximum(np.maximum(variance, LOW_CONTRAST**2 * np.median(variance)), 3 * NOISE**2), inside], axis=1)


def neighbours_of(cameras: Sequence[Camera]) -> np.ndarray:
    """(C, K) the cameras nearest to each in place and direction; both count by the distance to the K-th nearest, the median over the cameras."""
    centre, forward = np.stack([c.centre for c in cameras]), np.stack([c.forward for c in cameras])
    k = min(NEIGHBOURS, len(cameras) - 1)
    apart = np.linalg.norm(centre[:, None] - centre, axis=-1)
    angle = np.arccos(np.clip(forward @ forward.T, -1, 1))
    both = sum((d / max(float(np.median(np.sort(d, axis=1)[:, k])), 1e-9)) ** 2 for d in (apart, angle))
    np.fill_diagonal(both, np.inf)
    return np.argsort(both, axis=1, kind="stable")[:, :k]


def standing_out(errors: np.ndarray, neighbours: np.ndarray, trusted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(C,) by how many robust standard deviations the logarithm of a view's error exceeds its trusted neighbours', and all trusted views': the less.
    And (C,) the median errors of its trusted neighbours, or of all trusted views: the greater."""
    log, out, usual = np.log(np.maximum(errors, 1e-4)), np.full(len(errors), -np.inf), np.zeros(len(errors))
    for n in range(len(errors)):
        near = neighbours[n][trusted[neighbours[n]]]
        every = np.flatnonzero(trusted & (np.arange(len(errors)) != n))
        found, middles_of = [], []
        for some in (near, every):
            middle = np.median(log[some]) if len(some) else np.inf
            spread = max(1.4826 * float(np.median(np.abs(log[some] - middle))) if len(some) else 0.0, SPREAD)
            found.append((log[n] - middle) / spread)
            middles_of.append(middle)
        out[n], usual[n] = min(found), np.exp(max(middles_of))
    return out, usual
