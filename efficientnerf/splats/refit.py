"""Gaussians fitted to pictures: Adam on means, scales, rotations, opacities and harmonics.

A step takes a picture, or rows of a large one with about PIXELS; the first steps take large pictures at half their size. It minimises the
pseudo-Huber loss of each pixel's squared error, for a picture with alpha over all backgrounds at once, and 1 - SSIM of windows of 4 x 4 pixels,
which begin at another corner in each step. Noise on the means and opacities that fade, after 3DGS-MCMC, keep few photographs from being
overfitted. The order of the pictures, the rows, the corner and the noise are drawn by (seed, step). On the CPU the same pictures give the same
bytes, on any number of threads.
"""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from efficientnerf.backends.dispatch import splats_on
from efficientnerf.backends.layout import SSIM_WINDOW
from efficientnerf.backends.splat_layout import DRAWS, GRADIENTS, LANES, OPACITY, ROTATION, SCALE, TILE, Lens, Picture, Rates, SplatState
from efficientnerf.geometry.cameras import Camera, rows_of
from efficientnerf.rendering.halving import halved
from efficientnerf.splats.gaussians import Gaussians, rotation_matrices
from efficientnerf.splats.rendering import LOG_SCALES, gaussians_from, lens_of, values_of

# docs/experiments/splats.md
MEANS, SCALES, ROTATIONS, OPACITIES, COLOURS, HARMONICS = 0.1, 0.06, 0.02, 0.05, 0.02, 0.004  # learning rates of `fitting.Rates`
# Of photographs that of the harmonics is lower the fewer there are, as that of the asset is: view dependence is overfitted. Share for each, least and most.
HARMONICS_PER_VIEW, LEAST_HARMONICS, MOST_HARMONICS = 1 / 320, 0.25, 0.75
STRUCTURE, HUBER_DELTA = 0.005, 0.08  # of `Picture`
PIXELS = 2**18  # of a step
COARSE_UNTIL, COARSE_PIXELS = 0.3, 2**17  # of the steps: until then, pictures of so many pixels and more are taken at half their size
LAST_RATE = 0.1  # of the learning rates, at the last step
MOMENTUM, DECAY, EPSILON = 0.9, 0.99, 1e-6
NOISE = 0.05  # of `Rates`, at the first step
FADE, MOST_FADE = 9.0, 0.015  # the same, over the number of steps, and at most
LEAST_OPACITY = 0.005  # below which a Gaussian is replaced; 3DGS
FAINT = 0.02  # opacity, below which a Gaussian is left out at the end. docs/experiments/splats.md
SPLIT_AT = (0.25, 0.5)  # of the steps: when Gaussians are divided where the error is, up to the most allowed
# Of so many steps and more: when that is done, and the share, of the most transparent, that is left out for it each time. 3DGS-MCMC relocates dead ones.
MANY_STEPS = 1200
TIMED = 8  # steps after which it is known how many fit into the time allowed
RELOCATE_AT, RELOCATED = (0.08, 0.16, 0.24, 0.32, 0.4, 0.48, 0.56, 0.64), 0.02
SPLIT_APART, SPLIT_SHARE = 0.5, 0.7  # of the longest standard deviation: distance of the halves from the middle, and their own


@dataclass(frozen=True, eq=False)
class View:
    """A picture that Gaussians are fitted to.

    camera  in the asset's frame, of the picture's size
    pixels  (H, W, 3) or (H, W, 4) uint8 sRGB, alpha straight
    mask    (H, W) bool, pixels that count; None: all
    """

    camera: Camera
    pixels: np.ndarray
    mask: np.ndarray | None = None

    def __post_init__(self) -> None:
        size = (self.camera.height, self.camera.width)
        if self.pixels.dtype != np.uint8 or self.pixels.ndim != 3 or self.pixels.shape[:2] != size or self.pixels.shape[2] not in (3, 4):
            found = f"{self.camera.name}: pixels of shape {self.pixels.shape} and type {self.pixels.dtype}"
            raise ValueError(f"{found}; expected {size} and 3 or 4 channels, uint8")
        if self.mask is not None and (self.mask.shape != size or self.mask.dtype != bool):
            raise ValueError(f"{self.camera.name}: a mask of shape {self.mask.shape} and type {self.mask.dtype}; expected {size} bool")


def refitted(
    gaussians: Gaussians, views: Sequence[View], steps: int, *, most: int = 0, background: tuple[float, float, float] | None = None, seed: int = 0,
    reached: Callable[[int], None] | None = None, time_used: Callable[[], float] | None = None, device: str = "cpu",
) -> Gaussians:  # fmt: skip
    """The Gaussians after so many steps, without those that no longer show.

    most        Gaussians up to whose number some are divided on the way; 0: none is
    background  sRGB colour behind pictures without alpha; None: these are opaque
    reached     called after each step, with their number
    device      that computes, "cpu" or "cuda", the latter where its kernels can be built
    time_used   the share of the time allowed that has passed: it ends the steps at 1, and rates and divisions follow it where it is ahead of the steps
    """
    begin, values = splats_on(device).SplatFit, values_of(gaussians)
    fit = begin(values, np.zeros((len(values), GRADIENTS + values.shape[1]), np.float32), gaussians.degree, device)
    used = began = 0.0 if time_used is None else time_used()
    times, relocated = _divisions(steps)
    order: list[int] = []
    harmonics, fade = harmonics_rate(views), _fade(steps)
    for number in range(steps):
        if time_used is not None:
            used = time_used()
            if used >= 1:
                break
            if number == TIMED:
                expected = min(steps, int(TIMED * (1 - began) / max(used - began, 1e-9)))
                (times, relocated), fade = _divisions(expected), _fade(expected)
                times = tuple(share for share in times if share > max(used, number / steps))
        if not order:
            order = np.random.Generator(np.random.Philox(key=seed, counter=[0, 0, 5, number])).permutation(len(views)).tolist()
        due = sum(int(share * steps) <= number or share <= used for share in times)
        times = times[due:]
        if due and number and most:
            fit = begin(*_divided(fit.state(), most, relocated), gaussians.degree, device)
        done = max(number / max(steps - 1, 1), used)
        whole = views[order.pop()]
        if done < COARSE_UNTIL and whole.camera.width * whole.camera.height >= COARSE_PIXELS:
            whole = View(*halved(whole.camera, whole.pixels, whole.mask))
        view = _band(whole, np.random.Generator(np.random.Philox(key=seed, counter=[0, 0, 6, number])))
        corner = np.random.Generator(np.random.Philox(key=seed, counter=[0, 0, 9, number])).integers(SSIM_WINDOW, size=2)
        lens, picture = _moved(lens_of(view.camera, whole.camera), _picture(view, background), *corner.tolist())
        fit.step(lens, picture, rates_of(done, harmonics, fade, seed, number))
        if reached is not None:
            reached(number + 1)
    fitted = gaussians_from(fit.state().rows)
    return fitted.subset(fitted.opacities >= FAINT)


def _fade(steps: int) -> float:
    return min(FADE / max(steps, 1), MOST_FADE)


def _divisions(steps: int) -> tuple[tuple[float, ...], float]:
    """When Gaussians are divided, as shares of so many steps, and the share that is left out for it each time."""
    return (RELOCATE_AT, RELOCATED) if steps >= MANY_STEPS else (SPLIT_AT, 0.0)


def _divided(state: SplatState, most: int, relocated: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Values and moments of the Gaussians without those that hide nothing any more, and without a share `relocated` that hides least; those with the
    greatest part in the errors are split.

    The halves lie along the longest axis, next to each other in memory, and begin without momentum.
    """
    rows, moments, errors = state
    alive = rows[:, OPACITY] > np.log(LEAST_OPACITY / (1 - LEAST_OPACITY))
    alive[np.argsort(rows[:, OPACITY], kind="stable")[: int(relocated * len(rows))]] = False
    copies = alive.astype(np.int64)
    worst = np.argsort(np.where(alive, -errors, 0), kind="stable")[: max(0, most - int(alive.sum()))]
    copies[worst[alive[worst] & (errors[worst] > 0)]] = 2
    index = np.repeat(np.arange(len(rows)), copies)
    halves = copies[index] == 2
    rows, moments = rows[index], moments[index]
    moments[halves] = 0
    first = np.concatenate([[True], np.diff(index) > 0])[halves]
    parts = rows[halves]
    longest = np.argmax(parts[:, SCALE : SCALE + 3], axis=1)
    here = np.arange(len(parts))
    apart = SPLIT_APART * np.exp(parts[here, SCALE + longest]) * np.where(first, 1, -1)
    parts[:, :3] += apart[:, None] * rotation_matrices(parts[:, ROTATION:OPACITY])[here, :, longest]
    parts[here, SCALE + longest] += np.log(SPLIT_SHARE)
    rows[halves] = parts
    return rows, moments


def _band(view: View, rng: np.random.Generator) -> View:
    """The view, or rows of it that have about PIXELS: those around a row that is drawn."""
    height = max(TILE, round(PIXELS / view.camera.width / TILE) * TILE)
    if height >= view.camera.height:
        return view
    begin = int(np.clip(rng.integers(view.camera.height) - height // 2, 0, view.camera.height - height))
    rows = slice(begin, begin + height)
    return View(rows_of(view.camera, rows.start, rows.stop), view.pixels[rows], None if view.mask is None else view.mask[rows])


def _picture(view: View, background: tuple[float, float, float] | None) -> Picture:
    """A view for the kernels."""
    pixels = view.pixels
    over_all = pixels.shape[2] == 4 or background is None
    if pixels.shape[2] == 3:
        pixels = np.concatenate([pixels, np.full((*pixels.shape[:2], 1), 255, np.uint8)], axis=2)
    mask = np.ones(pixels.shape[:2], np.uint8) if view.mask is None else np.ascontiguousarray(view.mask).view(np.uint8)
    behind = np.asarray(background or (0, 0, 0), np.float32)
    return Picture(np.ascontiguousarray(pixels), mask, over_all, behind, np.float32(STRUCTURE), np.float32(HUBER_DELTA))


def _moved(lens: Lens, picture: Picture, right: int, down: int) -> tuple[Lens, Picture]:
    """With so many more columns and rows before the first, which do not count."""
    numbers = lens.numbers.copy()
    numbers[2:4] += right, down
    margin = (down, 0), (right, 0)
    moved = picture._replace(pixels=np.pad(picture.pixels, (*margin, (0, 0))), mask=np.pad(picture.mask, margin))
    return lens._replace(numbers=numbers, width=lens.width + right, height=lens.height + down), moved


def harmonics_rate(views: Sequence[View]) -> float:
    """The learning rate of the view-dependent harmonics at the first step. Pictures with alpha are of an object whose cameras all see it."""
    if any(view.pixels.shape[2] == 4 for view in views):
        return HARMONICS
    return HARMONICS * min(max(HARMONICS_PER_VIEW * len(views), LEAST_HARMONICS), MOST_HARMONICS)


def rates_of(done: float, harmonics: float, fade: float = MOST_FADE, seed: int = 0, number: int = 0) -> Rates:
    """The rates of a step, with its number, when so much, 0 to 1, of the steps is done; harmonics and fade: of the first step."""
    fall = LAST_RATE**done
    rates = np.asarray([MEANS, SCALES, ROTATIONS, OPACITIES, COLOURS, harmonics], np.float32) * np.float32(fall)
    shift = int(np.random.Generator(np.random.Philox(key=seed, counter=[0, 0, 7, number])).integers(DRAWS))
    return Rates(
        rates, np.float32(MOMENTUM), np.float32(DECAY), np.float32(EPSILON), _corrections(MOMENTUM), _corrections(DECAY), np.float32(fade * fall),
        np.float32(NOISE * fall), _draws(seed), shift, *map(np.float32, LOG_SCALES),
    )  # fmt: skip


@functools.lru_cache(maxsize=1)
def _draws(seed: int) -> np.ndarray:
    """`Rates.draws`: the first come again at the end."""
    drawn = np.random.Generator(np.random.Philox(key=seed, counter=[0, 0, 8, 0])).standard_normal(DRAWS, np.float32)
    return np.concatenate([drawn, drawn[: 3 * LANES]])


def _corrections(decay: float) -> np.ndarray:
    """1 / (1 - decay^n) for n = 1, 2, ... until it is 1."""
    most = int(np.ceil(np.log(1e-8) / np.log(decay)))
    return np.asarray(1 / (1 - decay ** np.arange(1, most + 1)), np.float32)
