"""A whole scene of nested grids for measurements: a table with round things in a room with windows, hills outside, and a sky.

Surfaces are shells of voxels about three thick, as baked ones are; colours are textured, with harmonics of degree 2 in palettes, as files of the layout
`compact` load.
"""

from typing import Any

import numpy as np

HALF = 1.0  # half side of the innermost box
ROOM = np.array([3.3, 3.0, 2.4])  # half sides
ENTRIES, GROUPS = 256, (3, 5)


def _things(count: int = 40) -> np.ndarray:
    """(count, 4) centres and radii of balls on the table, which is the disc z = -0.5."""
    rng = np.random.default_rng(3)
    radius = rng.uniform(0.05, 0.22, count)
    return np.concatenate([rng.uniform(-0.7, 0.7, (count, 2)), (radius - 0.5)[:, None], radius[:, None]], axis=1).astype(np.float32)


def distance(p: np.ndarray) -> np.ndarray:
    """Signed distance, about, of points (..., 3) float32 to the scene's surfaces."""
    x, y, z = p[..., 0], p[..., 1], p[..., 2]
    out = np.maximum(np.hypot(x, y) - 0.85, np.abs(z + 0.53) - 0.03)
    for cx, cy, cz, radius in _things():
        out = np.minimum(out, np.sqrt((x - cx) ** 2 + (y - cy) ** 2 + (z - cz) ** 2) - radius)
    out = np.minimum(out, np.maximum(np.hypot(x, y) - 0.1, np.maximum(z + 0.5, -z - ROOM[2])))
    walls = np.minimum(np.minimum(ROOM[0] - np.abs(x), ROOM[1] - np.abs(y)), ROOM[2] - np.abs(z))
    room = np.maximum(walls, -0.15 - walls)
    windows = np.maximum(np.abs(z - 0.3) - 1.0, np.minimum(np.abs(np.abs(y) - 1.4), np.abs(np.abs(x) - 1.4)) - 0.7)
    for cx, cy in ((2.4, 1.8), (-2.5, 1.5), (1.9, -2.2), (-2.0, -2.1)):  # furniture
        out = np.minimum(out, np.maximum(np.maximum(np.abs(x - cx), np.abs(y - cy)) - 0.5, np.abs(z + 1.6) - 0.8))
    out = np.minimum(out, np.maximum(room, -windows))
    return np.minimum(out, z + 3.0 - 0.8 * np.sin(0.5 * x) * np.cos(0.4 * y)).astype(np.float32)


def _shell(shape: tuple[int, int, int], voxel: float, low: np.ndarray, inner: np.ndarray | None, brick: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Voxels (N, 3) of a grid near surfaces, their densities, and their centres; none farther than two voxels inside of a box (2, 3)."""
    size, found = np.asarray(shape) * brick, []
    y, z = np.meshgrid(*(low[n] + (np.arange(size[n]) + 0.5) * voxel for n in (1, 2)), indexing="ij")
    for i in range(size[0]):
        p = np.stack([np.full_like(y, low[0] + (i + 0.5) * voxel), y, z], axis=-1).astype(np.float32)
        d = distance(p) / voxel
        keep = np.abs(d) < 1.5
        if inner is not None:
            keep &= ~((p > inner[0] + 2 * voxel) & (p < inner[1] - 2 * voxel)).all(axis=-1)
        at = np.argwhere(keep)
        found.append((np.concatenate([np.full((len(at), 1), i), at], axis=1), d[keep], p[keep]))
    index, d, p = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return index, (np.clip(1.5 - d, 0, 2.5) ** 2 * 0.8 / voxel).astype(np.float32), p


def _bands(p: np.ndarray, rng: np.random.Generator, count: int) -> np.ndarray:
    """(N, count) smooth functions of points, -1 to 1."""
    return np.sin(p @ rng.normal(size=(3, count)).astype(np.float32) * 6 + rng.uniform(0, 6, count).astype(np.float32))


def whole_scene(side: int = 320, count: int = 5, brick: int = 4) -> Any:
    """A tree of `count` cascades of `side` voxels along each axis."""
    from efficientnerf.asset.cascades import cascade_grids, check_cascades
    from efficientnerf.asset.palettes import PaletteHarmonics
    from efficientnerf.asset.tree import Cascade, NerfTree, tree_from_voxels

    grids = cascade_grids(np.array([[-HALF] * 3, [HALF] * 3]), 2 * HALF / side, brick, count)
    trees, inner = [], None
    for shape, voxel, low in grids:
        index, density, p = _shell(shape, voxel, low, inner, brick)
        tree = tree_from_voxels(shape, voxel, low, index, density, np.concatenate([p[:, None], 0 * p[:, None], 0 * p[:, None], 0 * p[:, None]], 1), brick=brick)
        trees.append(tree)
        inner = np.stack([low, low + np.asarray(shape) * brick * voxel])
    places = np.concatenate([tree.sh[:, 0] for tree in trees])
    rng = np.random.default_rng(5)
    base = np.clip(128 + 90 * _bands(places, rng, 3) + rng.normal(0, 4, (len(places), 3)), 0, 255).astype(np.uint8)
    codes = np.clip((_bands(places, rng, len(GROUPS)) + rng.normal(0, 0.05, (len(places), len(GROUPS))) + 1) * ENTRIES / 2, 0, ENTRIES - 1).astype(np.uint8)
    palette = np.cumsum(rng.normal(size=(ENTRIES, sum(GROUPS), 3)), axis=0)  # entries beside each other are alike
    palette = (0.3 * (palette - palette.mean(axis=0)) / palette.std(axis=0)).astype(np.float32)
    table = np.linspace(-5, 5, 256, dtype=np.float32)[:, None].repeat(3, axis=1)
    bricks = voxels = 0
    cascades, rows = [], []
    for tree in trees:
        cascades.append(Cascade(tree.shape, tree.voxel, tree.bounds_min, np.where(tree.brick_index >= 0, tree.brick_index + bricks, -1).astype(np.int32)))
        rows.append(np.where(tree.voxel_index >= 0, tree.voxel_index + voxels, -1).astype(np.int32))
        bricks, voxels = bricks + len(tree.voxel_index), voxels + len(tree.density_values)
    up = np.cos((np.arange(64) + 0.5) / 64 * np.pi)[:, None, None].repeat(128, axis=1)  # of the texels' directions, along z
    whole = NerfTree(
        shape=cascades[0].shape, brick=brick, voxel=cascades[0].voxel, bounds_min=cascades[0].bounds_min, brick_index=cascades[0].brick_index,
        voxel_index=np.concatenate(rows), density_values=np.concatenate([tree.density_values for tree in trees]),
        harmonics=PaletteHarmonics(base, table, codes, palette, GROUPS), outer=tuple(cascades[1:]),
        environment=(np.array([0.4, 0.6, 0.9]) + 0.3 * up * np.array([-1, -1, 0.3])).clip(0, 1).astype(np.float32),
    )  # fmt: skip
    check_cascades(whole)
    return whole


def cameras(width: int, height: int, count: int, fov: float = 50.0) -> list[Any]:
    """`count` cameras round the table, inside of the room."""
    from efficientnerf.geometry.cameras import Camera

    focal, out = height / 2 / np.tan(np.radians(fov) / 2), []
    for n in range(count):
        azimuth, elevation, reach = 2 * np.pi * n / count, 0.35 + 0.2 * np.sin(n), 2.1
        back = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
        right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        pose = np.eye(4)
        pose[:3, 0], pose[:3, 1], pose[:3, 2], pose[:3, 3] = right, -np.cross(back, right), -back, reach * back + [0, 0, -0.4]
        out.append(Camera(f"v{n:02}", width, height, "SIMPLE_PINHOLE", (focal, width / 2, height / 2), pose))
    return out
