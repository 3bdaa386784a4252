"""GLB with the extension KHR_gaussian_splatting: y up as all glTF, turned as `exporters.glb` turns meshes; what does not know the extension shows points.

Scales and opacities are as they are (no logarithms), rotations x y z w, colours sRGB as photographs have them: 0.5 + sum of basis * coefficient.
COLOR_0 is for viewers without the extension: linear, as glTF has it.

Khronos, KHR_gaussian_splatting, ratified 2026.
"""

from pathlib import Path
from typing import Any

import numpy as np

from efficientnerf.rendering.colour import linear_from_srgb
from efficientnerf.rendering.harmonics import C0
from efficientnerf.splats.gaussians import Gaussians
from stages.formats.exporters.glb import VERTICES, Buffer, write_document
from stages.formats.exporters.splats.frames import check_gaussians, with_y_up
from stages.formats.exporters.writing import CAPTURE_IS_Z_UP, SourceFrame

EXTENSION = "KHR_gaussian_splatting"
POINTS = 0  # mode of a primitive


def write_splats(gaussians: Gaussians, path: Path, frame: SourceFrame = CAPTURE_IS_Z_UP) -> None:
    """Write Gaussians given in the capture's frame. Raises BadInput."""
    check_gaussians(gaussians, path)
    turned = with_y_up(gaussians, frame)
    buffer = Buffer()
    def put(values: np.ndarray, **more: Any) -> int:
        return buffer.accessor(np.asarray(values, "<f4"), VERTICES, **more)

    means = np.asarray(turned.means, "<f4")
    plain = linear_from_srgb(np.clip(0.5 + C0 * turned.harmonics[:, 0].astype(np.float64), 0, 1))
    colour = np.concatenate([plain, turned.opacities[:, None]], axis=1)
    found = {
        "POSITION": put(means, min=means.min(0).tolist(), max=means.max(0).tolist()),
        "COLOR_0": buffer.accessor(np.asarray(np.round(colour * 65535), "<u2"), VERTICES, normalized=True),
        f"{EXTENSION}:ROTATION": put(turned.rotations[:, [1, 2, 3, 0]]),
        f"{EXTENSION}:SCALE": put(turned.scales),
        f"{EXTENSION}:OPACITY": put(turned.opacities),
    }
    for number in range(turned.harmonics.shape[1]):
        degree = int(number**0.5)
        found[f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{number - degree**2}"] = put(turned.harmonics[:, number])
    primitive = {
        "attributes": found,
        "mode": POINTS,
        "extensions": {
            EXTENSION: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display", "projection": "perspective", "sortingMethod": "cameraDistance"}
        },
    }
    write_document("splats", primitive, EXTENSION, frame, buffer, path)
