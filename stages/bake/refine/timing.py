"""The shares of bake.time_budget that the phases of the refinement may take."""

from efficientnerf.asset.refinement.schedule import PHASES
from stages.compiling import clock

# docs/experiments/refinement.md
WARMUP, TIMED = 2, 8  # first steps of a phase that are not timed; those after them that are, before the number of its steps is set
FINISH_SECONDS_PER_VOXEL = 3e-6  # that the palettes and the file take
# Codes of the layout `packed` (docs/experiments/packed.md): at how many rates they are chosen at most; seconds of one core that a voxel takes at the three that
# are usual; the steps that tables are fitted in, and what a ray of a step takes, over one whose error is measured, with what is measured before and after.
PACKING_TRIES, PACKING_SECONDS_PER_VOXEL, REFIT_STEPS, REFIT_SECONDS = 10, 3.2e-5, 64, 2.2
WEIGHT_SECONDS = 0.8  # that a ray takes which is rendered for voxel weights, over one whose error is measured
HOLD = WARMUP + TIMED


class Stopwatch:
    """Seconds of the stage so far, earlier attempts included up to the checkpoint that this one goes on from."""

    def __init__(self) -> None:
        self._began = clock()

    @property
    def seconds(self) -> float:
        return clock() - self._began

    def set(self, seconds: float) -> None:
        self._began = clock() - seconds


def allotted(phase: int, left: float) -> float:
    """Seconds of those left that a phase may take: its share among those to come."""
    return max(0.0, left) * PHASES[phase].share / sum(one.share for one in PHASES[phase:])


def packing_seconds(voxels: int, cores: int, per_ray: float, rays: int) -> float:
    """About how long codes of so many voxels take to choose, and their tables to fit (`stages.bake.economy`).

    per_ray  seconds that measuring the error of a ray takes
    rays     of a step
    """
    return PACKING_SECONDS_PER_VOXEL * voxels / cores + per_ray * REFIT_STEPS * rays * REFIT_SECONDS
