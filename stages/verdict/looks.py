"""How each photograph of a capture looks: sharp or blurred, bright or dark, and which of them are the same picture twice."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from efficientnerf.capture.compression import block_steps, is_strong
from stages.io.photo import apply_exif_orientation
from stages.io.pictures import UnreadableImage, opened, orientation_of, read_quality, rgb_and_alpha

SIDE = 640  # px, longest side that photographs are looked at with; docs/experiments/sfm.md
NOISE = 0.8  # px, standard deviation of a blur that takes noise away
COARSE = 8  # px between pixels that differ in a blurred photograph, too
SMALL = (24, 16)  # px, of the picture that others are compared with
OPAQUE, PAPER = 128, 128  # alpha from which a pixel counts; level of the others
CLIPPED = (4, 250)  # levels without detail
BLURRED = 0.15  # sharpness below which a photograph is blurred, whatever the others are
LESS_SHARP = 0.77  # share of the capture's median, below which it is blurred among sharp ones
STEP = 0.75  # stops from the capture's median that are a step of exposure
DARK = -6.0  # stops below white, of the mean of linear light: little but noise is left
MOST_CLIPPED = 0.4  # share of pixels without detail
MAX_DUPLICATE_ERROR = 1.5  # of 255, root mean square between two small pictures that are the same
NOISY = 12.0  # of 255, standard deviation of noise that hides weak features; docs/experiments/sfm.md
LAPLACIANS = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)  # their difference: of edges hardly anything is left
BLOCK, LEAST_BLOCKS = 16, 9  # px; a picture of fewer is not judged
LEAST_POINTS = 30  # that a photograph's exposure is judged by
FLAT = 4.0  # of 255, standard deviation of a small picture that all others of its kind would be the same as


@dataclass(frozen=True)
class Look:
    """Of one photograph."""

    sharpness: float  # root of the mean square of differences between neighbouring pixels, over that of pixels COARSE apart; 0 of no texture
    brightness: float  # stops: log2 of the mean of linear light, 0 is white
    clipped: float  # share of pixels that are black or white
    noise: float  # levels, standard deviation: of a quarter of the blocks there is less
    longest: int  # px of the longest side, as far as it was looked at
    small: np.ndarray  # (16, 24) float32 levels
    compressed: bool = False  # whether it was compressed so strongly that its blocks show
    over_points: float | None = None  # `over_points`; None where that is not known

    def figures(self) -> dict[str, float | bool]:
        """As JSON has them."""
        rounded = {"sharpness": round(self.sharpness, 3), "brightness": round(self.brightness, 2), "clipped": round(self.clipped, 3)}
        return {**rounded, "noise": round(self.noise, 1), "compressed": self.compressed}


def look_at(path: Path, source: Path | None = None) -> Look:
    """
    source  the file that the picture was taken from, where `path` is a copy, which may be reduced

    Raises UnreadableImage.
    """
    return look(grey_of(path), read_quality(source or path))


def grey_of(path: Path) -> np.ndarray:
    """(H, W) uint8 of a photograph as it is meant to be seen, of a longest side of SIDE or more where it has that; what is transparent is grey. Raises
    UnreadableImage."""
    with opened(path) as image:
        image.draft("RGB", (SIDE, SIDE))
        orientation = orientation_of(image)
        rgb, alpha = rgb_and_alpha(image)
    grey = cv2.cvtColor(np.ascontiguousarray(rgb), cv2.COLOR_RGB2GRAY)
    if alpha is not None:
        grey = np.where(alpha >= OPAQUE, grey, np.uint8(PAPER))
    return np.ascontiguousarray(apply_exif_orientation(grey, orientation))


def look(grey: np.ndarray, quality: int | None = None) -> Look:
    """
    grey     (H, W) uint8, sRGB
    quality  of the JPEG that it comes from
    """
    scale = SIDE / max(grey.shape)
    size = (max(1, round(grey.shape[1] * scale)), max(1, round(grey.shape[0] * scale)))
    picture = (grey if scale >= 1 else cv2.resize(grey, size, interpolation=cv2.INTER_AREA)).astype(np.float32)
    linear = (picture / 255.0) ** 2.2
    return Look(
        sharpness=_sharpness(picture),
        brightness=float(np.log2(max(float(linear.mean(dtype=np.float64)), 2.0**-12))),
        clipped=float(((picture <= CLIPPED[0]) | (picture >= CLIPPED[1])).mean()),
        noise=_noise(picture),
        longest=max(grey.shape),
        small=cv2.resize(picture, SMALL, interpolation=cv2.INTER_AREA),
        compressed=is_strong(quality, *block_steps(grey)),
    )


def _sharpness(picture: np.ndarray) -> float:
    """The lesser of both axes: a camera that is moved blurs along one."""
    picture = cv2.GaussianBlur(picture, (0, 0), NOISE)
    found = []
    for axis in (0, 1):
        if picture.shape[axis] <= COARSE:
            continue
        near, far = (_squares(picture, step, axis) for step in (1, COARSE))
        found.append(np.sqrt(near / far) if far > 0 else 0.0)
    return float(min(found, default=0.0))


def _squares(picture: np.ndarray, step: int, axis: int) -> float:
    """Mean square of the differences between pixels `step` apart."""
    difference = picture[step:] - picture[:-step] if axis == 0 else picture[:, step:] - picture[:, :-step]
    return float((difference**2).mean(dtype=np.float64))


def _noise(picture: np.ndarray) -> float:
    """The standard deviation by the median of the difference of two Laplacians (Immerkaer 1996) in each block, whose lower quartile has little texture."""
    rows, columns = (size // BLOCK for size in picture.shape)
    if rows * columns < LEAST_BLOCKS:
        return 0.0
    response = np.abs(cv2.filter2D(picture, -1, LAPLACIANS))[: rows * BLOCK, : columns * BLOCK]
    blocks = response.reshape(rows, BLOCK, columns, BLOCK).swapaxes(1, 2).reshape(-1, BLOCK * BLOCK)  # (blocks, pixels)
    return float(np.percentile(np.median(blocks, axis=1), 25)) / (0.6745 * float(np.linalg.norm(LAPLACIANS)))


def look_at_all(paths: Mapping[str, Path], sources: Mapping[str, Path] | None = None) -> dict[str, Look]:
    """Of each photograph that can be read, by its name. sources: as `look_at` takes them."""
    found = {}
    for name, path in paths.items():
        try:
            found[name] = look_at(path, (sources or {}).get(name))
        except UnreadableImage:
            continue
    return found


def blurred(looks: Mapping[str, Look]) -> list[str]:
    """The names of those that are blurred, by themselves or among sharper ones."""
    if not looks:
        return []
    least = max(BLURRED, LESS_SHARP * float(np.median([each.sharpness for each in looks.values()])))
    return sorted(name for name, each in looks.items() if each.sharpness < least)


def over_points(grey: np.ndarray, pixels: np.ndarray, light: np.ndarray) -> float | None:
    """Stops that a photograph is exposed longer than others are, by what it shows of points; None of fewer than LEAST_POINTS.

    grey    (H, W) uint8, sRGB
    pixels  (N, 2) where it shows the points
    light   (N,) what photographs show of each on average, linear
    """
    height, width = grey.shape
    inside = ((pixels >= 0) & (pixels < (width, height))).all(axis=1) & (light > 0)
    x, y = pixels[inside].astype(np.int64).T
    own = grey[y, x]
    tells = (own > CLIPPED[0]) & (own < CLIPPED[1])
    if tells.sum() < LEAST_POINTS:
        return None
    return float(np.median(np.log2((own[tells] / 255.0) ** 2.2) - np.log2(light[inside][tells])))


def of_other_exposure(looks: Mapping[str, Look]) -> list[str]:
    """The names of those that are exposed longer or shorter than the others: by the points that they show, where half of them show enough; else by how bright
    they are, which depends on what is in them, too."""
    stops = {name: each.over_points for name, each in looks.items() if each.over_points is not None}
    if 2 * len(stops) < len(looks):
        stops = {name: each.brightness for name, each in looks.items()}
    middle = float(np.median(list(stops.values()))) if stops else 0.0
    return sorted(name for name, each in stops.items() if abs(each - middle) > STEP)


def duplicates(looks: Mapping[str, Look]) -> dict[str, str]:
    """Name -> name of the first photograph that is the same picture."""
    names = sorted(looks)
    small = np.stack([looks[name].small.ravel() for name in names]).astype(np.float64) if names else np.zeros((0, 1))
    found: dict[str, str] = {}
    for i in range(1, len(names)):
        if small[i].std() < FLAT:
            continue
        apart = np.sqrt(((small[:i] - small[i]) ** 2).mean(1))
        first = int(np.argmax(apart < MAX_DUPLICATE_ERROR))
        if apart[first] < MAX_DUPLICATE_ERROR:
            found[names[i]] = found.get(names[first], names[first])
    return found
