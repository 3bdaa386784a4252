"""NerfTree: coarse dense voxels over sparse bricks (EfficientNeRF, section 3.5), in memory.

Plain data: files are read and written by `efficientnerf.asset.format`, points looked up by `efficientnerf.asset.queries`, images rendered by
`efficientnerf.asset.rendering`.

The grid has shape * brick voxels a side, cubic, of `voxel` world units. A coarse cell is either empty, and then space in it has no
density whatever its neighbours hold, or it owns a brick of brick^3 voxels, of which the visible ones are stored.
Values sit at voxel centres and are interpolated linearly between the stored ones, or hold throughout their voxels (`lookup`).

The grid lies in the tree's *frame*: the world, or the normalised device coordinates of a reference camera (`efficientnerf.geometry.ndc`) where the scene is
forward-facing. Arguments and results of those functions are of the world, densities apart, which are per unit of the frame.

B bricks, N stored voxels, K harmonics, R rays.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from efficientnerf.asset.palettes import PaletteHarmonics
from efficientnerf.backends.numba.tree.leaps import leaps
from efficientnerf.geometry.ndc import WORLD, Frame, Ndc
from efficientnerf.rendering.harmonics import harmonics_count

LOOKUPS = ("trilinear", "nearest")
STEP_SIZE, MIN_STEP, MAX_STEP = 0.5, 0.25, 1.0  # voxels: where nothing else is stated, and what may be


@dataclass(frozen=True, eq=False)
class Cascade:
    """A grid of a tree, in the tree's frame."""

    shape: tuple[int, int, int]  # coarse cells along x, y, z
    voxel: float  # side of a voxel
    bounds_min: np.ndarray  # (3,) float64 corner
    brick_index: np.ndarray  # shape int32: rows of the tree's `voxel_index`, -1 where a cell is empty

    def bounds(self, brick: int) -> np.ndarray:
        """(2, 3) corners, for so many voxels along a coarse cell."""
        return np.stack([self.bounds_min, self.bounds_min + np.asarray(self.shape) * brick * self.voxel])

    @property
    def leap(self) -> np.ndarray:
        """As `NerfTree.leap`."""
        return leaps(self.brick_index >= 0)


@dataclass(frozen=True, eq=False)
class Region:
    """The foreground region, in the tree's frame, z up."""

    bounds: np.ndarray  # (2, 3) least and greatest corner
    corner_radius: float = 0.0  # of the four vertical edges: 0 is a box, half of the shorter side a disc in plan
    fade: float = 0.0  # width of the band inside of its sides in which opacity fades to nothing
    bricks: np.ndarray | None = None  # (B,) bool, the bricks that belong to it; None: all


@dataclass(frozen=True, eq=False)
class NerfTree:
    """The baked asset.

    shape        coarse cells along x, y, z
    brick        voxels along a side of a coarse cell (the paper's D_f)
    voxel        side of a voxel, units of the frame
    bounds_min   (3,) float64, corner of the grid, in the frame
    brick_index  shape int32: which brick a coarse cell owns, -1 where it is empty
    voxel_index  (B, brick^3) int32: which stored voxel, -1 where none (x slowest, z fastest)
    density_values  (N,) float32, per unit of the frame, >= 0
    harmonics    what the voxels' colours are made of, one of two:
                 (N, K, 3) float32, or PaletteHarmonics: codes into palettes, as files of the layout `compact` load
    background   constant sRGB background of the training images, or None
    device       where it is rendered, see `to`; not part of the asset
    ndc          the reference camera whose normalised device coordinates are the frame, or None: the frame is the world
    lookup       value of a point: "trilinear", from the eight voxels around it; or "nearest", the values of the voxel that holds it, nothing
                 where that one is not stored (EfficientNeRF, section 4.1, has the field trained on such coordinates)
    step_size    distance between the samples of a ray, voxels: 0.25 to 1
    outer        the cascades around this grid, which is cascade 0, where the scene is unbounded (`efficientnerf.asset.cascades`). The arrays of bricks
                 and voxels are those of all cascades, one after the other
    environment  (H, 2 H, 3) float32 sRGB colours by direction of what lies beyond all cascades (`efficientnerf.rendering.environment`), or None
    region       the foreground region, or None: all is foreground (`efficientnerf.asset.region`)
    derived      renderers' caches of the arrays, by name; made when first rendered, so that arrays changed in place later are not seen

    `sh` has the harmonics as plain floats; decoding a palette takes 12 K bytes a voxel and is cached. Renderers read `harmonics` instead.
    """

    shape: tuple[int, int, int]
    brick: int
    voxel: float
    bounds_min: np.ndarray
    brick_index: np.ndarray
    voxel_index: np.ndarray
    density_values: np.ndarray
    harmonics: np.ndarray | PaletteHarmonics
    background: tuple[float, float, float] | None = None
    metadata: dict[str, Any] = field(default_factory=dict)
    device: str = "cpu"
    ndc: Ndc | None = None
    lookup: str = "trilinear"
    step_size: float = STEP_SIZE
    outer: tuple[Cascade, ...] = ()
    environment: np.ndarray | None = None
    region: Region | None = None
    derived: dict[str, Any] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        if self.lookup not in LOOKUPS:
            raise ValueError(f"lookup {self.lookup!r}; expected one of {', '.join(LOOKUPS)}")
        if not MIN_STEP <= self.step_size <= MAX_STEP:
            raise ValueError(f"step size {self.step_size!r}; expected {MIN_STEP} to {MAX_STEP}")

    @cached_property
    def sh(self) -> np.ndarray:
        """Coefficients (N, K, 3) float32; decoded, once, where `harmonics` are codes."""
        return self.harmonics.decoded() if isinstance(self.harmonics, PaletteHarmonics) else self.harmonics

    def coefficients(self, voxels: np.ndarray | slice) -> np.ndarray:
        """Coefficients (n, K, 3) float32 of some voxels; unlike `sh`, nothing is kept."""
        return self.harmonics.decoded(voxels) if isinstance(self.harmonics, PaletteHarmonics) else self.harmonics[voxels]

    @property
    def harmonics_count(self) -> int:
        """K."""
        return self.harmonics.count if isinstance(self.harmonics, PaletteHarmonics) else self.harmonics.shape[1]

    @property
    def degree(self) -> int:
        """Degree of the spherical harmonics."""
        return round(self.harmonics_count**0.5) - 1

    @property
    def resolution(self) -> tuple[int, int, int]:
        """Voxels along x, y, z."""
        x, y, z = self.shape
        return x * self.brick, y * self.brick, z * self.brick

    @property
    def bounds_max(self) -> np.ndarray:
        return self.bounds_min + np.asarray(self.resolution) * self.voxel

    @cached_property
    def leap(self) -> np.ndarray:
        """Coarse cells that a ray in an empty cell may leap: shape uint8, 0 in occupied cells.

        The chessboard distance to the nearest occupied cell: a cube of that radius minus one around the cell is empty.
        """
        return leaps(self.brick_index >= 0)

    def to(self, device: str) -> NerfTree:
        """The same tree, rendered on "cpu" or "cuda", the latter where its kernels can be built; points are looked up on the CPU."""
        return replace(self, device=device)

    @property
    def frame(self) -> Frame:
        """Where the grid lies. `frame.rays` takes world rays to it: with these `(origins - bounds_min) / voxel` are voxel coordinates; a step of
        one voxel is `voxel` units of the frame, which densities are per; harmonics are looked up along the directions of the world."""
        return WORLD if self.ndc is None else self.ndc

    def with_metadata(self, **entries: Any) -> NerfTree:
        return replace(self, metadata={**self.metadata, **entries})


def tree_from_voxels(
    shape: tuple[int, int, int],
    voxel: float,
    bounds_min: np.ndarray,
    indices: np.ndarray,
    density: np.ndarray,
    sh: np.ndarray,
    *,
    brick: int = 4,
    background: tuple[float, float, float] | None = None,
    metadata: dict[str, Any] | None = None,
    ndc: Ndc | None = None,
    lookup: str = "trilinear",
    step_size: float = STEP_SIZE,
) -> NerfTree:
    """Build a tree from a list of voxels.

    indices  (N, 3) integer voxel coordinates, each once, inside shape * brick
    density  (N,)   per world unit
    sh       (N, K, 3)

    Voxels are stored brick by brick in the order of the coarse cells (x slowest), inside a brick likewise: the order is part of the format.
    """
    indices = np.asarray(indices, np.int64)
    cells = np.asarray(shape, np.int64)
    if len(indices) and ((indices < 0).any() or (indices >= cells * brick).any()):
        raise ValueError(f"voxel coordinates outside of the grid of {tuple(cells * brick)} voxels")
    harmonics_count(round(sh.shape[1] ** 0.5) - 1)
    cell = indices // brick
    local = indices - cell * brick
    cell_flat = (cell[:, 0] * cells[1] + cell[:, 1]) * cells[2] + cell[:, 2]
    local_flat = (local[:, 0] * brick + local[:, 1]) * brick + local[:, 2]
    key = cell_flat * brick**3 + local_flat
    order = np.argsort(key, kind="stable")
    if len(key) > 1 and (np.diff(key[order]) == 0).any():
        raise ValueError("a voxel is listed twice")
    occupied, brick_of = np.unique(cell_flat[order], return_inverse=True)
    brick_index = np.full(int(cells.prod()), -1, np.int32)
    brick_index[occupied] = np.arange(len(occupied), dtype=np.int32)
    voxel_index = np.full((len(occupied), brick**3), -1, np.int32)
    voxel_index[brick_of, local_flat[order]] = np.arange(len(order), dtype=np.int32)
    x, y, z = (int(c) for c in cells)
    return NerfTree(
        shape=(x, y, z),
        brick=brick,
        voxel=float(voxel),
        bounds_min=np.asarray(bounds_min, np.float64),
        brick_index=brick_index.reshape(x, y, z),
        voxel_index=voxel_index,
        density_values=np.ascontiguousarray(density[order], np.float32),
        harmonics=np.ascontiguousarray(sh[order], np.float32),
        background=background,
        metadata=dict(metadata or {}),
        ndc=ndc,
        lookup=lookup,
        step_size=step_size,
    )
