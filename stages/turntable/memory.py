"""Memory of rendering and writing frames of an asset, one at a time. docs/experiments/memory.md"""

from efficientnerf.asset.tree import NerfTree
from stages.memory.forecast import Known
from stages.memory.need import MIB, Need, libraries
from stages.memory.tree import asset_of, tree_bytes

FRAME = 116  # bytes of a pixel of a frame with all its channels while it is written as EXR
BAND = 160 * MIB  # rays at a time where each is rendered on its own
VIDEO_PIXEL = 1  # written byte of a pixel of a frame, besides a byte for each of its channels as PNG
EXR_PIXEL = 4 * (4 + 1 + 3 + 3)  # float32: colour with alpha, depth, normal, position


def frames_needed(tree: NerfTree, pixels: int, device: str = "cpu") -> Need:
    """Memory to render and write frames of so many pixels."""
    return Need({
        "a frame": pixels * FRAME + (0 if tree.ndc is None and tree.lookup == "trilinear" else BAND),
        "the asset": tree_bytes(tree),
        "libraries": libraries(device),
    })  # fmt: skip


def memory_needed(known: Known) -> Need:
    """Memory of the stage turntable for all of the asset."""
    own = known.settings["turntable"]
    return frames_needed(asset_of(known), own.width * own.height, known.device)


def space_needed(known: Known) -> int:
    """Frames, in scratch and artifact, and a video."""
    own = known.settings["turntable"]
    channels = 4 if own.background == "transparent" else 3
    deep = {"off": 0, "first": 1, "all": own.frames}[own.exr]
    return int(own.width * own.height * ((2 * channels + VIDEO_PIXEL) * own.frames + 2 * EXR_PIXEL * deep))
