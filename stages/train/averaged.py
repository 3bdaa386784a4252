"""Photographs of a scene as if all had been exposed alike: what an asset, its Gaussians and the texture of its mesh are made of."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from efficientnerf.training.exposure.held_out import predicted_gains
from efficientnerf.training.exposure.model import Exposure, averaged_image, image_as_taken
from stages.io.field_file import load_exposure
from stages.io.scene import Scene, View, read_image, read_mask

Taken = Callable[[View, np.ndarray, int], np.ndarray]
ReadView = Callable[[View], tuple[np.ndarray, np.ndarray | None]]  # (H, W, 3 or 4) uint8, and (H, W) bool or None


def averaged_views(folder: Path, trained: Path | None) -> ReadView:
    """A reader of views and their masks: where exposure was learned, with the average exposure, and without clipped pixels.

    folder   of the scene
    trained  of the stage train; None: photographs are read as they are

    Raises CorruptArtifact.
    """
    known = None if trained is None else exposures_of(trained)

    def read(view: View) -> tuple[np.ndarray, np.ndarray | None]:
        image, mask = read_image(folder, view), read_mask(folder, view)
        if known is None or view.image not in known[0]:
            return image, mask

        return averaged_image(image, mask, known[0][view.image], known[1])

    return read


def as_taken(trained: Path, s: Scene) -> Taken | None:
    """A function that shows a render (H, W, 3) of every stride-th pixel of a view as its camera would, by what the train stage in `trained` learned; None: it
    learned nothing. Held-back views are exposed as the nearest training photographs predict (`predicted_gains`)."""
    known = exposures_of(trained)
    if known is None:
        return None
    numbers, exposure = known
    learned = exposure.log_gains().numpy()
    gains = {name: learned[number] for name, number in numbers.items()}
    train, others = ([view for view in s.views if (view.split == "train") is used and view.image in numbers] for used in (True, False))
    own = np.array([gains[view.image] for view in train]).reshape(-1, 3)
    predicted = predicted_gains(own, [view.camera for view in train], [view.camera for view in others])
    gains |= {view.image: one for view, one in zip(others, predicted, strict=True)}

    def taken(view: View, image: np.ndarray, stride: int) -> np.ndarray:
        if view.image not in numbers:
            return image
        return image_as_taken(image, numbers[view.image], exposure, gains[view.image], (view.camera.width, view.camera.height), stride)

    return taken


def exposures_of(trained: Path) -> tuple[dict[str, int], Exposure] | None:
    """Numbers of photographs by their images, and what was learned of them; None where nothing was. Raises CorruptArtifact."""
    found = load_exposure(trained)
    return None if found is None else ({name: number for number, name in enumerate(found[0])}, found[1])
