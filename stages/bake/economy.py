"""The codes of an asset in the layout `packed`: as fine as bake.max_mib allows.

How many bytes codes take is known once they are coded. So codes are chosen at a rate, and then at the next one that follows from the file's size, until
it is nearly filled. Where even the coarsest codes are too large, the voxels that weigh least are left out. Then the tables and palettes that codes stand for
are fitted to the images, which changes no file's size. An attempt that was stopped begins here again: its refinement is done.
"""

import math

from efficientnerf.asset import economy
from efficientnerf.asset.cascades import subset
from efficientnerf.asset.format import serialize
from efficientnerf.asset.quantisation import compacted
from efficientnerf.asset.refinement import fit
from efficientnerf.asset.refinement.quantised import refit
from efficientnerf.asset.refinement.targets import Targets
from efficientnerf.asset.tree import NerfTree
from pipeline.stage import Job
from stages.bake.pruning import greatest_of
from stages.bake.refine.refinement import ERROR_RAYS, targets_on_device
from stages.bake.refine.timing import PACKING_TRIES, REFIT_STEPS
from stages.train.log import psnr_of

# docs/experiments/packed.md
FILL, AIM = 0.97, 0.985  # of the size, at least, where codes could be finer; and what is aimed at
STEEPNESS = 2.0  # of the rate over the size: the rate grows by the size to this power, until two sizes are known
LEAST_STEEPNESS, MOST_STEEPNESS = 0.8, 5.0
FINEST = 5e-7  # rate below which codes are as good as the floats
COARSEST = 3e-4  # rate beyond which voxels are left out instead
REFIT_ROUNDS = 4
FIXED = 2**14  # bytes, about, of header, tables and palette


def packed_tree(job: Job, tree: NerfTree, targets: Targets, size: int) -> tuple[NerfTree, float]:
    """The tree with codes, so that its file has at most `size` bytes, where it can, and its PSNR over a sample of the training pixels.

    targets  what voxels are weighed by, and tables are fitted to
    """
    settings = job.settings
    coded = _coded(job, tree, targets, size) if len(tree.density_values) else compacted(tree)
    targets = targets_on_device(job, coded, targets)
    found = refit(
        coded, targets, REFIT_STEPS, rounds=REFIT_ROUNDS, rays=settings.refine_rays_per_batch, seed=settings.seed, safe_point=job.safe_point,
    )  # fmt: skip
    psnr = psnr_of(fit.error(found, targets, min(ERROR_RAYS, 4 * len(targets.pixels)), settings.seed))
    job.say(f"fitted tables to the images in {REFIT_STEPS} steps: {psnr:.2f} dB over training pixels")
    return found, psnr


def _coded(job: Job, tree: NerfTree, targets: Targets, size: int) -> NerfTree:
    """The tree with the finest codes that fit."""
    count = min(max(job.settings.visibility_rays, len(tree.density_values)), 4 * len(targets.pixels))
    weight = fit.max_weights(tree, targets, count, job.settings.seed)
    known = economy.economy_of(tree, weight)
    rate, low, high, best, before = economy.DEFAULT_RATE, None, None, None, None
    for _ in range(PACKING_TRIES):
        job.safe_point()
        found = known.at(rate)
        took = len(serialize(found, "packed"))
        job.say(f"codes at a rate of {rate:.3g} take {took / 2**20:.2f} MiB")
        if took <= size:
            best, high = found, rate
            if rate == FINEST or took >= FILL * size:
                break
        else:
            low = rate
            if rate >= COARSEST:
                keep = greatest_of(weight, int(len(weight) * 0.96 * max(0.1, (size - FIXED) / (took - FIXED))))
                tree, weight, low, high = subset(tree, keep), weight[keep], None, None
                known, rate, before = economy.economy_of(tree, weight), COARSEST, None
                continue
        guess = rate * (took / (AIM * size)) ** _steepness(before, (took, rate))
        if low is not None and high is not None and not low < guess < high:
            guess = (low * high) ** 0.5
        before, rate = (took, rate), float(min(max(guess, FINEST), COARSEST))
        if rate in (low, high):
            break
    if best is None:
        lower = "bake.resolution" if tree.environment is None else "bake.resolution or bake.environment_size"
        job.warn(f"the asset takes {took / 2**20:.2f} MiB, more than bake.max_mib. Lower {lower}.")
        return found
    return best


def _steepness(before: tuple[int, float] | None, now: tuple[int, float]) -> float:
    """To which power of the size the rate grows, by two sizes and their rates."""
    if before is None or before[0] == now[0]:
        return STEEPNESS
    return min(max(math.log(now[1] / before[1]) / math.log(before[0] / now[0]), LEAST_STEEPNESS), MOST_STEEPNESS)
