"""How rough a surface is where photographs are plain: walls and tables of one colour, which photographs alone say little about.

A wall that photographs leave open comes out as rags that show the right colours from where it was photographed. Textured things may be rough (leaves,
gravel); so only lines are compared along which the photograph changes nowhere. H x W pixels.
"""

import cv2
import numpy as np

from efficientnerf.geometry.cameras import Camera, rays

# docs/experiments/verdict.md
SIDE = 256  # pixels of the longest side in which plain regions are sought
CONTRAST = 3 / 255  # change of colour from pixel to pixel, below which it is plain
REACH = 4  # of those pixels, from the middle of a line to its ends
BENT = 20.0  # degrees between both halves of a line, from which it is bent
MIN_LINES = 0.03  # of the pixels: fewer lines say nothing


def roughness(photograph: np.ndarray, depth: np.ndarray, camera: Camera) -> float | None:
    """The share of lines across plain regions of a photograph whose three points on the surface do not lie on a line; None: there are too few.

    photograph  (H, W, 3) float32, 0-1
    depth       (H, W) along the view axis; infinite where there is no surface
    """
    regions = _plain_regions(photograph)
    rows, columns = (np.minimum((np.arange(n) + 0.5) * size / n, size - 1) for n, size in zip(regions.shape, depth.shape, strict=True))
    depth = depth[np.ix_(rows.astype(int), columns.astype(int))]
    grid = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    directions = rays(camera, grid)[1].reshape(*regions.shape, 3)
    known = np.isfinite(depth) & (regions > 0)
    points = directions * (np.where(known, depth, 1) / (directions @ camera.forward))[..., None]
    bent = np.concatenate([_bends(points.swapaxes(0, axis), regions.swapaxes(0, axis), known.swapaxes(0, axis)) for axis in (0, 1)])
    return float((bent > BENT).mean()) if len(bent) >= 2 * MIN_LINES * regions.size else None


def _plain_regions(photograph: np.ndarray) -> np.ndarray:
    """Numbers (h, w) of connected regions without contrast in a picture SIDE long, from 1; 0 where there is contrast within a pixel."""
    height, width = photograph.shape[:2]
    scale = SIDE / max(height, width)
    small = cv2.resize(photograph, (max(1, round(width * scale)), max(1, round(height * scale))), interpolation=cv2.INTER_AREA)
    smooth = cv2.GaussianBlur(small, (0, 0), 1.0)
    change = np.maximum(*(np.abs(cv2.Sobel(smooth, cv2.CV_32F, *axis, scale=1 / 8)).max(axis=2) for axis in ((1, 0), (0, 1))))
    plain = cv2.erode((change < CONTRAST).astype(np.uint8), np.ones((3, 3), np.uint8))
    return cv2.connectedComponents(plain, connectivity=4)[1]


def _bends(points: np.ndarray, regions: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Degrees by which lines down the columns are bent at their middle: those that stay in one region, on the surface."""
    lines = len(points) - 2 * REACH
    if lines <= 0:
        return np.zeros(0)
    inside = known[REACH:-REACH].copy()
    for k in range(2 * REACH + 1):
        inside &= known[k : k + lines] & (regions[k : k + lines] == regions[REACH:-REACH])
    first, middle, last = (points[k : k + lines][inside] for k in (0, REACH, 2 * REACH))
    along = [(b - a) / np.maximum(np.linalg.norm(b - a, axis=1, keepdims=True), 1e-12) for a, b in ((first, middle), (middle, last))]
    return np.degrees(np.arccos(np.clip((along[0] * along[1]).sum(axis=1), -1, 1)))
