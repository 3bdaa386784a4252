"""PLY of 3D Gaussians as 3DGS writes it, binary little endian, all float32: x y z, nx ny nz (0), f_dc_0..2, f_rest_*, opacity, scale_0..2, rot_0..3.

Scales are logarithms, opacities logits, rotations w x y z, f_rest channel by channel; colour = 0.5 + sum of basis * coefficient. The capture's frame.
"""

import os
from pathlib import Path

import numpy as np

from efficientnerf.splats.gaussians import MAX_DEGREE, Gaussians
from pipeline.errors import CorruptArtifact
from stages.formats.exporters.splats.frames import check_gaussians
from stages.formats.exporters.writing import CAPTURE_IS_Z_UP, SourceFrame, write_parts

MAX_HEADER = 2**13  # bytes
_NEAREST = 2.0**-24  # to 0 and to 1 that an opacity comes


def property_names(count: int) -> list[str]:
    """The columns for K = count harmonics, in order."""
    return [
        "x", "y", "z", "nx", "ny", "nz", *(f"f_dc_{k}" for k in range(3)), *(f"f_rest_{k}" for k in range(3 * (count - 1))),
        "opacity", *(f"scale_{k}" for k in range(3)), *(f"rot_{k}" for k in range(4)),
    ]  # fmt: skip


def write_splats(gaussians: Gaussians, path: Path, frame: SourceFrame = CAPTURE_IS_Z_UP) -> None:
    """Write Gaussians given in the capture's frame. Raises BadInput."""
    check_gaussians(gaussians, path)
    count, harmonics = gaussians.harmonics.shape[:2]
    properties = "".join(f"property float {name}\n" for name in property_names(harmonics))
    header = f"ply\nformat binary_little_endian 1.0\ncomment {frame.comment}\nelement vertex {count}\n{properties}end_header\n"
    opacity = gaussians.opacities.astype(np.float64)
    rows = np.concatenate([
        gaussians.means, np.zeros((count, 3)), gaussians.harmonics[:, 0], gaussians.harmonics[:, 1:].transpose(0, 2, 1).reshape(count, -1),
        np.log(opacity / (1 - opacity))[:, None], np.log(gaussians.scales.astype(np.float64)), gaussians.rotations,
    ], axis=1, dtype="<f4", casting="same_kind")  # fmt: skip
    write_parts(path, [header.encode("ascii"), rows.tobytes()])


def read_splats(path: Path) -> Gaussians:
    """Gaussians as `write_splats` wrote them. Raises CorruptArtifact."""

    def damaged(why: str) -> CorruptArtifact:
        return CorruptArtifact(f"{path}: {why}.", (str(path),))

    try:
        with open(path, "rb") as file:
            size = os.fstat(file.fileno()).st_size
            head, end, _ = file.read(MAX_HEADER).partition(b"end_header\n")
            lines = head.decode("ascii", "replace").splitlines()
            names = [line.removeprefix("property float ") for line in lines[4:]]
            number = lines[3].removeprefix("element vertex ") if len(lines) > 3 else ""
            if not end or lines[:2] != ["ply", "format binary_little_endian 1.0"] or not number.isdecimal() or len(number) > 9:
                raise damaged("is no PLY of 3D Gaussians as this program writes them")
            degree = next((each for each in range(MAX_DEGREE + 1) if property_names((each + 1) ** 2) == names), None)
            if degree is None:
                raise damaged("its properties are not those of 3D Gaussians of degree 0 to 3")
            start, count = len(head) + len(end), int(number)
            if count < 1 or size != start + 4 * len(names) * count:
                raise damaged(f"holds {size} bytes, expected {start + 4 * len(names) * count} for {count} Gaussians")
            rows = np.fromfile(file, "<f4", count * len(names), offset=start - file.tell()).reshape(count, len(names))
    except OSError as error:
        raise damaged(f"cannot be read ({error.strerror})") from error
    if len(rows) != count or not np.isfinite(rows).all():
        raise damaged("holds numbers that are not finite")
    harmonics = np.concatenate([rows[:, None, 6:9], rows[:, 9:-8].reshape(count, 3, -1).transpose(0, 2, 1)], axis=1)
    with np.errstate(over="ignore"):
        opacity, scales = 1 / (1 + np.exp(-rows[:, -8].astype(np.float64))), np.exp(rows[:, -7:-4].astype(np.float64)).astype(np.float32)
    length = np.linalg.norm(rows[:, -4:].astype(np.float64), axis=1, keepdims=True)
    if not (np.isfinite(scales) & (scales > 0)).all() or not (np.abs(length - 1) < 1e-3).all():
        raise damaged("holds scales or rotations that no Gaussian has")
    return Gaussians(
        means=rows[:, :3].copy(), scales=scales, rotations=(rows[:, -4:] / length).astype(np.float32),
        opacities=np.clip(opacity, _NEAREST, 1 - _NEAREST).astype(np.float32), harmonics=np.ascontiguousarray(harmonics),
    )  # fmt: skip
