"""The pose of a photograph whose camera is far off, found by renders of the field. C views, N cells of a photograph.

Starts are the camera as it stands, its own place with the directions of its neighbours, and the cameras whose renders look most like it. The
shift of each start is found by correlation and taken as a rotation. The best are aligned in ever smaller cells (direct image alignment: Engel et al. 2018,
"Direct Sparse Odometry"):

    residual   I(u + P d) - c  ~  (I(u) - c) + grad I(u) P d

    u  pixel, c colour and X point that are rendered there;  P = d project(X) / d correction;  d the correction (Gauss-Newton): a rotation vector in the
       camera's axes, and a translation in units of its median depth
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from efficientnerf.geometry.cameras import Camera, project, rays
from efficientnerf.model import Model
from efficientnerf.training.view_checks.residuals import FAR, NOISE, averaged, bundle_of, local_error, middles, rendered, shown

# docs/experiments/wrong-cameras.md
PLACES = 4  # neighbours in place whose directions are tried, and cameras whose renders look like the photograph
STARTS = 3  # that are aligned
ROUNDS = 8  # of an alignment, at each size of the cells
CELLS = 400  # of a round
FINER = (1, 2, 4)  # times as many cells along a side
MAX_STEP = 0.1  # radians, or median depths, that a round moves a camera
DAMPING = 1e-3  # of the equations' mean diagonal
HUBER = 1.5  # robust standard deviations
STEP = 1e-4  # of the finite differences
POSE = 6  # numbers of a correction
OVERLAP = 0.4  # of the cells have to meet where a picture is shifted


@dataclass(frozen=True)
class Search:
    """Inputs of the pose search."""

    model: Model
    cameras: Sequence[Camera]  # (C) of all photographs
    renders: Sequence[np.ndarray]  # of each the field in its cells (H, W, 3)
    # near, far: nearest and farthest of all views along their axes
    near: float
    far: float
    grey: bool  # see `residuals.shown`

    def render(self, cameras: Sequence[Camera], side: int) -> list[np.ndarray]:
        """Renders from cameras in their cells."""
        count = len(cameras)
        return rendered(self.model, cameras, np.full(count, self.near), np.full(count, self.far), [side] * count, self.grey)


def find_pose(s: Search, view: int, image: np.ndarray, usable: np.ndarray, side: int, trusted: np.ndarray) -> tuple[Camera, float]:
    """The camera that explains a photograph best, and its error (`residuals.local_error`).

    image, usable  see `residuals.photograph`
    side           of its cells, pixels
    trusted        (C,) bool: cameras that are believed
    """
    colour, weight = averaged(image, usable, side)
    tried = []
    for start, render in _starts(s, view, colour, weight, side, trusted):
        likeness, shift = best_shift(colour, weight, render)
        tried.append((likeness, turned(start, shift * side)))
    tried.sort(key=lambda each: -each[0])
    aligned = [align(s, camera, image, usable, side) for _, camera in tried[:STARTS]]
    errors = [local_error(colour, render, weight) for render in s.render(aligned, side)]
    return refine_pose(s, aligned[int(np.argmin(errors))], image, usable, side)


def refine_pose(s: Search, camera: Camera, image: np.ndarray, usable: np.ndarray, side: int) -> tuple[Camera, float]:
    """The camera, aligned in ever smaller cells as long as that makes the error smaller, and its error."""
    colour, weight = averaged(image, usable, side)
    error = local_error(colour, s.render([camera], side)[0], weight)
    for finer in FINER:
        if side // finer >= 1:
            aligned = align(s, camera, image, usable, side // finer)
            now = local_error(colour, s.render([aligned], side)[0], weight)
            if now < error:
                camera, error = aligned, now
    return camera, error


def _starts(s: Search, view: int, colour: np.ndarray, weight: np.ndarray, side: int, trusted: np.ndarray) -> list[tuple[Camera, np.ndarray]]:
    """Cameras with this photograph's lens to begin at, and what they see in cells."""
    own = s.cameras[view]
    others = [n for n in np.flatnonzero(trusted).tolist() if n != view]
    near = sorted(others, key=lambda n: float(np.linalg.norm(s.cameras[n].centre - own.centre)))[:PLACES]
    starts = [(own, s.renders[view])]
    directed = [_at(own, s.cameras[n].world_from_camera[:3, :3], own.centre) for n in near]
    starts += zip(directed, s.render(directed, side), strict=True)
    # Photographs that were mistaken for each other are both suspects: each one's place is the other's.
    every = [n for n, render in enumerate(s.renders) if n != view and render.shape == colour.shape]
    alike = [(best_shift(colour, weight, s.renders[n])[0], n) for n in every]
    for _, n in sorted(alike, reverse=True)[:PLACES]:
        starts.append((_at(own, s.cameras[n].world_from_camera[:3, :3], s.cameras[n].centre), s.renders[n]))
    return starts


def _at(camera: Camera, rotation: np.ndarray, centre: np.ndarray) -> Camera:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, centre
    return replace(camera, world_from_camera=pose)


def best_shift(photograph: np.ndarray, weight: np.ndarray, render: np.ndarray) -> tuple[float, np.ndarray]:
    """The correlation of a photograph (H, W, 3) with a render that is shifted in the best way, and the shift (x, y): cell u of the photograph is at
    u + shift of the render. Correlated where both meet (Padfield 2012, "Masked object registration in the Fourier domain")."""
    h, w = weight.shape
    shape = (2 * h, 2 * w)

    def transform(a: np.ndarray) -> np.ndarray:
        return np.asarray(np.fft.rfft2(a, shape, axes=(0, 1)))

    def correlated(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.asarray(np.fft.irfft2(a * np.conj(b), shape, axes=(0, 1)))

    mask, every = transform((weight > 0.5).astype(float))[..., None], transform(np.ones((h, w)))[..., None]
    good = (weight > 0.5)[..., None]
    p, r = (photograph - 0.5) * good, render - 0.5
    fp, fr, fp2, fr2 = transform(p), transform(r), transform(p * p), transform(r * r)
    count = np.maximum(correlated(every, mask), 0)
    floor = np.maximum(count, 1)
    sum_p, sum_r = correlated(every, fp), correlated(fr, mask)
    covariance = correlated(fr, fp) - sum_p * sum_r / floor
    variance_p = np.maximum(correlated(every, fp2) - sum_p**2 / floor, 0)
    variance_r = np.maximum(correlated(fr2, mask) - sum_r**2 / floor, 0)
    noise = NOISE**2 * count
    value = covariance.sum(-1) / np.sqrt((variance_p + noise).sum(-1) * (variance_r + noise).sum(-1) + 1e-9)
    value[count[..., 0] < OVERLAP * h * w] = -1
    y, x = np.unravel_index(int(np.argmax(value)), value.shape)
    return float(value[y, x]), np.array([x - shape[1] if x >= w else x, y - shape[0] if y >= h else y], float)


def turned(camera: Camera, shift: np.ndarray) -> Camera:
    """The camera with its middle looking where a pixel `shift` (2,) from the middle did."""
    still = replace(camera, world_from_camera=np.eye(4))
    middle = np.array([[camera.width / 2, camera.height / 2]])
    before, after = (rays(still, np.clip(at, 0.5, [camera.width - 0.5, camera.height - 0.5]))[1][0].astype(np.float64) for at in (middle, middle + shift))
    axis = np.cross(before, after)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-9:
        return camera
    turn = rotation_matrix(axis / sine * np.arctan2(sine, float(before @ after)))
    return _at(camera, camera.world_from_camera[:3, :3] @ turn, camera.centre)


def align(s: Search, camera: Camera, image: np.ndarray, usable: np.ndarray, side: int) -> Camera:
    """Some rounds of Gauss-Newton on the camera's pose, whatever the photograph's exposure; the same camera where there is nothing to align."""
    colour, weight = averaged(image, usable, side)
    h, w = weight.shape
    if min(h, w) < 3:
        return camera
    gradient = np.zeros((h, w, 3, 2))
    gradient[:, 1:-1, :, 0], gradient[1:-1, :, :, 1] = (colour[:, 2:] - colour[:, :-2]) / (2 * side), (colour[2:] - colour[:-2]) / (2 * side)
    inner = np.zeros((h, w), bool)
    inner[1:-1, 1:-1] = weight[1:-1, 1:-1] > 0.5
    chosen = np.flatnonzero(inner)
    # Evenly by number, rows apart: the golden ratio keeps it from columns.
    chosen = chosen[np.unique((np.arange(CELLS) * 0.6180339887 % 1 * len(chosen)).astype(np.int64))] if len(chosen) > CELLS else chosen
    if len(chosen) < 4 * POSE:
        return camera
    at, p, slope = middles(camera, side)[0][chosen], colour.reshape(-1, 3)[chosen], gradient.reshape(-1, 3, 2)[chosen]
    for _ in range(ROUNDS):
        bundle = bundle_of(camera, at, s.near, s.far)
        shades, distance = shown(s.model, bundle, s.grey)
        step, depth = _step(camera, p, slope, shades, bundle[:, :3] + distance[:, None] * bundle[:, 3:6])
        if depth == 0:
            break
        camera = corrected(camera, step, depth)
        if np.abs(step).max() < 1e-5:
            break
    return camera


def _step(camera: Camera, photograph: np.ndarray, gradient: np.ndarray, shades: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, float]:
    """A Gauss-Newton step (6,) and the unit of its translation; that is 0 where there is none."""
    depth = (points - camera.centre) @ camera.forward
    near = (depth > 0) & (depth < FAR / 2)
    unit = float(np.median(depth[near])) if near.any() else 0.0
    if unit == 0:
        return np.zeros(POSE), 0.0
    spread = shades - shades.mean(0)
    gain = np.clip((spread * photograph).sum(0) / ((spread**2).sum(0) + len(shades) * NOISE**2), 0.2, 5)
    residual = photograph - (gain * spread + photograph.mean(0))
    with np.errstate(invalid="ignore"):
        slope = np.einsum("nkx,nxp->nkp", gradient, motion(camera, unit, points))
    good = np.isfinite(slope).all(axis=(1, 2))
    if good.sum() < 2 * POSE:
        return np.zeros(POSE), 0.0
    slope, residual = slope[good].reshape(-1, POSE), residual[good]
    size = np.linalg.norm(residual, axis=1)
    weight = np.repeat(np.minimum(1, HUBER * max(1.4826 * float(np.median(size)), 1e-3) / np.maximum(size, 1e-12)), 3)
    weighted = slope * weight[:, None]
    normal = np.einsum("np,nq->pq", weighted, slope)
    step = -np.linalg.solve(normal + (DAMPING * np.trace(normal) / POSE + 1e-12) * np.eye(POSE), np.einsum("np,n->p", weighted, residual.reshape(-1)))
    return step * min(1.0, MAX_STEP / max(float(np.abs(step).max()), 1e-12)), unit


def rotation_matrix(vector: np.ndarray) -> np.ndarray:
    """(3, 3) of a rotation vector (3,) (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    cross = np.array([[0, -vector[2], vector[1]], [vector[2], 0, -vector[0]], [-vector[1], vector[0], 0]], np.float64)
    a, b = (1 - angle**2 / 6, 0.5 - angle**2 / 24) if angle < 1e-4 else (np.sin(angle) / angle, (1 - np.cos(angle)) / angle**2)
    return np.asarray(np.eye(3) + a * cross + b * (cross @ cross), np.float64)


def corrected(camera: Camera, pose: np.ndarray, depth: float) -> Camera:
    """A camera with a correction (6,) of its pose; depth, the unit of its translation."""
    rotation = camera.world_from_camera[:3, :3]
    return _at(camera, rotation @ rotation_matrix(pose[:3]), camera.world_from_camera[:3, 3] + depth * rotation @ pose[3:])


def motion(camera: Camera, depth: float, points: np.ndarray) -> np.ndarray:
    """(N, 2, 6) how the projections of points (N, 3) move with a correction of the camera, in pixels."""
    columns = []
    for change in STEP * np.eye(POSE):
        after, before = (project(corrected(camera, sign * change, depth), points)[0] for sign in (1, -1))
        columns.append((after - before) / (2 * STEP))
    return np.stack(columns, axis=-1)
