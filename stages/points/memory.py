"""Memory of spreading points over the surface."""

from stages.memory.forecast import Known
from stages.memory.need import Need
from stages.memory.tree import asset_of
from stages.mesh.memory import surface_needed

WRITTEN = 30  # bytes of a point


def memory_needed(known: Known) -> Need:
    """Memory of the stage points for all of the asset."""
    return surface_needed(asset_of(known), known.settings["points"].num_points)


def space_needed(known: Known) -> int:
    """The points' file."""
    return int(WRITTEN * known.settings["points"].num_points)
