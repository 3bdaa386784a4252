"""3D Gaussians in another frame: their places and sizes, their own axes, and the colours that they show to each side. N Gaussians, K harmonics."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from efficientnerf.geometry.cameras import Similarity
from efficientnerf.rendering.harmonics import basis_numpy
from efficientnerf.splats.gaussians import Gaussians, quaternions_from
from pipeline.errors import BadInput
from stages.formats.exporters.glb import gltf_from_capture
from stages.formats.exporters.writing import SourceFrame

DIRECTIONS = 64  # that a rotation of harmonics is solved on: more than twice as many as the largest degree has coefficients


def check_gaussians(gaussians: Gaussians, path: Path) -> None:
    """Raise BadInput where there are none, which no program opens."""
    if not len(gaussians):
        raise BadInput(f"{path}: there are no Gaussians. Bake the asset again, or train longer.")


def in_capture(gaussians: Gaussians, frame: SourceFrame) -> Gaussians:
    """Gaussians of the training frame in the capture's. Raises BadInput where they are not finite there."""
    try:
        return moved(gaussians, frame.world_from_capture.inverse())
    except ValueError as error:
        raise BadInput(f"{error} in the capture's frame, whose unit is {frame.world_from_capture.scale:g} of the training frame's.") from error


def with_y_up(gaussians: Gaussians, frame: SourceFrame) -> Gaussians:
    """Gaussians of the capture's frame turned as glTF has it."""
    return moved(gaussians, Similarity(1.0, gltf_from_capture(frame.up), np.zeros(3)))


def with_y_down(gaussians: Gaussians, frame: SourceFrame) -> Gaussians:
    """The same turned by half a turn about x, as in COLMAP's cameras."""
    return moved(gaussians, Similarity(1.0, np.diag([1.0, -1, -1]) @ gltf_from_capture(frame.up), np.zeros(3)))


def moved(gaussians: Gaussians, target_from_source: Similarity) -> Gaussians:
    """The same Gaussians in another frame: each looks the same to an eye that moves along. Raises ValueError where they are not finite there."""
    rotation, scale = target_from_source.rotation, target_from_source.scale
    with np.errstate(over="ignore", under="ignore"):
        w, x, y, z = quaternions_from(rotation[None])[0]
        product = gaussians.rotations.astype(np.float64) @ np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]]).T
        return replace(
            gaussians,
            means=target_from_source.points(gaussians.means).astype(np.float32),
            scales=(scale * gaussians.scales.astype(np.float64)).astype(np.float32),
            rotations=(product / np.linalg.norm(product, axis=1, keepdims=True)).astype(np.float32),
            harmonics=turned_harmonics(gaussians.harmonics, rotation),
        )


def smallest_three(quaternions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(N,) which of the four numbers of unit quaternions (N, 4) is the largest, and (N, 3) float64 the others of that quaternion whose largest is positive."""
    q = quaternions.astype(np.float64)
    largest = np.abs(q).argmax(axis=1)
    q = np.where(np.take_along_axis(q, largest[:, None], 1) < 0, -q, q)
    others = np.array([[k for k in range(4) if k != which] for which in range(4)])[largest]
    return largest, np.take_along_axis(q, others, 1)


def turned_harmonics(harmonics: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Coefficients (N, K, 3) of the function that has at R d the value that the given ones have at d: each degree turns into itself."""
    degree = round(harmonics.shape[1] ** 0.5) - 1
    k = np.arange(DIRECTIONS) + 0.5
    height, longitude = 1 - 2 * k / DIRECTIONS, np.pi * (1 + 5**0.5) * k
    level = np.sqrt(1 - height**2)
    directions = np.stack([level * np.cos(longitude), level * np.sin(longitude), height], -1)
    before, after = basis_numpy(directions, degree), basis_numpy(directions @ rotation.T, degree)
    out = harmonics.copy()
    for band in range(1, degree + 1):
        own = slice(band**2, (band + 1) ** 2)
        turn = np.linalg.lstsq(after[:, own], before[:, own], rcond=None)[0]
        out[:, own] = np.einsum("ij,njc->nic", turn, harmonics[:, own].astype(np.float64))
    return out
