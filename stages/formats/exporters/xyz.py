"""XYZ text: one point per line, `x y z red green blue nx ny nz`; colours are sRGB 0-255. The capture's frame.

No header: readers that know only `x y z` take the first three numbers, and those that show colours expect them next.
"""

from pathlib import Path

import numpy as np

from efficientnerf.surface.mesh import PointCloud
from stages.formats.exporters.writing import CAPTURE_IS_Z_UP, SourceFrame, bytes_from_srgb, check_points, text_rows, write_parts

_LINE = "%.9g %.9g %.9g %d %d %d %.5f %.5f %.5f\n"


def write_points(points: PointCloud, path: Path, frame: SourceFrame = CAPTURE_IS_Z_UP) -> None:
    """Write a point cloud in the capture's frame. Raises BadInput."""
    check_points(points, path)
    write_parts(path, text_rows(_LINE, np.hstack([points.positions, bytes_from_srgb(points.colours), points.normals])))
