import os
import sys

LAYERS = "omp workqueue tbb"  # numba's threading layers in order of preference; the second can always be loaded (docs/experiments/threading-layer.md)
if "numba" not in sys.modules:  # else numba.runtime sees to it
    os.environ.setdefault("NUMBA_THREADING_LAYER_PRIORITY", LAYERS)


class Notice(RuntimeWarning):
    """A warning for whoever runs the program: the command line shows it, and puts those of libraries into a log."""

    for_users = True
