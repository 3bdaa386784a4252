"""Memory of sampling points on a mesh."""

from stages.artifacts import MeshOutputs
from stages.memory.forecast import Known
from stages.memory.need import SURFACES, Need, libraries
from stages.mesh.files import mesh_bytes

POINT = 350  # bytes of a point in memory. docs/experiments/memory.md
WRITTEN = 30


def needed(count: int, mesh: int = 0) -> Need:
    """Memory of so many points on a mesh of so many bytes."""
    return Need({"points": POINT * count, "the mesh": mesh, "libraries": libraries() + SURFACES})


def memory_needed(known: Known) -> Need:
    """`needed` on the run's mesh."""
    return needed(known.settings["points"].num_points, mesh_bytes(MeshOutputs.of_run(known.run)))


def space_needed(known: Known) -> int:
    """The points' file."""
    return int(WRITTEN * known.settings["points"].num_points)
