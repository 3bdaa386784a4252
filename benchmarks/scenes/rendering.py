"""Images of shapes: one light with shadows, a sky, one mirror reflection. Whitted 1980, "An improved illumination model for shaded display".

All values are linear light until `image` turns them into sRGB. R rays.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.scenes.shapes import Material, Shape
from efficientnerf.geometry.cameras import Camera, rays
from efficientnerf.rendering.colour import srgb_from_linear

Direction = tuple[float, float, float]
SUN: Direction = tuple((np.array([0.45, -0.55, 0.70]) / np.linalg.norm([0.45, -0.55, 0.70])).tolist())
SUN_COLOUR, SKY_COLOUR = np.array([1.0, 0.94, 0.82]) * 0.85, np.array([0.55, 0.68, 0.90]) * 0.5
RAYS_AT_ONCE = 2**16


@dataclass(frozen=True)
class Hits:
    """distance (R,), infinite where a ray meets nothing; shape (R,) its number, -1 likewise."""

    distance: np.ndarray
    shape: np.ndarray


def _near_balls(shapes: Sequence[Shape], origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """(M, R) whether a ray comes near the ball of each shape: in single precision, with a margin for its rounding."""
    centres, radii = (np.array(part, np.float32) for part in zip(*(shape.ball for shape in shapes), strict=True))
    o, d = origins.astype(np.float32), directions.astype(np.float32)
    middle = centres @ d.T  # (M, R) where on the ray the ball is nearest
    middle -= (o * d).sum(-1)
    away = centres @ o.T  # (M, R) squared distance of its centre
    away *= -2
    away += (o**2).sum(-1)
    away += (centres**2).sum(-1)[:, None]
    largest = (radii**2 * 1.001 + 1e-5 * (1 + (centres**2).sum(-1) + (o**2).sum(-1).max(initial=0)))[:, None]
    meets = away <= largest
    meets |= middle > 0
    middle *= middle
    away -= middle
    meets &= away <= largest
    return meets


def nearest(shapes: Sequence[Shape], origins: np.ndarray, directions: np.ndarray) -> Hits:
    """The first shape along each ray."""
    distance, found = np.full(len(origins), np.inf), np.full(len(origins), -1)
    meets = _near_balls(shapes, origins, directions)
    for number, shape in enumerate(shapes):
        here = np.flatnonzero(meets[number])
        t = shape.hit(origins[here], directions[here])
        closer = t < distance[here]
        distance[here[closer]], found[here[closer]] = t[closer], number
    return Hits(distance, found)


def environment(directions: np.ndarray, light: Direction = SUN) -> np.ndarray:
    """(R, 3) light from far away: a sky that brightens towards the horizon, the sun, and three lamps that mirrors show."""
    up = np.clip(directions[:, 2:], -1, 1)
    sky = np.where(up > 0, SKY_COLOUR * (2.0 - 1.2 * np.sqrt(np.maximum(up, 0))), SKY_COLOUR * (0.6 + 0.4 * (1 + up)))
    sun = 4.0 * np.maximum(directions @ np.array(light), 0)[:, None] ** 400 * SUN_COLOUR
    lamps = np.zeros_like(sky)
    for n, colour in enumerate(([1.0, 0.5, 0.3], [0.4, 0.9, 0.5], [0.5, 0.5, 1.0])):
        angle = 2.1 * n
        at = np.array([np.cos(angle), np.sin(angle), 0.5]) / np.sqrt(1.25)
        lamps += 1.2 * np.maximum(directions @ at, 0)[:, None] ** 60 * np.array(colour)
    return sky + sun + lamps


def noise(points: np.ndarray) -> np.ndarray:
    """(R,) value noise in [0, 1] of period one, trilinear between integer points; the same on every machine."""
    cell = np.floor(points).astype(np.int64)
    f = points - cell
    f = f * f * (3 - 2 * f)
    out = np.zeros(len(points))
    for corner in range(8):
        offset = np.array([corner >> 2 & 1, corner >> 1 & 1, corner & 1])
        x, y, z = ((cell + offset) & 0xFFFF).astype(np.uint64).T
        h = (x * np.uint64(73856093)) ^ (y * np.uint64(19349663)) ^ (z * np.uint64(83492791))
        h = (h ^ (h >> np.uint64(13))) * np.uint64(0x5BD1E995) & np.uint64(0xFFFFFFFF)
        h = (h ^ (h >> np.uint64(15))) & np.uint64(0xFFFF)
        out += np.where(offset == 1, f, 1 - f).prod(-1) * (h / 65535.0)
    return out


def base_colour(material: Material, points: np.ndarray) -> np.ndarray:
    """(R, 3) the material's colour at points (R, 3)."""
    first, second = (np.array(colour) for colour in material.colours)
    p = points * material.scale
    if material.pattern == "noise":
        share = 0.5 * noise(p) + 0.3 * noise(2.1 * p + 7) + 0.2 * noise(4.3 * p + 3)
        share = np.clip(2.2 * share - 0.6, 0, 1)
    elif material.pattern == "checks":
        share = np.floor(p + 1e-6).sum(-1) % 2
    elif material.pattern == "stripes":
        share = 0.5 + 0.5 * np.sin(2 * np.pi * (p[:, 2] + 0.3 * noise(p)))
    else:
        share = np.zeros(len(p))
    return first + share[:, None] * (second - first)


def radiance(
    shapes: Sequence[Shape], origins: np.ndarray, directions: np.ndarray, bounces: int = 1, light: Direction = SUN
) -> tuple[np.ndarray, np.ndarray]:
    """Linear colour (R, 3) along rays, and whether each meets a shape (R,)."""
    hits, sun = nearest(shapes, origins, directions), np.array(light)
    colour, met = environment(directions, light), hits.shape >= 0
    if not met.any():
        return colour, met
    points, d, owner = (origins + np.where(met, hits.distance, 0)[:, None] * directions)[met], directions[met], hits.shape[met]  # (H, 3), (H, 3), (H,)
    normal, own, strength, exponent, mirror = np.empty_like(points), np.empty_like(points), *np.empty((3, len(points), 1))
    for number in np.unique(owner):
        here, material = owner == number, shapes[number].material
        normal[here], own[here] = shapes[number].normal(points[here]), base_colour(material, points[here])
        (strength[here], exponent[here]), mirror[here] = material.specular, material.mirror
    normal = np.where((normal * d).sum(-1, keepdims=True) > 0, -normal, normal)
    outside = points + 1e-3 * normal
    lit = np.isinf(nearest(shapes, outside, np.broadcast_to(sun, points.shape)).distance)[:, None]
    shaded = own * (lit * np.maximum(normal @ sun, 0)[:, None] * SUN_COLOUR + (0.55 + 0.45 * normal[:, 2:]) * SKY_COLOUR)
    mirrored = d - 2 * (d * normal).sum(-1, keepdims=True) * normal
    shaded += lit * strength * np.maximum(mirrored @ sun, 0)[:, None] ** exponent * SUN_COLOUR
    shiny = np.flatnonzero(mirror[:, 0] > 0)
    if bounces and len(shiny):
        reflected, _ = radiance(shapes, outside[shiny], mirrored[shiny], bounces - 1, light)
        shaded[shiny] += mirror[shiny] * (reflected - shaded[shiny])
    colour[met] = shaded
    return colour, met


def image(shapes: Sequence[Shape], camera: Camera, *, supersample: int = 3, alpha: bool, light: Direction = SUN) -> np.ndarray:
    """(H, W, 3) uint8 sRGB, or (H, W, 4) with straight alpha; the mean over supersample^2 rays of a pixel."""
    width, height, n = camera.width, camera.height, supersample
    colour, cover = np.empty((width * height, 3)), np.empty(width * height)
    inner = (np.arange(n) + 0.5) / n
    step = max(1, RAYS_AT_ONCE // n**2)
    for begin in range(0, width * height, step):
        index = np.arange(begin, min(begin + step, width * height))
        x = (index % width)[:, None, None] + inner[None, None, :]
        y = (index // width)[:, None, None] + inner[None, :, None]
        pixels = np.stack(np.broadcast_arrays(x, y), -1).reshape(-1, 2)
        seen, hit = radiance(shapes, *rays(camera, pixels), light=light)
        weight = hit[:, None] if alpha else np.ones((len(hit), 1))
        total = weight.reshape(len(index), -1).sum(1)
        colour[index] = (seen * weight).reshape(len(index), -1, 3).sum(1) / np.maximum(total, 1)[:, None]
        cover[index] = total / n**2
    out = srgb_from_linear(np.clip(colour, 0, 1))
    if alpha:
        out = np.concatenate([out, cover[:, None]], axis=1)
    return np.round(255 * out).astype(np.uint8).reshape(height, width, -1)
