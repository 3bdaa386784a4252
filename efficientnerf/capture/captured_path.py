"""The camera path that follows the photographs: a smooth curve through the captured cameras, in the order in which they were taken.

The order is that of the files. They may be out of order: where their path leaps about, the shorter one of nearest neighbours is taken.
Centres and rotations are smoothed a little, thinned, and joined by a centripetal Catmull-Rom spline (Yuksel et al. 2011), travelled at constant speed.

C cameras, K key poses of the spline, F frames. Speed and distances count turning as well as moving: see `_rows`.
"""

import math
from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from efficientnerf.geometry.cameras import Camera

MAX_KEYS = 24  # poses that the spline passes through; of more cameras, those evenly spaced along the way
MAX_ORDERED = 400  # cameras that a tour is sought through; of more, every n-th
LEAPS = 2.2  # files are in order if their tour is at most so many times as long as that of nearest neighbours
MAX_CLOSING_GAP = 1.5  # a tour is closed if its ends are at most so many mean steps apart
STEEPEST = 0.9  # |z| of view axes up to which cameras can be levelled
DENSE = 40  # points of the spline to a piece, for its length


def captured_cameras(cameras: Sequence[Camera], frames: int, longest: int) -> list[Camera]:
    """Cameras along the path of the captured ones (C >= 1), in their world, z up: pinholes with the median field of view of those photographs that have the
    usual orientation.

    longest  longer side of the image, pixels; both are even
    """
    usual = sum(camera.width >= camera.height for camera in cameras) * 2 >= len(cameras)
    alike = [camera for camera in cameras if (camera.width >= camera.height) == usual]
    aspect = float(np.median([camera.width / camera.height for camera in alike]))
    focal = float(np.median([camera.intrinsics["fx"] / camera.width for camera in alike]))
    width, height = (longest, longest / aspect) if usual else (longest * aspect, longest)
    width, height = (max(2, 2 * round(side / 2)) for side in (width, height))
    lens = (focal * width, width / 2, height / 2)
    poses = captured_path([camera.world_from_camera for camera in cameras], frames)
    return [Camera(f"captured_{k:04d}", width, height, "SIMPLE_PINHOLE", lens, pose) for k, pose in enumerate(poses)]


def captured_path(poses: Sequence[np.ndarray], frames: int) -> list[np.ndarray]:
    """Poses (4, 4) of a smooth path past C >= 1 captured ones in their order, z up. It is closed, and then ends one step before its beginning, where the
    captured ones go round."""
    given = np.stack([np.asarray(pose, np.float64) for pose in poses[:: max(1, math.ceil(len(poses) / MAX_ORDERED))]])
    rows = _rows(levelled(given))
    rows = _aligned(rows[capture_order(rows)])
    steps = np.linalg.norm(np.diff(rows, axis=0), axis=1)
    if steps.sum() <= 0:  # one camera, or all in one place
        return [_poses(rows[:1], given)[0]] * frames
    ends = rows[-1] * _sign(rows[0], rows[-1])
    closed = len(rows) > 3 and bool(np.linalg.norm(ends - rows[0]) <= MAX_CLOSING_GAP * steps.mean())
    keys = _thinned(_smoothed(rows, closed))
    curve = _spline(keys, closed)
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
    at = np.linspace(0.0, along[-1], frames + 1)[:-1] if closed else np.linspace(0.0, along[-1], frames)
    return _poses(np.stack([np.interp(at, along, column) for column in curve.T], axis=1), given)


def levelled(poses: np.ndarray) -> np.ndarray:
    """Poses (C, 4, 4) without roll about their view axes; as they are where one looks nearly straight up or down."""
    forward = poses[:, :3, 2]
    if np.abs(forward[:, 2]).max() > STEEPEST:
        return poses
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    out = poses.copy()
    out[:, :3, 0], out[:, :3, 1] = right, np.cross(forward, right)
    return out


def capture_order(rows: np.ndarray) -> np.ndarray:
    """Indices (C,) in the order of a walk past all rows (C, 7): as they are, unless they leap about."""
    count = len(rows)
    if count < 4:
        return np.arange(count)
    apart = np.linalg.norm(rows[:, None, :3] - rows[None, :, :3], axis=-1)
    turned = np.minimum(*(np.linalg.norm(rows[:, None, 3:] - sign * rows[None, :, 3:], axis=-1) for sign in (1.0, -1.0)))
    distance = np.hypot(apart, turned)
    tour = _shorter(_nearest_neighbours(distance), distance)
    files = np.arange(count)
    return files if _length(files, distance) <= LEAPS * _length(tour, distance) else tour


def _rows(poses: np.ndarray) -> np.ndarray:
    """(C, 7): centres, in units of half of their mean distance from their middle, and unit quaternions; a right angle counts as about 0.77 such units."""
    return np.concatenate([poses[:, :3, 3] / _unit(poses), Rotation.from_matrix(poses[:, :3, :3]).as_quat()], axis=1)


def _poses(rows: np.ndarray, given: np.ndarray) -> list[np.ndarray]:
    """The inverse of `_rows` of the given poses (C, 4, 4)."""
    out = np.tile(np.eye(4), (len(rows), 1, 1))
    out[:, :3, :3] = Rotation.from_quat(rows[:, 3:]).as_matrix()
    out[:, :3, 3] = rows[:, :3] * _unit(given)
    return list(out)


def _unit(poses: np.ndarray) -> float:
    """Half of the mean distance of the centres of poses (C, 4, 4) from their middle; 1 where they are in one place."""
    centres = poses[:, :3, 3]
    return float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).mean() / 2) or 1.0


def _sign(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Factors of a row `b` that put its quaternion on the side of that of `a`."""
    return np.concatenate([np.ones(3), np.full(4, 1.0 if a[3:] @ b[3:] >= 0 else -1.0)])


def _aligned(rows: np.ndarray) -> np.ndarray:
    """Each quaternion on the side of the one before: q and -q are one rotation."""
    out = rows.copy()
    for k in range(1, len(out)):
        out[k] *= _sign(out[k - 1], out[k])
    return out


def _nearest_neighbours(distance: np.ndarray) -> np.ndarray:
    """A walk from one end of the cameras, the two that are the farthest apart, each time to the nearest that is left."""
    left = np.ones(len(distance), bool)
    order = [int(distance.max(axis=1).argmax())]
    left[order[0]] = False
    while left.any():
        order.append(int(np.where(left, distance[order[-1]], np.inf).argmin()))
        left[order[-1]] = False
    return np.array(order)


def _shorter(order: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """The walk with pieces turned round where that makes it shorter (2-opt)."""
    order, count = order.copy(), len(order)
    for _ in range(20):
        changed = False
        for i in range(count - 2):
            j = np.arange(i + 1, count - 1)  # turn i + 1 .. j round
            here, there = order[i], order[i + 1]
            saved = distance[here, there] + distance[order[j], order[j + 1]] - distance[here, order[j]] - distance[there, order[j + 1]]
            best = int(saved.argmax())
            if saved[best] > 1e-9:
                order[i + 1 : j[best] + 1] = order[i + 1 : j[best] + 1][::-1].copy()
                changed = True
        if not changed:
            break
    return order


def _length(order: np.ndarray, distance: np.ndarray) -> float:
    return float(distance[order[:-1], order[1:]].sum())


def _smoothed(rows: np.ndarray, closed: bool) -> np.ndarray:
    """A quarter of each neighbour to half of each row; the ends of an open path stay."""
    if len(rows) < 3:
        return rows
    before, after = np.roll(rows, 1, axis=0), np.roll(rows, -1, axis=0)
    before[0] *= _sign(rows[0], before[0])
    after[-1] *= _sign(rows[-1], after[-1])
    out = (before + 2 * rows + after) / 4
    if not closed:
        out[[0, -1]] = rows[[0, -1]]
    return out


def _thinned(rows: np.ndarray) -> np.ndarray:
    """MAX_KEYS of the rows at most, at even distances along the way."""
    if len(rows) <= MAX_KEYS:
        return rows
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(rows, axis=0), axis=1))])
    wanted = np.linspace(0.0, along[-1], MAX_KEYS)
    return rows[np.unique(np.abs(along[None] - wanted[:, None]).argmin(axis=1))]


def _spline(keys: np.ndarray, closed: bool) -> np.ndarray:
    """Points (N, 7) of the centripetal Catmull-Rom spline through the keys (K, 7); the last is the first again where it is closed."""
    if closed:
        first, second, last = keys[0] * _sign(keys[-1], keys[0]), keys[1] * _sign(keys[-1], keys[1]), keys[-1] * _sign(keys[0], keys[-1])
        padded = np.concatenate([last[None], keys, first[None], second[None]])
    else:
        padded = np.concatenate([2 * keys[:1] - keys[1:2], keys, 2 * keys[-1:] - keys[-2:-1]])
    knots = np.concatenate([[0.0], np.cumsum(np.sqrt(np.linalg.norm(np.diff(padded, axis=0), axis=1)).clip(min=1e-6))])
    pieces = []
    for k in range(1, len(padded) - 2):
        p, t = padded[k - 1 : k + 3], knots[k - 1 : k + 3]
        s = np.linspace(t[1], t[2], DENSE, endpoint=False)[:, None]
        level = [(p[i] * (t[i + 1] - s) + p[i + 1] * (s - t[i])) / (t[i + 1] - t[i]) for i in range(3)]
        level = [(level[i] * (t[i + 2] - s) + level[i + 1] * (s - t[i])) / (t[i + 2] - t[i]) for i in range(2)]
        pieces.append((level[0] * (t[2] - s) + level[1] * (s - t[1])) / (t[2] - t[1]))
    return np.concatenate([*pieces, padded[-2:-1]])
