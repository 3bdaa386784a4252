"""The resolution of the hash grid and the size of its tables, from the training photographs.

In normalised device coordinates photographs fill the whole box with the same number of grid points to a pixel: the finest resolution is one point for a
pixel, and the number of entries follows the number of pixels. Elsewhere surfaces fill little of the box: tables are twice as large for four times as many
pixels. docs/experiments/hash-grid.md
"""

import math
from dataclasses import replace

import numpy as np

from efficientnerf.settings import resolved
from efficientnerf.training.settings import FINEST, LOG2_TABLE, TrainSettings
from stages.bake.resolution import ndc_pixel
from stages.io.field_file import space_of
from stages.io.scene import Scene

# docs/experiments/hash-grid.md
PIXELS_PER_ENTRY = 6  # training pixels to an entry of a level's table in normalised device coordinates
BASE_PIXELS = 2**22  # elsewhere: training pixels for which a table of the default size is enough
MAX_LOG2_TABLE = 19
MAX_RESOLUTION = 4096


def with_auto_sizes(settings: TrainSettings, s: Scene, pixels: int) -> TrainSettings:
    """The settings with numbers for `log2_hashmap_size`, `finest_resolution` and `num_coarse_samples`.

    pixels  of all training images
    """
    finest, entries = FINEST, LOG2_TABLE + math.log2(max(pixels, 1) / BASE_PIXELS) / 2
    if s.forward is not None:
        entries = math.log2(max(pixels, 1) / PIXELS_PER_ENTRY)
        longest = float((s.forward.bounds[1] - s.forward.bounds[0]).max())
        finest = int(np.clip(math.ceil(longest / ndc_pixel(s, s.forward)), FINEST, MAX_RESOLUTION))
    log2_table = int(np.clip(round(entries), LOG2_TABLE, MAX_LOG2_TABLE))
    return replace(
        settings,
        log2_hashmap_size=resolved(settings.log2_hashmap_size) or log2_table,
        finest_resolution=resolved(settings.finest_resolution) or finest,
        num_coarse_samples=resolved(settings.num_coarse_samples) or space_of(s).num_coarse_samples,
    )
