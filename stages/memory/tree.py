"""Memory of an asset."""

from efficientnerf.asset.format import outline
from efficientnerf.asset.palettes import PaletteHarmonics
from efficientnerf.asset.tree import NerfTree
from stages.artifacts import BakeOutputs
from stages.memory.forecast import Known

TREE = 3  # times the tree's arrays: these, and what renderers make of them


def tree_bytes(tree: NerfTree) -> int:
    """Bytes of a tree and of what renderers make of it."""
    harmonics = tree.harmonics
    colours = 16 * len(tree.density_values)  # as seen from a camera
    stored = harmonics.base.nbytes + harmonics.codes.nbytes if isinstance(harmonics, PaletteHarmonics) else harmonics.nbytes
    return TREE * (tree.brick_index.nbytes + tree.voxel_index.nbytes + tree.density_values.nbytes + stored) + colours


def asset_of(known: Known) -> NerfTree:
    """The run's asset, whose arrays have their sizes and take no memory."""
    return outline(BakeOutputs.of_run(known.run).asset)
