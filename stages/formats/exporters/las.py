"""LAS 1.4 and LAZ, its compressed form, of points: the capture's frame, colours sRGB of 16 bits, normals as the extra dimensions NormalX, NormalY, NormalZ,
which CloudCompare and PDAL take as such. Where the unit is known to be a metre, a local coordinate system in WKT states it.

Coordinates are integers of a step that is a power of ten: at most a millionth of the points' reach, so that 32 bits hold them.
"""

import io
import math
from pathlib import Path

import numpy as np

from efficientnerf.surface.mesh import PointCloud
from stages.formats.exporters.writing import CAPTURE_IS_Z_UP, SourceFrame, bytes_from_srgb, check_points, write_parts

POINT_FORMAT = 7  # with colours
NORMALS = ("NormalX", "NormalY", "NormalZ")
METRES = 'LOCAL_CS["frame of the capture",LOCAL_DATUM["frame of the capture",0],UNIT["metre",1]]'
FINENESS = 1e-6  # of the points' reach


def write_points(points: PointCloud, path: Path, frame: SourceFrame = CAPTURE_IS_Z_UP) -> None:
    """Write a point cloud in the capture's frame; compressed where the file's name ends in .laz. Raises BadInput."""
    check_points(points, path)
    import laspy  # an extra

    low, high = points.positions.min(axis=0), points.positions.max(axis=0)
    header = laspy.LasHeader(point_format=POINT_FORMAT, version="1.4")
    header.creation_date = None  # today's would make other bytes of the same points
    header.system_identifier, header.generating_software = "efficientnerf", "efficientnerf"
    finest = max(float((high - low).max()) * FINENESS, float(np.abs([low, high]).max()) * 1e-15, 1e-30)
    header.scales = np.full(3, 10.0 ** math.floor(math.log10(finest)))
    header.offsets = np.floor((low + high) / 2 / header.scales[0]) * header.scales[0]
    if frame.metric:
        header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(METRES))
        header.global_encoding.wkt = True
    header.add_extra_dims([laspy.ExtraBytesParams(name, "float32", "of the surface") for name in NORMALS])
    record = laspy.LasData(header)
    record.x, record.y, record.z = points.positions.T
    colours = bytes_from_srgb(points.colours).astype(np.uint16) * 257  # 255 becomes 65535
    record.red, record.green, record.blue = colours.T
    for name, values in zip(NORMALS, points.normals.T, strict=True):
        record[name] = values.astype(np.float32)
    record.return_number[:], record.number_of_returns[:] = 1, 1
    memory = io.BytesIO()
    record.write(memory, do_compress=path.suffix.lower() == ".laz", laz_backend=laspy.LazBackend.Lazrs)
    write_parts(path, [memory.getbuffer()])
