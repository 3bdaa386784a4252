"""Memory of comparing renders with photographs, one view at a time. docs/experiments/memory.md"""

import math
from collections.abc import Mapping
from pathlib import Path

from efficientnerf.asset.tree import NerfTree
from efficientnerf.settings import resolved
from efficientnerf.surface.shading import AT_ONCE
from stages.artifacts import MeshOutputs, TrainOutputs
from stages.evaluate.settings import MAX_FIELD_IMAGE_SIZE, STAGE, EvaluateSettings
from stages.evaluate.strips import STRIP_RAYS
from stages.evaluate.views import evaluation_views
from stages.io.scene import load
from stages.memory.forecast import Known
from stages.memory.need import MIB, Need, libraries
from stages.memory.tree import asset_of, tree_bytes
from stages.mesh.files import mesh_bytes

# Bytes of a pixel: of a test view with its photograph, renders, errors and windows of SSIM; of a view in which the mesh is drawn. Of a sample of those that are
# drawn at a time.
COMPARED, DRAWN, SAMPLE = 160, 90, 40
# Bytes written: of a pixel; of a sheet's text. Pictures in all strips, and of a view's thumbnails in scratch and on the sheet; pixels of one at most.
WRITTEN, SHEET, STRIPS, PICTURES, THUMBNAIL = 2, MIB // 2, 15, 10, 320 * 240
FIELD = 150  # bytes of a ray through the field, with what lies before and behind the box
FIELD_BLOCK = 400 * MIB  # the samples of a block of rays through a field whose density voxels prune nothing yet


def needed(tree: NerfTree, settings: EvaluateSettings, inputs: Mapping[str, Path], device: str) -> Need:
    """Memory of the stage evaluate; `inputs` as of its job."""
    cameras = [view.camera for view in evaluation_views(load(inputs["poses"]))[0]]
    scale = resolved(settings.field_image_scale)
    most = max(camera.width * camera.height for camera in cameras)
    rays = MAX_FIELD_IMAGE_SIZE**2 if scale is None else math.ceil(scale**2 * most)
    if settings.strips == "on":
        rays = max(rays, min(most, STRIP_RAYS))
    return Need({
        "a view": most * (COMPARED + DRAWN),
        "the mesh": mesh_bytes(MeshOutputs(inputs["mesh"])) + SAMPLE * AT_ONCE,
        "its rays": rays * FIELD + FIELD_BLOCK,
        "the asset": tree_bytes(tree) * (3 if tree.outer else 1),  # cascade 0 alone, and what surrounds the mesh
        "the field": 3 * TrainOutputs(inputs["train"]).field.stat().st_size,
        "libraries": libraries(device),
    })  # fmt: skip


def memory_needed(known: Known) -> Need:
    """`needed` for all of the asset."""
    inputs = {name: known.run / name for name in STAGE.needs}
    return needed(asset_of(known), known.settings["evaluate"], inputs, known.device)


def space_needed(known: Known) -> int:
    """Strips, thumbnails in scratch and on a sheet, and a video."""
    own = known.settings["evaluate"]
    pixels = [view.camera.width * view.camera.height for view in evaluation_views(load(known.run / "poses"))[0]]
    strips, thumbnails = STRIPS * max(pixels), sum(min(each, THUMBNAIL) for each in pixels)
    return SHEET + WRITTEN * (strips + PICTURES * thumbnails) + (resolved(own.captured_path_frames) or 0) * max(pixels) // 4
