"""Small corrections of the training cameras, found together with the field (direct image alignment: Engel et al. 2018, "Direct Sparse Odometry").

Now and then some pixels of every photograph are rendered, colour and depth. With the right camera, the photograph shows the rendered colour at the
pixel where the rendered point lies. With a wrong one it shows it a little off, and the photograph's gradient says where to move the camera:

    residual   I(u + P d) - c  ~  (I(u) - c) + grad I(u) P d

    u  pixel, c colour and X point that are rendered there;  P = d project(X) / d correction;  d the change of the correction (Gauss-Newton).

No gradient of the field is needed, so that every field, space and backend does. A correction is six numbers for a camera (rotation vector in the camera's
axes, translation in units of its median depth) and one for all: the logarithm of the focal length's factor. Rounds are summed with a memory that fades,
Huber's weights limit outliers, a prior holds every camera near where it was given, and a similarity, which no photograph can show, is taken out.

C cameras, N pixels of a camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from efficientnerf.geometry.cameras import MODELS, Camera, project

POSE = 6
# docs/experiments/photographs.md
PRIOR_PIXELS = 1.0  # standard deviation of a correction, as it moves the middle of the image
PRIOR_FOCAL = 0.0005  # of the logarithm of the focal length
SHARED = 50  # pixels whose residuals count as one: they are errors of the field, which neighbours share
MEMORY = 0.7  # weight of a round's equations in the next one
MAX_PIXELS = 0.5  # that a round moves a camera at most
HUBER = 1.5  # robust standard deviations
STEP = 1e-4  # of the finite differences
FAR = 1e4  # world units: where points are put that lie beyond all samples


@dataclass
class Alignment:
    """Pixels of one photograph and what the field shows there."""

    pixels: np.ndarray  # (N, 2) x, y
    residual: np.ndarray  # (N, 3) photograph minus render
    gradient: np.ndarray  # (N, 3, 2) of the photograph, per pixel along x and y
    points: np.ndarray  # (N, 3) in the world; FAR away where nothing is


@dataclass
class CameraCorrections:
    """The corrections that are learned."""

    given: tuple[Camera, ...]  # as they came
    depth: np.ndarray  # (C,) median depth of what each one shows, the unit of its translation; 0: not known yet
    pose: np.ndarray  # (C, 6) float64 corrections
    focal: np.ndarray  # (1,) float64 correction
    normal: np.ndarray  # (C, 7, 7) the equations so far, of pose and focal, at the present corrections
    right: np.ndarray  # (C, 7) their right side

    @staticmethod
    def none(cameras: Sequence[Camera]) -> CameraCorrections:
        """No corrections."""
        count = len(cameras)
        return CameraCorrections(
            tuple(cameras), np.zeros(count), np.zeros((count, POSE)), np.zeros(1), np.zeros((count, POSE + 1, POSE + 1)), np.zeros((count, POSE + 1))
        )

    @property
    def cameras(self) -> list[Camera]:
        """The cameras as they are now."""
        found = zip(self.given, self.pose, self.depth, strict=True)
        return [corrected(camera, pose, float(self.focal[0]), depth) for camera, pose, depth in found]

    @property
    def state(self) -> dict[str, np.ndarray]:
        """All that changes, by name."""
        return {name: getattr(self, name) for name in ("depth", "pose", "focal", "normal", "right")}


def rotation_matrix(vector: np.ndarray) -> np.ndarray:
    """(3, 3) of a rotation vector (3,) (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    cross = np.array([[0, -vector[2], vector[1]], [vector[2], 0, -vector[0]], [-vector[1], vector[0], 0]], np.float64)
    a, b = (1 - angle**2 / 6, 0.5 - angle**2 / 24) if angle < 1e-4 else (np.sin(angle) / angle, (1 - np.cos(angle)) / angle**2)
    return np.asarray(np.eye(3) + a * cross + b * (cross @ cross), np.float64)


def rotation_vector(matrix: np.ndarray) -> np.ndarray:
    """The inverse of `rotation_matrix` for angles below half a turn."""
    sine = 0.5 * np.array([matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]])
    size = float(np.linalg.norm(sine))
    angle = np.arctan2(size, (np.trace(matrix) - 1) / 2)
    return np.asarray(sine * (1 + size**2 / 6 if size < 1e-6 else angle / size), np.float64)


def corrected(camera: Camera, pose: np.ndarray, focal: float, depth: float) -> Camera:
    """A camera with a correction of its pose (6,) and of its focal length."""
    moved = camera.world_from_camera.copy()
    moved[:3, 3] += depth * camera.world_from_camera[:3, :3] @ pose[3:]
    moved[:3, :3] = camera.world_from_camera[:3, :3] @ rotation_matrix(pose[:3])
    return replace(camera, world_from_camera=moved, params=_scaled_focal(camera, focal))


def _scaled_focal(camera: Camera, focal: float) -> tuple[float, ...]:
    factor = np.exp(focal)
    return tuple(float(value * factor) if name in ("f", "fx", "fy") else value for name, value in zip(MODELS[camera.model], camera.params, strict=True))


def motion(camera: Camera, depth: float, points: np.ndarray) -> np.ndarray:
    """(N, 2, 7) how the projections of points (N, 3) move with a further correction of the camera, in pixels."""
    columns = []
    for k in range(POSE + 1):
        ends = []
        for sign in (-1, 1):
            change = np.zeros(POSE + 1)
            change[k] = sign * STEP
            ends.append(project(corrected(camera, change[:POSE], change[POSE], depth), points)[0])
        columns.append((ends[1] - ends[0]) / (2 * STEP))
    return np.stack(columns, axis=-1)


def add_round(c: CameraCorrections, seen: Sequence[Alignment | None]) -> None:
    """Let the earlier rounds fade and add the equations of another one. None: nothing was rendered of that photograph."""
    c.normal *= MEMORY
    c.right *= MEMORY
    cameras = c.cameras
    for n, a in enumerate(seen):
        if a is None:
            continue
        depth = (a.points - cameras[n].centre) @ cameras[n].forward
        near = depth[(depth > 0) & (depth < FAR / 2)]
        if c.depth[n] == 0 and len(near):  # the unit stays what it is
            c.depth[n] = np.median(near)
        if c.depth[n] == 0:
            continue
        with np.errstate(invalid="ignore"):
            slope = np.einsum("nkx,nxp->nkp", a.gradient, motion(cameras[n], c.depth[n], a.points))  # (N, 3, 7)
        good = np.isfinite(slope).all(axis=(1, 2)) & np.isfinite(a.residual).all(axis=1)
        if not good.any():
            continue
        slope, residual = slope[good].reshape(-1, POSE + 1), a.residual[good]
        size = np.linalg.norm(residual, axis=1)
        scale = max(1.4826 * float(np.median(size)), 1e-3)
        weight = np.repeat(np.minimum(1, HUBER * scale / np.maximum(size, 1e-12)), 3) / (SHARED * scale**2 / 3)
        # einsum sums in one order on any number of threads; a product of matrices need not.
        weighted = slope * weight[:, None]
        c.normal[n] += np.einsum("np,nq->pq", weighted, slope)
        c.right[n] -= np.einsum("np,n->p", weighted, residual.reshape(-1))


def solve(c: CameraCorrections) -> float:
    """Take a Gauss-Newton step of all corrections with their prior; returns the largest motion of an image's middle, in pixels."""
    before = c.cameras
    f = np.array([camera.intrinsics["fx"] for camera in c.given])
    hold = (f / PRIOR_PIXELS) ** 2  # rotation by 1 rad, and translation by the median depth, move the middle by f pixels
    known = c.depth > 0
    if not known.any():
        return 0.0
    blocks = c.normal[known, :POSE, :POSE] + hold[known, None, None] * np.eye(POSE)
    rights = c.right[known, :POSE] - hold[known, None] * c.pose[known]
    across = c.normal[known, :POSE, POSE]
    inverse = np.linalg.inv(blocks)
    top = c.normal[known, POSE, POSE].sum() + 1 / PRIOR_FOCAL**2 - np.einsum("ci,cij,cj->", across, inverse, across)
    side = c.right[known, POSE].sum() - c.focal[0] / PRIOR_FOCAL**2 - np.einsum("ci,cij,cj->", across, inverse, rights)
    focal = side / top
    pose = np.einsum("cij,cj->ci", inverse, rights - across * focal)
    limit = np.minimum(1, MAX_PIXELS / np.maximum(f[known] * np.abs(pose).max(axis=1), 1e-12))
    c.pose[known] += pose * limit[:, None]
    c.focal[0] += focal
    take_similarity_out(c)
    taken = np.zeros((len(c.given), POSE + 1))
    for n, (camera, old) in enumerate(zip(c.cameras, before, strict=True)):
        if known[n]:
            taken[n, :3] = rotation_vector(old.world_from_camera[:3, :3].T @ camera.world_from_camera[:3, :3])
            taken[n, 3:POSE] = old.world_from_camera[:3, :3].T @ (camera.centre - old.centre) / c.depth[n]
            taken[n, POSE] = focal
    c.right -= np.einsum("cij,cj->ci", c.normal, taken)
    return float((f * np.abs(taken[:, :POSE]).max(axis=1)).max())


def take_similarity_out(c: CameraCorrections) -> None:
    """Move all cameras together so that their frames lie closest to the given ones: the scene's place, rotation and scale must not drift."""
    known, cameras = np.flatnonzero(c.depth > 0), c.cameras
    given, now = (np.stack([some[n].world_from_camera for n in known]) for some in (c.given, cameras))
    mean_given, mean_now = given[:, :3, 3].mean(axis=0), now[:, :3, 3].mean(axis=0)
    centre_given, centre_now = given[:, :3, 3] - mean_given, now[:, :3, 3] - mean_now
    axes = np.einsum("c,cij,ckj->ik", c.depth[known] ** 2, given[:, :3, :3], now[:, :3, :3])
    u, _, vt = np.linalg.svd(axes + np.einsum("ci,cj->ij", centre_given, centre_now))
    rotation = (u * [1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    spread = float((centre_now**2).sum())
    scale = float((centre_given * (centre_now @ rotation.T)).sum()) / spread if spread > 0 else 1.0
    for n, centre in zip(known, scale * centre_now @ rotation.T + mean_given, strict=True):
        own = c.given[n].world_from_camera[:3, :3]
        c.pose[n, :3] = rotation_vector(own.T @ rotation @ cameras[n].world_from_camera[:3, :3])
        c.pose[n, 3:] = own.T @ (centre - c.given[n].centre) / c.depth[n]
