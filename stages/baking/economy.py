"""The codes of an asset in the layout `packed`: as good as bake.max_mib has room for.

How many bytes codes take is known once they are coded. So codes are chosen at a rate, and where the file is too large, at the next one that follows from its
size, until it fits. Where even the coarsest codes are too large, the voxels that weigh least are left out.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.stage import Job

if TYPE_CHECKING:
    from efficientnerf.asset.refinement.targets import Targets
    from efficientnerf.asset.tree import NerfTree

# docs/experiments/packed.md
FILL = 0.96  # of the size, at least, where codes are coarser than they would be by default
STEEPNESS = 2.0  # of the rate over the size: the rate grows by the size to this power
COARSEST = 3e-4  # rate beyond which voxels are left out instead
MAX_TRIES = 10
FIXED = 2**14  # bytes, about, of header, tables and palette


def packed_tree(job: Job, tree: NerfTree, targets: Targets, size: int) -> NerfTree:
    """The tree with codes, so that its file has at most `size` bytes, where it can.

    targets  what voxels are weighed by
    """
    from efficientnerf.asset import economy
    from efficientnerf.asset.cascades import subset
    from efficientnerf.asset.format import serialize
    from efficientnerf.asset.refinement import fit

    count = min(max(job.settings.visibility_rays, len(tree.density_values)), 4 * len(targets.pixels))
    weight = fit.max_weights(tree, targets, count, job.settings.seed)
    rate, low, high, best = economy.DEFAULT_RATE, None, None, None
    for _ in range(MAX_TRIES):
        job.safe_point()
        found = economy.economised(tree, weight, rate)
        took = len(serialize(found, "packed"))
        job.say(f"codes at a rate of {rate:.3g} take {took / 2**20:.2f} MiB")
        if took <= size:
            best, high = found, rate
            if rate == economy.DEFAULT_RATE or took >= FILL * size:
                break
        else:
            low = rate
            if rate >= COARSEST:
                keep = _heaviest(weight, int(len(weight) * 0.96 * max(0.1, (size - FIXED) / (took - FIXED))))
                tree, weight, low, high = subset(tree, keep), weight[keep], None, None
                rate = COARSEST
                continue
        guess = rate * (took / (0.98 * size)) ** STEEPNESS
        if low is not None and high is not None and not low < guess < high:
            guess = (low * high) ** 0.5
        rate = float(min(max(guess, economy.DEFAULT_RATE), COARSEST))
        if rate in (low, high):
            break
    if best is None:
        job.warn(f"the asset takes {took / 2**20:.2f} MiB, more than bake.max_mib: give it a lower bake.resolution")
        return found
    return best


def _heaviest(weight: np.ndarray, count: int) -> np.ndarray:
    """(N,) bool: the `count` voxels of the greatest weight, the first of equals."""
    keep = np.zeros(len(weight), bool)
    keep[np.argsort(-weight, kind="stable")[:count]] = True
    return keep
