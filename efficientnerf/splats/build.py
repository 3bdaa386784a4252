"""From a tree and pictures to 3D Gaussians: its voxels merged, then fitted to the pictures."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from efficientnerf.asset.tree import NerfTree
from efficientnerf.splats.gaussians import Gaussians
from efficientnerf.splats.merging import SHELL_DISTANCE, environment_shell, joined, merged
from efficientnerf.splats.refit import View, refitted

__all__ = ["Budget", "NothingToShow", "View", "gaussians_of_asset"]

# docs/experiments/splats.md
START = 0.8  # share of the Gaussians allowed that voxels are merged into: the rest is added where the error is
# Gaussians of the environment behind all that are fitted, which leave gaps where training pictures end: share of those allowed, and at most; and their
# distance over that of the others.
BEHIND_SHARE, BEHIND_MOST, BEHIND = 0.01, 1000, 1.3

Progress = Callable[[int, int, str], None]


@dataclass(frozen=True)
class Budget:
    """Size of what is made, and the work of its refit."""

    count: int  # Gaussians at most, one at least
    degree: int  # of their harmonics, 0 to 3; at most the asset's
    steps: int  # of the refit, each of a picture or of rows of a large one; 0: the voxels merged, as they are
    seed: int = 0  # of the order of the pictures


class NothingToShow(ValueError):
    """No voxel shows in any picture."""


def gaussians_of_asset(
    tree: NerfTree, views: Sequence[View], budget: Budget, progress: Progress | None = None, time_used: Callable[[], float] | None = None
) -> Gaussians:
    """Gaussians that show what the tree shows, fitted on the tree's device.

    views      what they are fitted to, and whose cameras say which voxels show
    time_used  see `refitted`

    Raises NothingToShow, and ValueError without views.
    """
    if not views:
        raise ValueError("Gaussians of an asset need pictures to be fitted to; there are none")

    def report(done: int, text: str) -> None:
        if progress is not None:
            progress(done, budget.steps + 1, text)

    def reached(step: int) -> None:
        passed = 0.0 if time_used is None else min(time_used(), 1.0)
        report(max(step, int(budget.steps * passed)) + 1, "fitting Gaussians")

    report(0, "merging voxels")
    behind = environment_shell(tree, min(int(BEHIND_SHARE * budget.count), BEHIND_MOST) if budget.steps else 0, 0, BEHIND * SHELL_DISTANCE)
    most = budget.count - len(behind)
    gaussians = merged(tree, [view.camera for view in views], max(1, int(START * most)) if budget.steps else most, budget.degree)
    if not len(gaussians):
        raise NothingToShow("no voxel of the asset shows in any picture: there is nothing that Gaussians could show")
    report(1, "fitting Gaussians")
    fitted = refitted(
        gaussians, views, budget.steps, most=most, background=tree.background, seed=budget.seed,
        reached=reached, time_used=time_used, device=tree.device,
    )  # fmt: skip
    if not len(fitted):
        raise NothingToShow("no Gaussian is left that shows in any picture")
    return joined(fitted, behind)
