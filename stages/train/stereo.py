"""Points that photographs show by stereo, for rays of the sparse depth loss."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from efficientnerf.capture.stereo import FEWEST, PIXELS, Picture, choose_sources, dense_points, undistorted
from efficientnerf.settings import resolved
from efficientnerf.training.pixels import Pixels
from efficientnerf.training.settings import TrainSettings
from stages.io import scene
from stages.io.scene import Scene, View

MOST_PHOTOGRAPHS = 120  # that are compared: of more, where stereo is needed least, evenly chosen ones
MOST_SPARSE = 2**17  # sparse points that say where to search
MOST_PIXELS = 5_000_000  # of all pictures: 17 s on two cores
PIXELS_A_SECOND = 24_000  # of a time budget: 8 % of it on two cores
MOST_POINTS = 2**19  # that are used; as many of each photograph


def stereo_points(
    folder: Path, s: Scene, pixels: Pixels, views: tuple[View, ...], settings: TrainSettings, progress: Callable[[float], None]
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Points (A, 3) that training views show by stereo, the camera (A, 3) of the view, and that of the nearest one which confirms it. None: there are none.

    pixels, views  of the scene in `folder`, from which `s` may differ in cameras and in what is trained on
    progress       gets the share that is done, often; what it raises stops the search
    """
    trained = np.array([number for number, view in enumerate(s.views) if view.split == "train"])
    trained = trained[np.linspace(0, len(trained) - 1, min(len(trained), MOST_PHOTOGRAPHS)).round().astype(int)]
    xyz, counts, observers = scene.read_observations(folder)
    place = np.full(len(s.views), -1)
    place[trained] = np.arange(len(trained))
    point, at = np.repeat(np.arange(len(counts)), counts), place[observers]
    seen = np.zeros((len(trained), len(xyz)), bool)
    seen[at[at >= 0], point[at >= 0]] = True
    used = np.flatnonzero(seen.any(axis=0) & np.isfinite(xyz).all(axis=1))
    if len(used) < FEWEST:
        return None
    used = used[:: -(-len(used) // MOST_SPARSE)]
    xyz, seen = xyz[used], seen[:, used]
    rows = {view.image: number for number, view in enumerate(views)}
    budget = resolved(settings.time_budget)
    most = min(PIXELS, int(min(MOST_PIXELS, PIXELS_A_SECOND * (budget or np.inf))) // len(trained))
    pictures, usable = zip(*(_picture(pixels, rows[s.views[number].image], s.views[number], most) for number in trained), strict=True)
    centres = np.array([picture.centre for picture in pictures])
    sources = choose_sources(centres, xyz, seen)
    rng = np.random.Generator(np.random.Philox(key=settings.seed, counter=[0, 0, 9, 0]))
    found, own, other = [], [], []
    for number, dense in enumerate(dense_points(pictures, sources, xyz, seen, progress)):
        keep = np.flatnonzero(usable[number][dense.pixel[:, 1], dense.pixel[:, 0]])
        most = MOST_POINTS // len(pictures)
        if len(keep) > most:
            keep = np.sort(rng.choice(keep, most, replace=False))
        apart = np.linalg.norm(centres[sources[number]] - centres[number], axis=1)
        nearest = sources[number][np.where(dense.confirmed[keep], apart, np.inf).argmin(axis=1)]
        found.append(dense.xyz[keep])
        own.append(np.broadcast_to(centres[number], (len(keep), 3)))
        other.append(centres[nearest])
    if not sum(map(len, found)):
        return None
    return np.concatenate(found), np.concatenate(own), np.concatenate(other)


def _picture(pixels: Pixels, row: int, view: View, most: int) -> tuple[Picture, np.ndarray]:
    """A view without distortion, of at most so many pixels, and which of them (H, W) the photograph shows, and masks and alpha channels keep."""
    begin, end, shape = int(pixels.offsets[row]), int(pixels.offsets[row + 1]), (view.camera.height, view.camera.width)
    image = np.asarray(pixels.images[begin:end]).reshape(*shape, -1)
    usable = pixels.usable_of(row)
    if image.shape[-1] == 4:
        usable = usable & (image[..., 3] > 127)
    picture = undistorted(cv2.cvtColor(np.ascontiguousarray(image[..., :3]), cv2.COLOR_RGB2GRAY), view.camera, most)
    return picture, undistorted(np.where(usable, np.uint8(255), np.uint8(0)), view.camera, most).grey == 255
