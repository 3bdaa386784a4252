"""Photographs of a scene as if all had been exposed alike: what an asset, its Gaussians and the texture of its mesh are made of."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from stages.io.field_file import load_exposure
from stages.io.scene import View, read_image, read_mask

if TYPE_CHECKING:
    from efficientnerf.training.exposure.model import Exposure

Unshaded = Callable[[View, np.ndarray], np.ndarray]
ReadView = Callable[[View], tuple[np.ndarray, np.ndarray | None]]  # (H, W, 3 or 4) uint8, and (H, W) bool or None


def averaged_views(folder: Path, trained: Path) -> ReadView:
    """What reads a view and its mask: where exposure was learned, as it would be with the average exposure, and without what it shows clipped.

    folder   of the scene
    trained  of the stage train

    Raises CorruptArtifact.
    """
    known = exposures_of(trained)

    def read(view: View) -> tuple[np.ndarray, np.ndarray | None]:
        image, mask = read_image(folder, view), read_mask(folder, view)
        if known is None or view.image not in known[0]:
            return image, mask
        from efficientnerf.training.exposure.model import averaged_image

        return averaged_image(image, mask, known[0][view.image], known[1])

    return read


def without_vignetting(trained: Path) -> Unshaded | None:
    """What takes the vignetting of its camera from the photograph (H, W, 3) of a view, as the train stage in `trained` learned it; None: it learned none."""
    known = exposures_of(trained)
    if known is None:
        return None

    def unshaded(view: View, colour: np.ndarray) -> np.ndarray:
        from efficientnerf.training.exposure.model import unshaded_image

        return unshaded_image(colour, known[0][view.image], known[1]) if view.image in known[0] else colour

    return unshaded


def exposures_of(trained: Path) -> tuple[dict[str, int], Exposure] | None:
    """Numbers of photographs by their images, and what was learned of them; None where nothing was. Raises CorruptArtifact."""
    found = load_exposure(trained)
    return None if found is None else ({name: number for number, name in enumerate(found[0])}, found[1])
