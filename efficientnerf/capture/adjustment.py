"""How sure the shape is of what cameras see that bundle adjustment found, by its covariance: the error of lengths that no scale mends.

Letters: C cameras, L lenses, P points, O observations, point by point; N = 6 C + 2 L unknowns: of each camera its turn and its centre, of each lens the
logarithm of its focal length and a radial distortion. Points are free; Triggs et al. 2000, "Bundle adjustment", section 9.
"""

from collections.abc import Sequence

import numpy as np
from scipy import sparse

from efficientnerf.geometry.cameras import Camera

GAUGE = 7  # degrees of freedom of a similarity, which no photograph determines
MOST_POINTS = 4000  # an even choice of more stands for all
MOST_CAMERAS = 500  # the covariance of more takes a minute and a gigabyte
FEWEST = 8  # points
MIN_EIGENVALUE = 1e-12  # of the largest eigenvalue: less is not known
SEEING = 4  # points, from which a camera's centre is known by them


def shape_spread(
    cameras: Sequence[Camera], xyz: np.ndarray, counts: np.ndarray, observers: np.ndarray, miss: float, within: np.ndarray, *, and_cameras: bool = False
) -> float:
    """The standard deviation of the ratio of two lengths at right angles to each other, as a share; of those of which it is known least.

    xyz (P, 3), counts (P,), observers (O,)  sparse points, how many cameras observe each, and which
    miss    mean reprojection error, pixels of the cameras
    within  (P,) the points whose shape is asked; `and_cameras`: together with the cameras' centres
    returns nan where nothing is concluded, of few points or many cameras; a large number where the observations do not determine the cameras

    Errors of the cameras move the points; of the affine map that does so most nearly, it is the part that is no similarity.
    """
    every = max(1, -(-len(xyz) // MOST_POINTS))
    chosen = np.flatnonzero(counts >= 2)[::every]  # the P points from here on
    some, at = within[chosen], np.arange(3 * len(chosen)).reshape(-1, 3)
    if some.sum() < FEWEST or not 2 < len(cameras) <= MOST_CAMERAS:
        return np.nan
    middle = xyz[chosen][some].mean(0)
    unit = max(float(np.median(np.linalg.norm(xyz[chosen][some] - middle, axis=1))), 1e-300)  # so that all unknowns weigh alike
    places, centres = (xyz[chosen] - middle) / unit, (np.array([camera.centre for camera in cameras]) - middle) / unit
    view = np.concatenate([observers[end - count : end] for end, count in zip(np.cumsum(counts)[chosen], counts[chosen], strict=True)])
    point = np.repeat(np.arange(len(chosen)), counts[chosen])
    by_camera, across = _derivatives(cameras, centres, places[point], view)  # (3 O, N), (O, 3, 3)

    blocks = np.add.reduceat(across.transpose(0, 2, 1) @ across, np.cumsum(counts[chosen]) - counts[chosen])  # (P, 3, 3)
    inverse = np.linalg.inv(blocks + 1e-9 * np.trace(blocks, axis1=1, axis2=2)[:, None, None] * np.eye(3))
    solved = sparse.csr_array((inverse.ravel(), (np.repeat(at, 3, axis=1).ravel(), np.tile(at, 3).ravel())))  # (3 P, 3 P)
    mixed = _rows(across, at[point], at.size).T @ by_camera  # (3 P, N)
    follow = solved @ mixed  # (3 P, N): points go as far the other way
    values, vectors = np.linalg.eigh((by_camera.T @ by_camera - mixed.T @ follow).toarray())
    deviations = vectors[:, GAUGE:] / np.sqrt(every * np.maximum(values[GAUGE:], MIN_EIGENVALUE * values[-1]))  # (N, N - 7), independent

    moved = -(follow.tocsr()[at[some].ravel()] @ deviations).reshape(some.sum(), 3, -1)  # (S, 3, N - 7)
    places = places[some]
    if and_cameras:
        seeing = np.bincount(view, minlength=len(cameras)) >= SEEING
        places = np.concatenate([places, centres[seeing]])
        moved = np.concatenate([moved, deviations[: 6 * len(cameras)].reshape(len(cameras), 2, 3, -1)[seeing, 1]])
    places = places - places.mean(0)
    affine = np.einsum("jl,sl,skn->nkj", np.linalg.pinv(places.T @ places, 1e-6), places, moved)
    strain = (affine + affine.transpose(0, 2, 1)) / 2
    strain = (strain - np.trace(strain, axis1=1, axis2=2)[:, None, None] / 3 * np.eye(3)).reshape(-1, 9)
    focal = float(np.median([camera.intrinsics["fx"] for camera in cameras]))
    noise = miss / np.sqrt(np.pi / 2) / focal  # standard deviation of a coordinate of an observation
    return noise * float(np.sqrt(2 * np.linalg.eigvalsh(strain.T @ strain)[-1]))  # of d d^T - e e^T the norm is the root of 2


def _derivatives(cameras: Sequence[Camera], centres: np.ndarray, places: np.ndarray, view: np.ndarray) -> tuple[sparse.csr_array, np.ndarray]:
    """(3 O, N) and (O, 3, 3): how the directions to observed places (O, 3) change with the unknowns and with the places.

    Lenses are alike: what a focal length and a radial distortion change of any is that of a pinhole camera, most nearly.
    """
    lenses = {(camera.model, camera.params): n for n, camera in enumerate({(each.model, each.params): each for each in cameras}.values())}
    lens = np.array([lenses[camera.model, camera.params] for camera in cameras])[view]
    turns = np.stack([camera.world_from_camera[:3, :3] for camera in cameras])[view]  # (O, 3, 3)
    away = places - centres[view]
    distance = np.linalg.norm(away, axis=1)[:, None, None]
    x, y, z = (away / distance[:, 0]).T
    zero = np.zeros_like(x)
    turned = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(-1, 3, 3)  # the cross product with the direction
    across = -turned @ turned / distance  # what is across the direction
    own = (turns.transpose(0, 2, 1) @ away[..., None])[..., 0]
    flat = own[:, :2] / np.maximum(own[:, 2:], 0.01 * distance[:, 0])
    zoomed = across * distance @ turns[:, :, :2] @ flat[..., None]  # (O, 3, 1)
    bent = (flat**2).sum(1)[:, None, None] * zoomed
    columns = np.concatenate([6 * view[:, None] + np.arange(6), 6 * len(cameras) + 2 * lens[:, None] + np.arange(2)], axis=1)  # (O, 8)
    return _rows(np.concatenate([turned, -across, zoomed, bent], axis=2), columns, 6 * len(cameras) + 2 * len(lenses)), across


def _rows(values: np.ndarray, columns: np.ndarray, width: int) -> sparse.csr_array:
    """(3 O, width): values (O, 3, K) in the columns (O, K)."""
    rows = np.arange(3 * len(values)).reshape(-1, 3, 1)
    return sparse.csr_array((values.ravel(), tuple(each.ravel() for each in np.broadcast_arrays(rows, columns[:, None]))), (3 * len(values), width))
