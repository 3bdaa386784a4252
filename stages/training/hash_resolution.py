"""The size of the hash field, from the photographs that it is to hold.

In normalised device coordinates photographs fill the whole box at the same number of lattice points to a pixel, and tables of the default size, made for
a thing in the middle of its box, are shared by too many of them. Held-back views of LLFF *fern* after 1000 steps of the preset `preview` (distortion 0.002,
one seed): at 504x378, 1024 points a side, 22.0 dB with 2^17 entries, 22.5 with 2^19, and 22.6 with 2^21, whose steps took 1.4 times as long; at 1008x756,
20.7 dB with 2^17 entries and 1024 points, 21.0 with 2^19 and 2048. Encoding and Adam take about 10 ms more in a step with 2^19, on one core.

Elsewhere matter fills little of the box, and what is seen more sharply shows finer things, for which more lattice points share an entry: tables are twice as
large for four times as many pixels. *chair* at 800x800, 64 million pixels, after 2500 steps: 29.5 dB with 2^17 entries, 29.8 with 2^19 in 1.15 times the
processor time, and 29.8 too with 2048 lattice points a side.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from efficientnerf.settings import given
from efficientnerf.training.settings import FINEST, LOG2_TABLE, TrainSettings
from stages.baking.resolution import ndc_pixel

if TYPE_CHECKING:
    from stages.io.scene import Scene

PIXELS_AN_ENTRY = 6  # training pixels to an entry of a level's table in normalised device coordinates
PIXELS_OF_LEAST = 2**22  # elsewhere, for which the default is enough
LARGEST = 19  # log2 of the entries at most
MOST = 4096  # lattice points a side


def with_auto_sizes(settings: TrainSettings, s: Scene, pixels: int) -> TrainSettings:
    """The settings with `log2_table`, `finest` and `coarse_samples` where these leave them to be chosen.

    pixels  how many the training images have
    """
    from stages.io.field_file import space_of

    finest, entries = FINEST, LOG2_TABLE + math.log2(max(pixels, 1) / PIXELS_OF_LEAST) / 2
    if s.forward is not None:
        entries = math.log2(max(pixels, 1) / PIXELS_AN_ENTRY)
        longest = float((s.forward.bounds[1] - s.forward.bounds[0]).max())
        finest = int(np.clip(math.ceil(longest / ndc_pixel(s, s.forward)), FINEST, MOST))
    log2_table = int(np.clip(round(entries), LOG2_TABLE, LARGEST))
    return replace(
        settings,
        log2_hashmap_size=given(settings.log2_hashmap_size) or log2_table,
        finest_resolution=given(settings.finest_resolution) or finest,
        num_coarse_samples=given(settings.num_coarse_samples) or space_of(s).num_coarse_samples,
    )
