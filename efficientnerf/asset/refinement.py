"""From a raw tree to one that looks like the training images: its values descend on the error of its own pictures.

The structure of the tree stays; what is fitted is the optical thickness of each voxel (by its logarithm, so that it stays positive and matter that
nobody needs fades away) and its harmonics. The loss of a ray is that of `RayTargets`: photographs are compared through what the network puts
before and behind the box; objects that were cut out are compared over every background at once.

Every random choice of step n is drawn from a generator seeded by (seed, n), as in training; the kernels sum in a fixed order. So the same
steps give the same bytes, on any number of threads and whether or not they were interrupted. On CUDA (`efficientnerf.asset.refinement_device`, for
targets that were sent there) pixels and rules are the same, sums do not depend on their order, and values differ by rounding.

PlenOctrees (Yu et al. 2021, section 4.3) and Plenoxels (Fridovich-Keil et al. 2022) optimise trees and grids this way. N voxels, K harmonics,
R rays, P pixels.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from efficientnerf.asset.tree import NerfTree
from efficientnerf.backends.numba.tree import gradients
from efficientnerf.backends.numba.tree.gradients import RayTargets, SampleRecords, TreeGrid
from efficientnerf.rendering.harmonics import basis_numpy
from efficientnerf.training.pixels import Pixels

if TYPE_CHECKING:
    from efficientnerf.training.device_pixels import DevicePixels

DECAY, EPSILON = 0.99, 1e-10
OPAQUE = 2.0  # optical thickness of a voxel to begin with at most: networks say hundreds, behind which nothing would have a gradient
GREY, MATTE = 0.5, 0.25  # mean of a channel of a background of any colour, and three times the variance: see `Targets`
WEIGHED_RAYS, MEASURED_RAYS = 2**16, 2**14  # in a bundle; those that are measured leave records

Bundle = tuple[Any, Any, RayTargets]  # see `Targets.draw`


@dataclass(frozen=True)
class Targets:
    """Training pixels, and what the tree is seen through and against.

    pixels      of the training views
    background  constant sRGB colour behind the scene, or None: photographs with surroundings, and the next three say what they are
    chosen      (P,) indices of pixels that may be drawn
    before      (P, 4) premultiplied colour and opacity of what lies between the camera and the box
    behind      (P, 3) colour of what lies beyond the box
    infinite    whether the tree holds all that the photographs show, out to infinity; on a background that then is only where it fails to

    Where the photographs have alpha the object was cut out, and anything may lie behind it; behind what reaches to infinity nothing lies, and it
    should be opaque whatever there were. With a background of random colour, each channel even over 0 to 1, the expected error is that over grey plus
    the channels' summed variance, 3 / 12, times the squared error of the opacity: taken as it is, without the noise of drawing colours.
    """

    pixels: Pixels | DevicePixels
    background: tuple[float, float, float] | None
    chosen: np.ndarray | None = None
    before: Any = None
    behind: Any = None
    infinite: bool = False

    def __post_init__(self) -> None:
        if self.background is None and (self.chosen is None or self.before is None or self.behind is None):
            raise ValueError("photographs with surroundings: the targets need to know what lies before and behind the box")

    @property
    def on_device(self) -> bool:
        """Whether they were sent to a device, where trees are fitted to them then."""
        return not isinstance(self.pixels, Pixels)

    def to(self, device: str) -> Targets:
        """These targets on "cpu" or "cuda", the latter where its kernels can be built."""
        from efficientnerf.backends import dispatch

        if device == "cpu" or not dispatch.triton_usable():
            return self
        from efficientnerf.asset.refinement_device import sent_targets

        return sent_targets(self, device)

    def draw(self, count: int, rng: np.random.Generator, *, declared: bool = False) -> tuple[Any, Any, RayTargets]:
        """Origins (R, 3) and unit directions (R, 3) of `count` random pixels, world frame, and what they should show; arrays, or tensors of the device.

        declared  objects are seen on the background of the scene alone
        """
        if self.chosen is None:
            return self.of(self.pixels.choose(count, rng), None, declared=declared)
        at = rng.integers(len(self.chosen), size=count)
        return self.of(self.chosen[at], at, declared=declared)

    def of(self, index: np.ndarray, at: np.ndarray | None, *, declared: bool = False) -> tuple[Any, Any, RayTargets]:
        """`draw` for pixels `index`; `at` are their places in `chosen`."""
        bundle: tuple[Any, ...] = self.pixels.bundle(index)
        origins, directions, _, _, colour = bundle
        ones = colour[:, 0] * 0 + 1
        truth = colour[:, :3]
        if self.background is None:
            assert at is not None
            before, behind = self._rows(self.before, at), self._rows(self.behind, at)
            return origins, directions, RayTargets(truth - before[:, :3], behind, 1 - before[:, 3], ones, 0.0)
        matted = colour.shape[1] == 4
        anything = (matted or self.infinite) and not declared
        behind = colour[:, :3] * 0
        ground = (GREY,) * 3 if anything else self.background
        for channel, value in enumerate(ground):
            behind[:, channel] += value
        opacity = ones
        if matted:
            opacity = colour[:, 3] * 1
            truth = truth * opacity[:, None] + behind * (1 - opacity[:, None])
        return origins, directions, RayTargets(truth * 1, behind, ones, opacity, MATTE if anything else 0.0)

    def _rows(self, part: Any, at: np.ndarray) -> Any:
        """Rows `at` of an array, or of a tensor on the pixels' device, in float32."""
        if isinstance(self.pixels, Pixels):
            return part[at].astype(np.float32)
        return part[self.pixels.to_device(at)].float()


@dataclass
class Optimiser:
    """A tree whose values are being fitted, in place: harmonics are most of the memory, and are there once.

    square_*  (N,) running means of the squared gradients by the logarithm of a voxel's optical thickness, and by its harmonics
    visits    (N,) in how many steps a voxel was seen
    away      the state on a device that steps are being taken on; `fetch` brings the arrays up to date
    """

    tree: NerfTree
    square_density: np.ndarray
    square_sh: np.ndarray
    visits: np.ndarray
    step: int = 0
    away: Any = None  # a DeviceFit

    def fetch(self) -> None:
        """Have the arrays as they are after the last step."""
        if self.away is not None:
            found = self.away.to_host_async()
            self.tree = replace(self.tree, density_values=found["density"], harmonics=found["sh"].reshape(self.tree.sh.shape))
            for name in SQUARES:
                setattr(self, name, found[name])

    def leave(self) -> None:
        """Have the arrays as they are after the last step, and nothing on a device any more: what comes next needs the room there."""
        self.fetch()
        self.away = None

    @property
    def density(self) -> np.ndarray:
        """(N,) float32, the tree's own."""
        return self.tree.density_values

    @property
    def sh(self) -> np.ndarray:
        """(N, 3 K) float32, the tree's own."""
        return self.tree.sh.reshape(len(self.tree.sh), self.tree.harmonics_count * 3)

    def result(self) -> NerfTree:
        """The tree as it is now."""
        self.fetch()
        return replace(self.tree, density_values=self.density.copy(), harmonics=self.tree.sh.copy())


SQUARES = ("square_density", "square_sh", "visits")
STATE = ("density", "sh", *SQUARES)


def optimiser(tree: NerfTree, thickest: float = np.inf) -> Optimiser:
    """At the beginning, of a copy; no voxel of more optical thickness than `thickest`, so that what lies behind a floater pulls at it from the first
    step on."""
    density = np.minimum(tree.density_values, np.float32(thickest / tree.voxel))
    tree = replace(tree, density_values=density, harmonics=np.array(tree.sh, np.float32))
    return Optimiser(tree, np.zeros_like(density), np.zeros_like(density), np.zeros(len(density), np.int32))


def kept(o: Optimiser, keep: np.ndarray, tree: NerfTree) -> Optimiser:
    """The optimiser that goes on with `tree`, which is `o.tree` after `leave` with some of its voxels alone, (N,) bool, in their order."""
    return Optimiser(tree, **{name: getattr(o, name)[keep] for name in SQUARES}, step=o.step)


def grid_of(tree: NerfTree) -> TreeGrid:
    return TreeGrid(tree.brick, tree.brick_index, tree.voxel_index, tree.leap, gradients.STEP * tree.voxel, tree.lookup == "nearest")


def in_voxels(tree: NerfTree, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rays of the world in voxel coordinates, and the harmonics along them (R, K)."""
    rays = tree.frame.rays(np.asarray(origins, np.float64), np.asarray(directions, np.float64))
    start = np.ascontiguousarray((rays.origins - tree.bounds_min) / tree.voxel)
    bases = np.ascontiguousarray(basis_numpy(np.asarray(directions, np.float32), tree.degree))
    return start, np.ascontiguousarray(rays.directions, np.float64), bases


def optimise(
    o: Optimiser,
    targets: Targets,
    *,
    until: int,
    steps: int,
    rays: int,
    density_rate: float,
    colour_rate: float,
    final: float,
    seed: int,
    view_share: float = 1.0,
) -> Iterator[float]:
    """Go on to step `until`, yielding the mean squared error of a channel after each step; on a device, that of some steps before.

    steps         in all; the rates fall exponentially, to `final` of themselves at the last of them
    rays          in a step
    density_rate  for the logarithm of the optical thickness
    colour_rate   for the harmonics
    view_share    of that rate, for harmonics of degree 1 and above: what depends on the direction
    """
    if targets.on_device:
        from efficientnerf.asset import refinement_device

        yield from refinement_device.optimise(
            o, targets, until=until, steps=steps, rays=rays, density_rate=density_rate, colour_rate=colour_rate, final=final, seed=seed,
            view_share=view_share,
        )  # fmt: skip
        return
    grid, records = grid_of(o.tree), SampleRecords()
    by_density, by_sh = np.zeros_like(o.density), np.zeros_like(o.sh)
    stamp = np.zeros(len(o.density), np.int32)
    rates = np.full(o.sh.shape[1], colour_rate, np.float32)
    rates[3:] *= view_share
    while o.step < until:
        number = o.step + 1
        origins, directions, seen = targets.draw(rays, randomness(seed, number))
        start, along, bases = in_voxels(o.tree, origins, directions)
        loss, counts = gradients.forward_backward(grid, start, along, bases, o.density, o.sh, seen, records)
        fall = final ** (number / steps)
        gradients.rmsprop_step(
            records, counts, bases, (o.density, o.sh), (by_density, by_sh), (o.square_density, o.square_sh), o.visits, stamp,
            number=number, thickness=o.tree.voxel, density_rate=density_rate * fall, sh_rates=rates * np.float32(fall), decay=DECAY, epsilon=EPSILON,
        )  # fmt: skip
        o.step = number
        yield float(loss.mean()) / 3


def randomness(seed: int, step: int) -> np.random.Generator:
    """What a step's pixels are chosen by."""
    return np.random.Generator(np.random.Philox(key=seed, counter=[0, 0, 2, step]))


def error(tree: NerfTree, targets: Targets, count: int, seed: int) -> float:
    """Mean squared error of a channel over a sample of the training pixels that depends on `count` and `seed` alone, objects on their declared background."""
    rng = np.random.Generator(np.random.Philox(key=seed, counter=[0, 0, 3, 0]))
    bundles = (targets.draw(min(MEASURED_RAYS, count - begin), rng, declared=True) for begin in range(0, count, MEASURED_RAYS))
    if targets.on_device:
        from efficientnerf.asset import refinement_device

        return refinement_device.total_loss(tree, targets, bundles) / (3 * count)
    grid, records, sh = grid_of(tree), SampleRecords(), tree.sh.reshape(len(tree.sh), tree.harmonics_count * 3)
    total = 0.0
    for origins, directions, seen in bundles:
        loss, _ = gradients.forward_backward(grid, *in_voxels(tree, origins, directions), tree.density_values, sh, seen, records)
        total += float(loss.sum())
    return total / (3 * count)


def greatest_weights(tree: NerfTree, targets: Targets, count: int, seed: int, looked: Callable[[int, int], None] | None = None) -> np.ndarray:
    """(N,) how much each voxel contributes at most to one of `count` random training pixels, through what interpolation leaves it.

    looked  called with pixels looked at and their number
    """
    rng = np.random.Generator(np.random.Philox(key=seed, counter=[0, 0, 4, 0]))
    bundles = reported((targets.draw(min(WEIGHED_RAYS, count - begin), rng) for begin in range(0, count, WEIGHED_RAYS)), count, looked)
    if targets.on_device:
        from efficientnerf.asset import refinement_device

        return refinement_device.greatest_weights(tree, targets, bundles)
    grid, greatest = grid_of(tree), np.zeros((gradients.contribution_parts(), len(tree.density_values)), np.float32)
    for origins, directions, seen in bundles:
        start, along, _ = in_voxels(tree, origins, directions)
        gradients.max_contributions(grid, start, along, tree.density_values, seen.transmittance, greatest)
    return greatest.max(axis=0)


def reported(bundles: Iterator[Bundle], count: int, looked: Callable[[int, int], None] | None) -> Iterator[Bundle]:
    """The bundles; after each `looked` is told how many rays there have been, of `count`."""
    done = 0
    for bundle in bundles:
        yield bundle
        done += len(bundle[0])
        if looked is not None:
            looked(done, count)
