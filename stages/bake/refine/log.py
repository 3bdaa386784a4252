"""The log of a refinement, its previews of a view that was held back."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from efficientnerf.asset.refinement.state import RefinementState
from stages.bake.refine.timing import Stopwatch
from stages.train.log import Log, psnr_of
from stages.train.previews import Previews

EVERY = 10  # steps
SMOOTHING = 0.9  # of the running mean of the error
PREVIEWS = 8  # after the first, which is drawn before a step is taken
PREVIEW_SHARE = 0.03  # of the time, at most; the first and the last are drawn all the same


class RefinementLog(Log):
    """The log of a refinement: a line every few steps, and at each preview.

        seconds          of the stage so far
        psnr             running mean over the training rays, each over the backgrounds that it is compared over; null before the first step
        preview_psnr     of the preview, if one was drawn
        rays_per_second  of the steps alone, the mean since the last line
        resolution       voxels along the longest side
    """

    def __init__(self, path: Path, step: int, fraction: float, stopwatch: Stopwatch, previews: Previews, clock: Callable[[], float]) -> None:
        """step, fraction  that the refinement goes on from"""
        super().__init__(path, step)
        self.stopwatch, self.previews, self.clock = stopwatch, previews, clock
        self.drawn = int(PREVIEWS * fraction)
        self.previewing, self.working, self.logged = 0.0, 0.0, step
        self.error: float | None = None

    def record(self, state: RefinementState, phase: str, fraction: float, rays: int, error: float, seconds: float, *, last: bool) -> dict[str, Any]:
        """Log a step where it is time; returns what a display shows of it.

        fraction  of the way
        rays      of the step
        error     mean squared error of a channel
        seconds   that the step took
        last      of its phase
        """
        self.error = error if self.error is None else SMOOTHING * self.error + (1 - SMOOTHING) * error
        self.working += seconds
        drawn = self._preview(state, fraction)
        if state.step % EVERY == 0 or last or drawn is not None:
            rate = rays * (state.step - self.logged) / max(self.working, 1e-9)
            line = {
                "step": state.step, "phase": phase, "seconds": round(self.stopwatch.seconds, 3), "preview_psnr": drawn,
                "psnr": psnr_of(self.error) if rays else None,
                "rays": rays, "rays_per_second": round(rate), "voxels": len(state.density), "resolution": max(state.tree.resolution),
            }  # fmt: skip
            self.add(line)
            self.working, self.logged = 0.0, state.step
        return {"psnr": round(psnr_of(self.error), 2), "voxels": len(state.density), **self.previews.figures}

    def begin(self, state: RefinementState, phase: str, error: float) -> None:
        """The line before the first step, and its preview."""
        self.drawn = -1
        self.record(state, phase, 0.0, 0, error, 0.0, last=True)
        self.error = None

    def _preview(self, state: RefinementState, fraction: float) -> float | None:
        """Draw a preview where it is time; its PSNR."""
        due = int(PREVIEWS * round(fraction, 9))
        if due <= self.drawn or (0 < due < PREVIEWS and self.previewing > PREVIEW_SHARE * self.stopwatch.seconds):
            return None
        began = self.clock()
        state.fetch()
        psnr = self.previews.draw(state.step)
        self.drawn = due
        self.previewing += self.clock() - began
        return psnr
