"""Whether the photographs of a scene differ in exposure, and what their learning begins with."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from efficientnerf.geometry.cameras import project
from efficientnerf.rendering.colour import linear_from_srgb
from efficientnerf.training.exposure.fit import ExposureFit, fit_exposure
from efficientnerf.training.exposure.model import SCALE, VIGNETTING, Exposure, camera_numbers, exposure_of, squared_radius
from efficientnerf.training.pixels import Pixels
from stages.io import scene
from stages.io.scene import Scene, views_of

MOST_OBSERVATIONS = 2**18  # of sparse points that exposures are compared by
DARKEST, BRIGHTEST = 8, 247  # levels between which a colour tells of exposure
LEAST_STOPS, LEAST_EXPLAINED = 0.1, 0.3  # from which photographs differ. docs/experiments/exposure.md
BORDER = 1  # pixels round that of an observation whose mean is taken


def observed_light(folder: Path, s: Scene, pixels: Pixels) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Sparse points in the training photographs: logarithms of linear light (O, 3), the point (O,), the photograph (O,), and r^2 (O,) in it."""
    xyz, counts, observers = scene.read_observations(folder)
    in_training = np.array([view.split == "train" for view in s.views])
    number = np.cumsum(in_training) - 1
    point = np.repeat(np.arange(len(counts)), counts)
    used = in_training[observers]
    seen = np.bincount(point[used], minlength=len(counts))
    used &= seen[point] >= 2
    point, view = point[used], number[observers[used]]
    if len(point) > MOST_OBSERVATIONS:
        kept = np.random.Generator(np.random.Philox(0)).permutation(len(counts)) < len(counts) * MOST_OBSERVATIONS / len(point)
        point, view = point[kept[point]], view[kept[point]]
    found = []
    for n, each in enumerate(scene.views_of(s, "train")):
        mine = np.flatnonzero(view == n)
        at = project(each.camera, xyz[point[mine]])[0] if len(mine) else np.empty((0, 2))
        x, y = np.floor(np.nan_to_num(at, nan=-9, posinf=-9, neginf=-9).clip(-9, 2**20)).astype(np.int64).T
        inside = (x >= BORDER) & (y >= BORDER) & (x < each.camera.width - BORDER) & (y < each.camera.height - BORDER)
        mine, x, y = mine[inside], x[inside], y[inside]
        steps = [(i, j) for j in range(-BORDER, BORDER + 1) for i in range(-BORDER, BORDER + 1)]
        index = pixels.offsets[n] + np.stack([(y + j) * each.camera.width + x + i for i, j in steps])  # (9, N)
        colour = pixels.images[index.ravel()][:, :3].reshape(len(steps), -1, 3)
        light = linear_from_srgb(colour.astype(np.float64) / 255).mean(axis=0)
        tells = (colour.max(axis=(0, 2)) <= BRIGHTEST) & (colour.mean(axis=0).min(axis=1) >= DARKEST)
        tells &= pixels.usable_at(index.ravel()).reshape(index.shape).all(axis=0)
        radius = squared_radius(x, y, each.camera.width, each.camera.height)
        found.append((np.log(light[tells]), point[mine[tells]], np.full(int(tells.sum()), n), radius[tells]))
    light, point, view, radius = (np.concatenate(parts) for parts in zip(*found, strict=True))
    alone = np.bincount(point, minlength=len(counts))[point] < 2
    return light[~alone], point[~alone], view[~alone], radius[~alone].astype(np.float64)


def begin_exposure(
    folder: Path, s: Scene, pixels: Pixels, choice: str, device: str, say: Callable[[str], None] = lambda text: None
) -> Exposure | None:
    """The initial exposure of the training photographs: from sparse points, where there are any. None: no exposure is learned.

    choice  train.exposure
    say     is called where it is learned
    """
    if choice == "off" or s.background is not None or (choice == "auto" and not s.points):
        return None
    cameras = [view.camera for view in views_of(s, "train")]
    observed = observed_light(folder, s, pixels) if s.points else None
    if observed is None or not len(observed[0]):
        return exposure_of(cameras, device=device) if choice == "on" else None
    fit = fit_exposure(*observed, camera_numbers(cameras))
    if choice == "auto" and not differs(fit):
        return None
    stops = fit.gains.mean(axis=1) / np.log(2)
    say(f"learning exposure: photographs differ from their mean by {stops.min():+.2f} to {stops.max():+.2f} stops")
    return exposure_of(cameras, fit.gains, fit.vignetting, device)


def differs(fit: ExposureFit) -> bool:
    """Whether photographs differ by more than what points show of the direction that they are seen from: by the standard deviation of their gains, of the
    channel in which it is largest."""
    return bool((fit.gains.std(axis=0) / np.log(2)).max() > LEAST_STOPS and fit.explained > LEAST_EXPLAINED)


def saved_exposure(e: Exposure | None, s: Scene) -> tuple[list[str], Exposure] | None:
    """The exposure to save: the images of the scene's views, and the exposure of each. Held-back views have the mean, in the camera that took them; where
    that took no training photograph, they have none."""
    if e is None:
        return None
    train = views_of(s, "train")
    others = tuple(view for view in s.views if view.split != "train")
    numbers = camera_numbers([view.camera for view in (*train, *others)])
    of = dict(zip(numbers[: len(train)].tolist(), e.camera_of.tolist(), strict=True))
    others = tuple(view for view, number in zip(others, numbers[len(train) :].tolist(), strict=True) if number in of)
    known = [of[number] for number in numbers[len(train) :].tolist() if number in of]
    learned = e.photographs.detach().cpu()
    photographs = torch.cat([learned - learned.mean(dim=0), learned.new_zeros(len(others), 3)])
    camera_of = torch.cat([e.camera_of.cpu(), torch.tensor(known, dtype=torch.int64)])
    return [view.image for view in (*train, *others)], Exposure(photographs, e.cameras.detach().cpu(), camera_of)


def exposure_facts(e: Exposure | None) -> dict[str, float] | None:
    """For the report: by how many stops photographs lie from the mean, and corners of the images below their middle; None where nothing was learned."""
    if e is None:
        return None
    stops = e.log_gains().detach().mean(dim=1) / np.log(2)
    corners = SCALE * e.cameras.detach()[:, VIGNETTING].sum(dim=1) / np.log(2)
    return {"least_stops": round(float(stops.min()), 3), "most_stops": round(float(stops.max()), 3), "corner_stops": round(float(corners.min()), 3)}
