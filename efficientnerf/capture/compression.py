"""How strongly a picture was compressed: by the quality of its JPEG file, and by the steps that JPEG leaves between its blocks, in any file format.
docs/experiments/sfm.md
"""

import numpy as np

BLOCK = 8  # px, side of JPEG's blocks
MIN_SIDE = 8 * BLOCK  # px of a side, below which nothing is reported
STRONG = 20  # quality of a JPEG by libjpeg's count, below which it is compressed strongly
STEP, SHARE = 2.0, 0.8  # levels, and of the mean difference of neighbouring pixels, from which steps between blocks show


def is_strong(quality: int | None, step: float, share: float) -> bool:
    """Whether a picture is compressed so strongly that features and colours suffer: by its file's quality, or by its blocks, if it was saved again.

    quality      of its JPEG, None of other files
    step, share  by `block_steps`
    """
    return (quality is not None and quality < STRONG) or (step > STEP and share > SHARE)


def block_steps(grey: np.ndarray) -> tuple[float, float]:
    """(levels, share of the mean difference between neighbours) by which the difference of two pixels exceeds the mean of the differences on either side, at
    the places of one phase of BLOCK; less what it does at others. The lesser of both axes: of a picture without blocks about 0.

    grey  (H, W) uint8, at the size at which it was compressed; the blocks are found at half of that size, too
    """
    if min(grey.shape) < MIN_SIDE:
        return 0.0, 0.0
    return min(_steps_across(grey), _steps_across(grey.T))


def _steps_across(grey: np.ndarray) -> tuple[float, float]:
    """Those of the columns."""
    differences = np.abs(np.diff(grey.astype(np.int16), axis=1)).astype(np.float32)
    mean = float(differences.mean(dtype=np.float64))
    if mean == 0:
        return 0.0, 0.0
    columns = differences.mean(0, dtype=np.float64)
    excess = columns[1:-1] - (columns[:-2] + columns[2:]) / 2
    phases = excess[: len(excess) // BLOCK * BLOCK].reshape(-1, BLOCK).mean(0)
    step = float(phases.max() - np.median(phases))
    return step, step / mean
