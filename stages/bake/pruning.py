"""Which voxels are dropped from a tree during refinement: those that contribute to no pixel, then those of least weight, as far as the asset's size
demands. In unbounded scenes, voxels stay without which a ray would end in a hole.

N voxels.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from efficientnerf.asset.cascades import subset
from efficientnerf.asset.components import small_components, unsupported_components
from efficientnerf.asset.field_samples import FieldSamples
from efficientnerf.asset.refinement import fit
from efficientnerf.asset.refinement.state import RefinementState, subset_state
from efficientnerf.asset.refinement.targets import Targets
from efficientnerf.asset.tree import NerfTree
from pipeline.stage import Job
from stages.bake.holes import find_holes, voxels_of_holes
from stages.bake.plan import Bake
from stages.bake.voxels import FEW_VIEWS_RATIO, seen_by_few
from stages.io.scene import Scene

# Training rays per voxel that are rendered to see which voxels show, at least bake.visibility_rays: fewer where many of the voxels that are baked do not stay,
# and in normalised device coordinates, where no ray misses and each meets many voxels. docs/experiments/refinement.md
RAYS_PER_VOXEL = {"object": 1.0, "scene": 0.4, "ndc": 0.25}


@dataclass(frozen=True)
class Pruned:
    """How voxels were dropped: of unbounded scenes, the shares of the rays that end in holes."""

    without: float = 0.0  # after voxels were dropped
    restored: float = 0.0  # after `voxels` of them were restored
    voxels: int = 0

    def report(self) -> dict[str, Any]:
        return {"pruned": round(self.without, 6), "restored": round(self.restored, 6), "voxels_restored": self.voxels}


def prune(
    job: Job, s: Scene, plan: Bake, state: RefinementState, targets: Targets, most: int, samples: FieldSamples | None = None, baked: np.ndarray | None = None
) -> tuple[RefinementState, Pruned, np.ndarray]:
    """Only the voxels that contribute more than bake.weight_threshold to a pixel, and of these at most `most`, those that contribute most. In an unbounded
    scene, voxels stay without which a ray would end in a hole. In normalised device coordinates voxels that few images have in view count more. Returned are
    the state, how voxels were dropped, and (N,) bool, which were not.

    samples, baked  of an unbounded scene: of its field, and (N,) densities before the first step
    """
    state.to_host()
    greatest = greatest_weights(job, plan, state, targets)
    if plan.kind == "ndc":
        greatest[of_few_views(job, s, state.tree)] *= FEW_VIEWS_RATIO
    keep = heaviest(job, greatest, most)
    if not keep.any():
        return state, Pruned(), ~keep
    if samples is None:
        keep &= ~small_components(state.tree, keep, plan.min_component)
        return subset_state(state, keep, subset(state.tree, keep)), Pruned(), keep

    assert baked is not None
    keep &= ~unsupported_components(state.tree, keep, plan.min_component, samples)
    holes, pruned_share = find_holes(job, subset(state.tree, keep), samples)
    needed = voxels_of_holes(state.tree, samples, holes)
    restored = needed & ~keep
    state.density[needed] = np.maximum(state.density, baked)[needed]
    keep |= restored
    over = int(keep.sum()) - most
    if over > 0:
        others = np.flatnonzero(keep & ~restored)
        keep[others[np.argsort(greatest[others], kind="stable")[:over]]] = False
    tree = subset(state.tree, keep)
    pruned = Pruned(pruned_share, find_holes(job, tree, samples)[1], int((restored & keep).sum()))
    return subset_state(state, keep, tree), pruned, keep


def count_rays(job: Job, plan: Bake, voxels: int, targets: Targets) -> int:
    """Training rays that are rendered to find which of so many voxels show."""
    return min(max(job.settings.visibility_rays, int(RAYS_PER_VOXEL[plan.kind] * voxels)), 4 * len(targets.pixels))


def greatest_weights(job: Job, plan: Bake, state: RefinementState, targets: Targets) -> np.ndarray:
    """(N,) the greatest contribution of each voxel to one of many training pixels."""
    count = count_rays(job, plan, len(state.density), targets)

    def progress(done: int, total: int) -> None:
        job.progress(done, total, "rendering for voxel weights")
        job.safe_point()

    return fit.max_weights(state.tree, targets, count, job.settings.seed, progress)


def of_few_views(job: Job, s: Scene, tree: NerfTree) -> np.ndarray:
    """Numbers of the voxels of the coarse cells that few training images have in view, in normalised device coordinates."""
    assert tree.ndc is not None
    cells = np.argwhere(tree.brick_index >= 0)
    few = seen_by_few(job, s, tree.ndc, (cells + 0.5) * (tree.voxel * tree.brick) + tree.bounds_min)
    rows = tree.voxel_index[tree.brick_index[tuple(cells[few].T)]]
    found: np.ndarray = rows[rows >= 0]
    return found


def heaviest(job: Job, greatest: np.ndarray, most: int) -> np.ndarray:
    """(N,) bool: voxels whose weight exceeds bake.weight_threshold, at most `most`."""
    keep = greatest > job.settings.weight_threshold
    if keep.sum() > most:
        keep = greatest_of(greatest, most)
        left_out = float(greatest[~keep].max())
        job.say(f"voxels with a weight of at most {left_out:.3g} in every pixel are left out: bake.max_mib allows {most:,} voxels")
    return keep


def greatest_of(weight: np.ndarray, count: int) -> np.ndarray:
    """(N,) bool: the `count` voxels of the greatest weight, the first of equals."""
    keep = np.zeros(len(weight), bool)
    keep[np.argsort(-weight, kind="stable")[:count]] = True
    return keep
