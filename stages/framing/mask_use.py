"""What masks and alpha channels mean: silhouettes, outside of which is background, or pixels that are to be ignored.

Silhouettes keep one compact object in nearly all photographs: they cut most of the picture's border off, what is left holds together, and all of them are
views of one thing, so that the visual hull projects onto them. Masks that leave out small or moving parts keep most of the picture, and its border.
See docs/experiments/silhouettes.md.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from efficientnerf.geometry.cameras import Camera, project, resized
from pipeline.errors import BadInput
from stages.formats.importers.source import MIN_IMAGES, abbreviated
from stages.framing import scene_bounds
from stages.framing.training_frame import focus_point
from stages.io.capture import Capture, Photo, Silhouettes
from stages.io.pictures import UnreadableImage, read_header
from stages.io.reader import PhotoReader

# docs/experiments/silhouettes.md
MIN_AGREEING = 0.9  # of the photographs, that keep one compact object
MOST_KEPT, LEAST_KEPT = 0.8, 0.002  # of the picture
MOST_OF_BORDER = 0.4  # of the pixels along the picture's border that a silhouette keeps
PARTS, LEAST_OF_PARTS = 5, 0.9  # the largest connected parts of a compact object hold so much of it
SAME, HALF = 0.97, 0.5  # overlap of all masks, and share kept, from which they are of a lens, not of an object
LEAST_OVERLAP = 0.7  # intersection over union of a silhouette and the projected visual hull

WRONG_CAMERAS = "; the cameras that were found from the photographs may be wrong"


@dataclass(frozen=True)
class MaskUse:
    """The meaning of a capture's masks and alpha channels, and why."""

    silhouettes: Silhouettes = field(default_factory=Silhouettes)  # which of them are silhouettes
    reasons: dict[str, str] = field(default_factory=dict)  # "alpha" and "masks" -> why, of those that there are
    doubtful: tuple[str, ...] = ()  # names of photographs whose silhouettes do not fit to the others'

    @property
    def sentences(self) -> list[str]:
        names = {"alpha": "alpha channels", "masks": "masks"}
        use = {True: "are silhouettes", False: "leave pixels out"}
        return [f"{names[kind]} {use[getattr(self.silhouettes, kind)]}: {why}" for kind, why in self.reasons.items()]

    @property
    def facts(self) -> dict[str, object]:
        """For the report."""
        use = {True: "silhouette", False: "ignore"}
        return {kind: {"use": use[getattr(self.silhouettes, kind)], "because": why} for kind, why in self.reasons.items()}


def find_mask_use(capture: Capture, choice: str, renders: bool, reader: PhotoReader, safe_point: Callable[[], None] = lambda: None) -> MaskUse:
    """Decide what masks and alpha channels mean.

    choice   the setting: "auto", "silhouette" or "ignore"
    renders  whether the capture's format may hold renders of an object, as transforms.json may
    """
    photos = capture.photos
    there = {"alpha": sum(map(has_alpha, photos)), "masks": sum(photo.mask is not None for photo in photos)}
    if choice != "auto":
        reasons = {kind: "poses.masks says so" for kind, count in there.items() if count}
        wanted = choice == "silhouette"
        # Images without alpha may be renders on a constant background.
        return MaskUse(Silhouettes(wanted and (there["alpha"] > 0 or not there["masks"]), wanted and there["masks"] > 0), reasons)
    use, reasons = {"alpha": False, "masks": False}, {}
    doubtful: list[str] = []
    if there["alpha"]:
        pictures = _pictures(photos, reader.alpha, safe_point)
        if any(picture is not None and (picture < 255).any() for _, picture in pictures):
            rendered = renders and there["alpha"] == len(photos)
            use["alpha"], reasons["alpha"], doubtful = (*_of_renders(pictures), []) if rendered else _of_photographs(capture, pictures)
    if there["masks"]:
        if all(photo.mask_ignore == "white" for photo in photos if photo.mask is not None):
            reasons["masks"] = "they mark what moves"
        else:
            use["masks"], reasons["masks"], names = _of_photographs(capture, _pictures(photos, reader.mask, safe_point))
            doubtful += names
    return MaskUse(Silhouettes(use["alpha"], use["masks"]), reasons, tuple(dict.fromkeys(doubtful)))


def without_silhouette(photos: Sequence[Photo], silhouettes: Silhouettes) -> list[str]:
    """Names of the photos of which nothing says what is background, in a capture whose others do. Raises BadInput where too few are left."""
    have = [(silhouettes.masks and photo.mask is not None) or (silhouettes.alpha and has_alpha(photo)) for photo in photos]
    if not silhouettes or all(have) or not any(have):
        return []  # without any these are renders on a constant background
    if sum(have) < MIN_IMAGES:
        raise BadInput(f"poses.masks silhouette: {sum(have)} of {len(have)} images have a mask or an alpha channel; at least {MIN_IMAGES} are needed.")
    return [photo.camera.name for photo, has in zip(photos, have, strict=True) if not has]


def compactness(kept: np.ndarray) -> str | None:
    """Why what a mask keeps, (h, w) bool, is no compact object; None where it is one."""
    share = float(kept.mean())
    if share > MOST_KEPT:
        return f"keep more than {MOST_KEPT:.0%} of the picture"
    if share < LEAST_KEPT:
        return "keep next to nothing"
    if along_border(kept).mean() > MOST_OF_BORDER:
        return f"keep more than {MOST_OF_BORDER:.0%} of the picture's border"
    _, labels = cv2.connectedComponents(kept.astype(np.uint8), connectivity=8)
    sizes = np.sort(np.bincount(labels[kept]))[::-1]
    if sizes[:PARTS].sum() < LEAST_OF_PARTS * kept.sum():
        return f"keep more than {PARTS} parts"
    return None


def along_border(kept: np.ndarray) -> np.ndarray:
    """(N,) the pixels along the border of a picture (h, w)."""
    return np.concatenate([kept[0], kept[-1], kept[1:-1, 0], kept[1:-1, -1]])


def finer_hull(pictures: Sequence[np.ndarray], cameras: Sequence[Camera], hull: np.ndarray, step: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centres (N, 3) and sides (3,) of the voxels of a hull, split, without those whose centre is outside of a silhouette.

    pictures   (h, w) bool each
    hull, step centres (N, 3) of the voxels of a hull that leaves nothing out, and their sides (3,)
    """
    corners = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
    xyz, step = (hull[:, None] + corners * step / 4).reshape(-1, 3), step / 2
    against = np.zeros(len(xyz), int)
    for picture, camera in zip(pictures, cameras, strict=True):
        index, column, row = _pixels(xyz, resized(camera, picture.shape[1], picture.shape[0]))
        against[index] += ~picture[row, column]
    return xyz[against <= len(pictures) // 50], step


def projection(xyz: np.ndarray, step: np.ndarray, camera: Camera, shape: tuple[int, ...]) -> np.ndarray:
    """(h, w) bool: where voxels with centres (N, 3) and sides (3,) are shown in a camera's picture of this shape."""
    camera = resized(camera, shape[1], shape[0])
    index, column, row = _pixels(xyz, camera)
    drawn = np.zeros(shape, np.uint8)
    drawn[row, column] = 1
    depth = float(np.median(project(camera, xyz[index])[1])) if len(index) else 1.0
    reach = max(1, round(float(step.max()) * camera.intrinsics["fx"] / depth))  # of a voxel, px
    return np.asarray(cv2.morphologyEx(drawn, cv2.MORPH_CLOSE, np.ones((2 * reach + 1,) * 2, np.uint8)) > 0)


def _pixels(xyz: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Index of each point (N, 3) that a camera has in view, and the column and row of its pixel."""
    shown = np.flatnonzero(scene_bounds.shows(xyz, camera))
    column, row = np.minimum(np.floor(project(camera, xyz[shown])[0]).astype(int), (camera.width - 1, camera.height - 1)).T
    return shown, column, row


def has_alpha(photo: Photo) -> bool:
    """Whether its file has an alpha channel; False where it cannot be read."""
    try:
        return read_header(photo.image).alpha
    except UnreadableImage:
        return False


def _pictures(photos: Sequence[Photo], read: Callable[[Photo], np.ndarray | None], safe_point: Callable[[], None]) -> list[tuple[Photo, np.ndarray | None]]:
    found = []
    for photo in scene_bounds.chosen_photos(photos):
        safe_point()
        found.append((photo, read(photo)))
    return found


def _of_renders(pictures: Sequence[tuple[Photo, np.ndarray | None]]) -> tuple[bool, str]:
    """For images that all have an alpha channel, in a format that renders come in: where most are transparent somewhere, they show an object."""
    alphas = [picture for _, picture in pictures if picture is not None]  # images that cannot be read have no say
    transparent = [alpha for alpha in alphas if (alpha < 255).any()]
    if 2 * len(transparent) <= len(alphas):
        return False, f"{len(alphas) - len(transparent)} of {len(alphas)} images are opaque"
    cut_out = [alpha for alpha in transparent if compactness(alpha >= 128) != f"keep more than {MOST_KEPT:.0%} of the picture"]
    if 2 * len(cut_out) <= len(transparent):
        return False, f"{len(transparent) - len(cut_out)} of {len(alphas)} images keep more than {MOST_KEPT:.0%} of the picture"
    return True, "every image has an alpha channel, and most are transparent somewhere, as renders of an object are"


def alike(pictures: Sequence[tuple[Photo, np.ndarray | None]]) -> tuple[str, list[tuple[Photo, np.ndarray]]]:
    """Why these cannot be silhouettes of an object, by the pictures alone, or nothing; and those that keep one compact object, as bool."""
    count = len(pictures)
    verdicts = [("have none" if picture is None else compactness(picture >= 128)) for _, picture in pictures]
    good = [(photo, picture >= 128) for (photo, picture), verdict in zip(pictures, verdicts, strict=True) if picture is not None and verdict is None]
    if len(good) < max(MIN_IMAGES, MIN_AGREEING * count):
        against = Counter(verdict for verdict in verdicts if verdict is not None).most_common(1)
        return f"{against[0][1]} of {count} photographs {against[0][0]}" if against else f"there are only {count} photographs", good
    return "they are the same in all photographs" if _same([picture for _, picture in good]) else "", good


def _of_photographs(capture: Capture, pictures: Sequence[tuple[Photo, np.ndarray | None]]) -> tuple[bool, str, list[str]]:
    """Whether these are silhouettes, why, and the names of those that do not fit the others."""
    why_not, good = alike(pictures)
    if why_not:
        return False, why_not, []
    masks, overlap = [picture for _, picture in good], hull_overlaps(capture, good)
    fits = overlap >= LEAST_OVERLAP
    if fits.mean() < MIN_AGREEING:
        found = WRONG_CAMERAS if capture.kind == "photographs" else ""
        return False, f"no object has all of these silhouettes: {fits.sum()} of {len(fits)} fit to their visual hull{found}", []
    shares = [float(mask.mean()) for mask in masks]
    why = (
        f"{len(good)} of {len(pictures)} photographs keep one object, {min(shares):.0%} to {max(shares):.0%} of the picture,"
        f" and its visual hull projects onto them (overlap {np.median(overlap):.0%})"
    )
    return True, why, [photo.camera.name for (photo, _), fit in zip(good, fits, strict=True) if not fit]


def hull_of(capture: Capture, pictures: Sequence[tuple[Photo, np.ndarray]]) -> tuple[np.ndarray, np.ndarray] | None:
    """Centres (N, 3) and sides (3,) of the voxels of the visual hull of silhouettes, (h, w) bool each; None where it is empty."""
    cameras, masks = [photo.camera for photo, _ in pictures], [picture for _, picture in pictures]
    focus, converging = focus_point(capture)
    hull = scene_bounds.whole_visual_hull(masks, cameras, [(photo.near, photo.far) for photo, _ in pictures], focus, converging)
    return None if hull is None else finer_hull(masks, cameras, *hull)


def hull_overlaps(capture: Capture, pictures: Sequence[tuple[Photo, np.ndarray]]) -> np.ndarray:
    """(C,) intersection over union of silhouettes, (h, w) bool each, and the projection of their own visual hull; 0 where that is empty."""
    hull = hull_of(capture, pictures)
    if hull is None:
        return np.zeros(len(pictures))
    shown = [projection(*hull, photo.camera, picture.shape) for photo, picture in pictures]
    return np.array([(one & other).sum() / max(int((one | other).sum()), 1) for one, (_, other) in zip(shown, pictures, strict=True)])


def share_that_fits(capture: Capture, kind: Silhouettes, reader: PhotoReader) -> float:
    """How many of the capture's silhouettes fit to their visual hull: a test of the cameras by what they were not found from."""
    photos = scene_bounds.chosen_photos(capture.photos)
    pictures = [(photo, picture >= 128) for photo in photos if (picture := reader.mask(photo) if kind.masks else reader.alpha(photo)) is not None]
    return float((hull_overlaps(capture, pictures) >= LEAST_OVERLAP).mean()) if len(pictures) >= MIN_IMAGES else 0.0


def _same(masks: Sequence[np.ndarray]) -> bool:
    """Whether masks are one large shape in all photographs, as the round picture of a fisheye lens: not an object's."""
    if len({mask.shape for mask in masks}) > 1:
        return False
    stack = np.stack(masks)
    return bool(stack.all(0).sum() >= SAME * stack.any(0).sum() and stack.mean() > HALF)


def points_of_object(capture: Capture, reader: PhotoReader) -> np.ndarray:
    """(N,) bool: the sparse points that lie in the silhouettes of nearly all photographs that have them in view. Others are background."""
    assert capture.points is not None
    xyz = capture.points.xyz
    views, within = np.zeros(len(xyz), int), np.zeros(len(xyz), int)
    for photo in scene_bounds.chosen_photos(capture.photos):
        picture = reader.silhouette(photo, capture.silhouettes)
        if picture is None or not picture.any():
            continue  # an empty one is left out later
        camera = resized(photo.camera, picture.shape[1], picture.shape[0])
        index, column, row = _pixels(xyz, camera)
        views[index] += 1
        within[index] += picture[row, column]
    return within >= MIN_AGREEING * views


def doubts(use: MaskUse) -> list[str]:
    """Warnings about silhouettes that do not fit to the others', or to the cameras that were found."""
    sentences = [f"{kind}: {why}." for kind, why in use.reasons.items() if why.endswith(WRONG_CAMERAS)]
    if use.doubtful:
        sentences.append(f"the silhouettes of {len(use.doubtful)} photographs do not fit the others': {abbreviated(use.doubtful)}.")
    return sentences
