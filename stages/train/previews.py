"""Renders of one view now and then, next to its photograph."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np

from efficientnerf.evaluation.metrics import WINDOW, psnr, ssim
from efficientnerf.geometry.cameras import Camera
from pipeline.files import is_denied
from pipeline.text import printable
from stages.evaluate.views import ground_truth, stride_to, subsample_camera
from stages.figures.plots import to_uint8
from stages.io.png import read_png, write_png
from stages.io.scene import Scene, views_of
from stages.scratch import Warn, digest_of, once

SIDE = 200  # longest side of a preview, pixels


class Previews:
    """Preview renders in the scratch folder."""

    def __init__(
        self, render: Callable[[Camera], np.ndarray], background: tuple[float, float, float] | None, poses: Path, s: Scene, work: Path, every: int | None = None
    ) -> None:
        """
        render      colours (H, W, 3) that a camera sees
        background  constant colour behind the scene, or None
        poses       the folder of the scene
        every       steps after which a preview is due; None: none ever is
        """
        self.render, self.background, self.poses, self.work, self.every = render, background, poses, work, every
        # A validation view if there is one, so that the test views stay unread until the end.
        views = views_of(s, "val") or views_of(s, "test")
        self.view = views[len(views) // 2] if views else None
        self.figures: dict[str, float] = {}  # PSNR and SSIM of the last preview, the latter where it is large enough

    def draw_when_due(self, step: int) -> float | None:
        """Render where it is time after a step; the PSNR of the preview, None where none is drawn."""
        return None if self.every is None or step == 0 or step % self.every else self.draw(step)

    def draw(self, step: int) -> float | None:
        """Render; the PSNR, None where there is no view to draw."""
        if self.view is None:
            return None

        stride = stride_to(self.view.camera, SIDE)
        truth = ground_truth(self.poses, self.view, self.background, stride).colour
        render = np.clip(self.render(subsample_camera(self.view.camera, stride)), 0, 1)
        write_png(to_uint8(np.concatenate([truth, render], axis=1)), self.work / f"preview_{step:06d}.png")
        self.figures = {"preview_psnr": round(float(psnr(render, truth)), 2)}
        if min(render.shape[:2]) >= WINDOW:
            self.figures["preview_ssim"] = round(ssim(render, truth), 3)
        return self.figures["preview_psnr"]

    def publish(self, folder: Path, warn: Warn) -> None:
        """Copy all previews, those of earlier attempts too, into `folder`, which is made if there are any; without such as can't be read."""
        warn = once(warn)
        for path in sorted(self.work.glob("preview_*.png")):
            try:
                digest_of(path)  # a plain file
                read_png(path)
            except Exception as error:  # whatever a decoder raises
                if isinstance(error, OSError) and is_denied(error):
                    raise  # nothing is wrong with the file
                warn(f"{path.name} of an earlier attempt can't be used ({printable(error, 200)}) and is left out")
                continue
            folder.mkdir(exist_ok=True)
            shutil.copyfile(path, folder / path.name)
