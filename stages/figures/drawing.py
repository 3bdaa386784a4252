"""matplotlib as all figures import it: it writes into our cache folder alone, and its settings are its own defaults."""

import atexit
import functools
import os
import shutil
import sys
import tempfile
from importlib.metadata import version
from typing import Any

from efficientnerf.backends.kernel_cache import cache_folder, first_private


@functools.cache
def matplotlib() -> Any:
    """The package. On first import its list of fonts goes into `matplotlib` of our cache folder, and a `matplotlibrc`, as of the working folder, is ignored."""
    first = "matplotlib" not in sys.modules
    if first:
        os.environ["MPLCONFIGDIR"] = _folder()
    import matplotlib  # once its folder is set

    if first:
        matplotlib.rcdefaults()
    return matplotlib


def _folder() -> str:
    try:
        place = first_private([cache_folder() / "matplotlib"], version("matplotlib"))[0]
    except RuntimeError:  # no home
        place = None
    if place is not None:
        return str(place)
    made = tempfile.mkdtemp(prefix="efficientnerf-matplotlib-")
    atexit.register(shutil.rmtree, made, ignore_errors=True)
    return made


def new_figure(width: float, height: float, dpi: int) -> tuple[Any, Any]:
    """An empty figure of so many inches, and its canvas."""
    matplotlib()
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # after the above
    from matplotlib.figure import Figure  # after the above

    figure = Figure(figsize=(width, height), dpi=dpi, layout="tight")
    return figure, FigureCanvasAgg(figure)
