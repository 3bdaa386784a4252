"""Cameras, rays and frames: the one statement of axes in the project.

Axes of a camera    x right, y down, z forward (as in OpenCV and COLMAP).
Axes of the world   right-handed; z is up in the training frame, while a capture's frame is whatever its source used.
Pixels              (x, y) with the centre of the first pixel at (0.5, 0.5).
Camera models       COLMAP's, with its names and the order of its parameters. Distortion is never ignored and never removed from the
                    images: `rays` inverts it and `project` applies it.

Letters: (u, v) undistorted and (x, y) distorted coordinates on the plane z = 1, r their radius; theta the angle to the axis (fisheye).
Formulas: the OpenCV documentation ("Camera calibration and 3D reconstruction", "Fisheye camera model") and COLMAP's list of models.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial import polynomial

MODELS: dict[str, tuple[str, ...]] = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "FULL_OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "OPENCV_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
}

# What a model with one focal length becomes when width and height are scaled by different amounts; the new parameters are zero.
_TWO_FOCAL_LENGTHS = {"SIMPLE_PINHOLE": "PINHOLE", "SIMPLE_RADIAL": "OPENCV", "RADIAL": "OPENCV"}
POINTS_AT_ONCE = 2**16  # that are projected: more would go through memory in each of some twenty operations


@dataclass(frozen=True, eq=False)
class Camera:
    """A camera with its pose.

    width, height      pixels
    model, params      a name of `MODELS` and its parameters in that order, pixels where they are lengths
    world_from_camera  (4, 4) float64; the frame of the "world" is the caller's
    """

    name: str
    width: int
    height: int
    model: str
    params: tuple[float, ...]
    world_from_camera: np.ndarray

    def __post_init__(self) -> None:
        if self.model not in MODELS:
            raise ValueError(f"{self.name}: camera model {self.model}; known are {', '.join(MODELS)}")
        if len(self.params) != len(MODELS[self.model]):
            raise ValueError(f"{self.name}: {self.model} has {len(MODELS[self.model])} parameters ({' '.join(MODELS[self.model])}); found {len(self.params)}")

    @property
    def centre(self) -> np.ndarray:
        """(3,) where it stands, in the world."""
        return self.world_from_camera[:3, 3]

    @property
    def forward(self) -> np.ndarray:
        """(3,) unit, the view axis."""
        return self.world_from_camera[:3, 2]

    @property
    def up(self) -> np.ndarray:
        """(3,) unit, towards the top of the image."""
        return -self.world_from_camera[:3, 1]

    @property
    def intrinsics(self) -> dict[str, float]:
        """fx, fy, cx, cy and every distortion coefficient by name; zero where the model has none."""
        named = dict.fromkeys(MODELS["FULL_OPENCV"], 0.0) | dict(zip(MODELS[self.model], self.params, strict=True))
        focal = named.pop("f", None)
        return named if focal is None else named | {"fx": focal, "fy": focal}


@dataclass(frozen=True, eq=False)
class Similarity:
    """x_target = scale * rotation @ x_source + translation.

    scale > 0; rotation (3, 3) proper; translation (3,), in units of the target.
    """

    scale: float
    rotation: np.ndarray
    translation: np.ndarray

    @staticmethod
    def identity() -> Similarity:
        return Similarity(1.0, np.eye(3), np.zeros(3))

    def points(self, x: np.ndarray) -> np.ndarray:
        """(..., 3) -> (..., 3)."""
        return self.scale * (np.asarray(x, np.float64) @ self.rotation.T) + self.translation

    def inverse(self) -> Similarity:
        back = self.rotation.T
        return Similarity(1.0 / self.scale, back, -(back @ self.translation) / self.scale)

    def pose(self, source_from_camera: np.ndarray) -> np.ndarray:
        """(4, 4) pose of a camera in the source frame -> in the target frame; its rotation stays orthonormal (the scale goes into the position)."""
        pose = np.eye(4)
        pose[:3, :3] = self.rotation @ source_from_camera[:3, :3]
        pose[:3, 3] = self.points(source_from_camera[:3, 3])
        return pose

    def camera(self, camera: Camera) -> Camera:
        """The same camera in the target frame."""
        return replace(camera, world_from_camera=self.pose(camera.world_from_camera))

    def matrix(self) -> np.ndarray:
        """(4, 4)."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.scale * self.rotation
        matrix[:3, 3] = self.translation
        return matrix


def closest_similarity(source: np.ndarray, target: np.ndarray, weights: np.ndarray | None = None) -> Similarity:
    """The similarity of least squared distances from (N, 3) source to target points, each weighted by (N,) weights; None: alike.

    Umeyama 1991, "Least-squares estimation of transformation parameters between two point patterns".
    """
    weights = np.full(len(source), 1 / len(source)) if weights is None else weights / weights.sum()
    a, b = source - weights @ source, target - weights @ target
    u, singular, vt = np.linalg.svd((b * weights[:, None]).T @ a)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = (u * sign) @ vt
    scale = float((singular * sign).sum() / max((weights * (a**2).sum(1)).sum(), 1e-300))
    return Similarity(scale, rotation, weights @ target - scale * rotation @ (weights @ source))


def rays(camera: Camera, pixels: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """The rays of pixels.

    pixels   (N, 2) x, y; None: the centres of all, row by row, N = height * width
    returns  origins (N, 3) and unit directions (N, 3), float64, in the camera's world

    Where a distortion model folds over before a pixel is reached, that pixel gets the outermost direction that the model still describes.
    """
    if pixels is None:
        y, x = np.mgrid[0 : camera.height, 0 : camera.width]
        pixels = np.stack([x.ravel(), y.ravel()], -1) + 0.5  # (H W, 2)
    k = camera.intrinsics
    x = (np.asarray(pixels, np.float64)[:, 0] - k["cx"]) / k["fx"]
    y = (np.asarray(pixels, np.float64)[:, 1] - k["cy"]) / k["fy"]
    if camera.model == "OPENCV_FISHEYE":
        radius = np.hypot(x, y)
        theta = _invert_radial(radius, *_radial_polynomials(camera), limit=np.pi)
        unit = np.divide(np.sin(theta), radius, out=np.ones_like(radius), where=radius > 0)
        local = np.stack([x * unit, y * unit, np.cos(theta)], -1)
    else:
        u, v = _undistorted(camera, x, y)
        local = np.stack([u, v, np.ones_like(u)], -1)
    local /= np.linalg.norm(local, axis=-1, keepdims=True)
    directions = local @ camera.world_from_camera[:3, :3].T
    return np.broadcast_to(camera.centre, directions.shape).copy(), directions


def epipolar_error(first: Camera, second: Camera, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """How far matched rays are from a common epipolar plane.

    a, b     (N, 3) unit directions of matched pixels of the first and of the second camera, in the world
    returns  (N,) the angle of a ray a to the plane through both centres and ray b, in pixels of the first camera's middle
    """
    plane = np.cross(second.centre - first.centre, b)
    sine = np.abs((plane * a).sum(1)) / np.maximum(np.linalg.norm(plane, axis=1), 1e-12)
    return np.asarray(sine * first.intrinsics["fx"])


def project(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Projections of points.

    points   (N, 3) in the camera's world
    returns  pixels (N, 2) and depth (N,) along the view axis, world units

    Pixels are nan for what the camera cannot see wherever the image ends: points behind it, and points beyond the angle where the
    distortion model folds back (COLMAP would place those inside the image).
    """
    points = np.asarray(points, np.float64)
    if len(points) <= POINTS_AT_ONCE:
        return _projected(camera, points)
    pixels, depth = np.empty((len(points), 2)), np.empty(len(points))
    for begin in range(0, len(points), POINTS_AT_ONCE):
        part = slice(begin, begin + POINTS_AT_ONCE)
        pixels[part], depth[part] = _projected(camera, points[part])
    return pixels, depth


def _projected(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`project`, of few points."""
    local = (points - camera.centre) @ camera.world_from_camera[:3, :3]  # (N, 3)
    depth = local[:, 2]
    k = camera.intrinsics
    top, bottom = _radial_polynomials(camera)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        if camera.model == "OPENCV_FISHEYE":
            radius = np.hypot(local[:, 0], local[:, 1])
            theta = np.arctan2(radius, depth)
            visible = theta < _fold(top, bottom, np.pi)
            radial = np.where(radius > 0, theta * polynomial.polyval(theta**2, top) / radius, 0.0)
            x, y = local[:, 0] * radial, local[:, 1] * radial
        else:
            u, v = local[:, 0] / depth, local[:, 1] / depth
            visible = (depth > 0) & (np.hypot(u, v) < _fold(top, bottom))
            x, y = _distorted(u, v, top, bottom, k["p1"], k["p2"])
        pixels = np.stack([k["fx"] * x + k["cx"], k["fy"] * y + k["cy"]], -1)
    pixels[~visible] = np.nan
    return pixels, depth


def fold_radius(camera: Camera) -> float:
    """The distance from the view axis, on the plane at distance one (of a fisheye: the angle), up to which the lens's model holds; infinity for most."""
    return _fold(*_radial_polynomials(camera), np.pi if camera.model == "OPENCV_FISHEYE" else np.inf)


def resized(camera: Camera, width: int, height: int) -> Camera:
    """The camera of the same image at another size; exact also where rounding scales width and height by different amounts."""
    along_x, along_y = width / camera.width, height / camera.height
    if along_x == along_y == 1.0:
        return camera
    named = camera.intrinsics
    model = camera.model if along_x == along_y else _TWO_FOCAL_LENGTHS.get(camera.model, camera.model)
    named |= {"fx": named["fx"] * along_x, "fy": named["fy"] * along_y, "cx": named["cx"] * along_x, "cy": named["cy"] * along_y}
    named["f"] = named["fx"]
    return replace(camera, width=width, height=height, model=model, params=tuple(named[p] for p in MODELS[model]))


def rows_of(camera: Camera, begin: int, end: int) -> Camera:
    """The camera of the rows `begin` to `end` of an image alone."""
    named = camera.intrinsics
    named |= {"cy": named["cy"] - begin, "f": named["fx"]}
    return replace(camera, height=end - begin, params=tuple(named[p] for p in MODELS[camera.model]))


def rotated_clockwise(camera: Camera) -> Camera:
    """The camera of the image rotated clockwise by 90 degrees; width and height are swapped. A world point stays at its place in the image."""
    k = camera.intrinsics
    turned = k | {"fx": k["fy"], "fy": k["fx"], "cx": camera.height - k["cy"], "cy": k["cx"], "f": k["fx"], "p1": k["p2"], "p2": -k["p1"]}
    pose = camera.world_from_camera.copy()
    pose[:3, 0], pose[:3, 1] = -camera.world_from_camera[:3, 1], camera.world_from_camera[:3, 0]  # right of the rotated image is up of the old one
    params = tuple(turned[p] for p in MODELS[camera.model])
    return replace(camera, width=camera.height, height=camera.width, params=params, world_from_camera=pose)


def pose_from_opengl(world_from_camera: np.ndarray) -> np.ndarray:
    """(4, 4) of Blender, NeRF, nerfstudio, glTF (x right, y up, looking along -z) -> (4, 4) with the project's axes. Its own inverse."""
    return np.asarray(world_from_camera, np.float64) @ np.diag([1.0, -1.0, -1.0, 1.0])


opengl_from_pose = pose_from_opengl


def pose_from_llff(matrix: np.ndarray) -> np.ndarray:
    """(3, 4) of poses_bounds.npy, whose camera columns are down, right, back and the position -> (4, 4)."""
    down, right, back, position = np.asarray(matrix, np.float64).T
    pose = np.eye(4)
    pose[:3] = np.stack([right, down, -back, position], -1)
    return pose


def pose_from_colmap(quaternion: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """COLMAP's world to camera (quaternion w x y z, translation (3,)) -> (4, 4) camera to world."""
    w, x, y, z = np.asarray(quaternion, np.float64) / np.linalg.norm(quaternion)
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    pose = np.eye(4)
    pose[:3, :3] = rotation.T
    pose[:3, 3] = -rotation.T @ np.asarray(translation, np.float64)
    return pose


def _radial_polynomials(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """The radial factor top(s) / bottom(s), s the squared radius (or theta squared), as coefficients from the constant up."""
    k = camera.intrinsics
    if camera.model == "OPENCV_FISHEYE":
        return np.array([1.0, k["k1"], k["k2"], k["k3"], k["k4"]]), np.array([1.0])
    return np.array([1.0, k["k1"], k["k2"], k["k3"]]), np.array([1.0, k["k4"], k["k5"], k["k6"]])


def _fold(top: np.ndarray, bottom: np.ndarray, limit: float = np.inf) -> float:
    """The radius up to which r top(r^2) / bottom(r^2) grows: beyond it the model does not describe the lens."""
    times_s = np.array([0.0, 1.0])
    # d/dr [r top/bottom] = (top bottom + 2 s (top' bottom - top bottom')) / bottom^2
    bend = polynomial.polysub(polynomial.polymul(polynomial.polyder(top), bottom), polynomial.polymul(top, polynomial.polyder(bottom)))
    slope = polynomial.polyadd(polynomial.polymul(top, bottom), 2 * polynomial.polymul(times_s, bend))
    for coefficients in (slope, bottom):
        coefficients = np.trim_zeros(coefficients, "b")
        if len(coefficients) > 1:
            roots = polynomial.polyroots(coefficients)
            real = roots.real[(np.abs(roots.imag) < 1e-9 * (1 + np.abs(roots.real))) & (roots.real > 0)]
            limit = min(limit, float(np.sqrt(real.min()))) if len(real) else limit
    return limit


def _invert_radial(radius: np.ndarray, top: np.ndarray, bottom: np.ndarray, limit: float = np.inf) -> np.ndarray:
    """r with r top(r^2) / bottom(r^2) = radius (N,), below the fold, by Newton's method held between bounds."""
    if not top[1:].any() and not bottom[1:].any():
        return np.minimum(radius, limit)
    fold = _fold(top, bottom, limit)
    low = np.zeros_like(radius)
    high = np.full_like(radius, fold if np.isfinite(fold) else 1e6)
    r = np.minimum(radius, 0.999 * high)
    top_slope, bottom_slope = polynomial.polyder(top), polynomial.polyder(bottom)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for _ in range(100):
            s = r * r
            a, b = polynomial.polyval(s, top), polynomial.polyval(s, bottom)
            off = r * a / b - radius
            slope = a / b + 2 * s * (polynomial.polyval(s, top_slope) * b - a * polynomial.polyval(s, bottom_slope)) / (b * b)
            high = np.where(off > 0, r, high)
            low = np.where(off > 0, low, r)
            step = r - off / slope
            following = np.where((step >= low) & (step <= high), step, 0.5 * (low + high))
            if np.abs(following - r).max(initial=0.0) < 1e-14:
                return following
            r = following
    return r


def _distorted(u: np.ndarray, v: np.ndarray, top: np.ndarray, bottom: np.ndarray, p1: float, p2: float) -> tuple[np.ndarray, np.ndarray]:
    s = u * u + v * v
    radial = polynomial.polyval(s, top) / polynomial.polyval(s, bottom)
    x = u * radial + 2 * p1 * u * v + p2 * (s + 2 * u * u)
    y = v * radial + 2 * p2 * u * v + p1 * (s + 2 * v * v)
    return x, y


def _undistorted(camera: Camera, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(u, v) whose distortion is (x, y): the radial part first, then Newton's method in two dimensions where there is a tangential part."""
    k = camera.intrinsics
    p1, p2 = k["p1"], k["p2"]
    top, bottom = _radial_polynomials(camera)
    radius = np.hypot(x, y)
    shrink = np.divide(_invert_radial(radius, top, bottom), radius, out=np.ones_like(radius), where=radius > 0)
    u, v = x * shrink, y * shrink
    if p1 == 0.0 and p2 == 0.0:
        return u, v
    fold = _fold(top, bottom)
    top_slope, bottom_slope = polynomial.polyder(top), polynomial.polyder(bottom)
    for _ in range(30):
        s = u * u + v * v
        a, b = polynomial.polyval(s, top), polynomial.polyval(s, bottom)
        radial, slope = a / b, (polynomial.polyval(s, top_slope) * b - a * polynomial.polyval(s, bottom_slope)) / (b * b)
        now_x, now_y = _distorted(u, v, top, bottom, p1, p2)
        off_x, off_y = now_x - x, now_y - y
        xx = radial + 2 * u * u * slope + 2 * p1 * v + 6 * p2 * u
        yy = radial + 2 * v * v * slope + 6 * p1 * v + 2 * p2 * u
        xy = 2 * u * v * slope + 2 * p1 * u + 2 * p2 * v
        determinant = np.maximum(xx * yy - xy * xy, 1e-6)  # near the fold the step would leave the lens
        step_u, step_v = (yy * off_x - xy * off_y) / determinant, (xx * off_y - xy * off_x) / determinant
        u, v = u - step_u, v - step_v
        inside = np.minimum(1.0, fold / np.maximum(np.hypot(u, v), 1e-12))
        u, v = u * inside, v * inside
        if max(np.abs(step_u).max(initial=0.0), np.abs(step_v).max(initial=0.0)) < 1e-14:
            break
    return u, v
