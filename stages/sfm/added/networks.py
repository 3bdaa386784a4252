"""Features and matches by networks that the user has: ALIKED and LightGlue as public exports to ONNX keep them, run by onnxruntime. Nothing is downloaded.

A detector takes `image` (1, 3, h, w) RGB from 0 to 1 and gives `keypoints` (N, 2), `descriptors` (N, D) and mostly `scores` (N,), with or without a first axis
of 1; key points are in pixels, or from -1 at the middle of the first pixel to 1 at that of the last. COLMAP's exports also take `max_keypoints` and
`min_score`. A matcher takes `kpts0`, `kpts1` (1, N, 2) and `desc0`, `desc1` (1, N, D), of COLMAP's exports in pixels with `image_size0` and `image_size1`
(1, 2), of LightGlue-ONNX's from the middle of the picture over half of its longest side; it gives `matches0`, (M, 2) pairs or for each feature of the first
picture that of the second or -1, and `mscores0`.
"""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from pipeline.errors import UsageError
from stages.io.network_file import Network, in_words

OPTION = "--features-model"
LONGEST_SIDE = 1024  # px of a picture that a detector is given, where it takes any size: as LightGlue's authors have it
DIVISOR = 32  # of the sides of that picture: ALIKED halves it five times
MIN_SCORE = 0.1  # of a feature, where the network takes a limit; and of a match: LightGlue's own and COLMAP's default
MIN_MATCHES = 15  # features of a picture and matches of a pair: fewer verify nothing, as the mapper has it
_IN_BOUNDS = 1.001  # of key points from -1 to 1


@dataclass(frozen=True, eq=False)
class Features:
    """Of a picture."""

    xy: np.ndarray  # (N, 2) float64 px of the picture as it was given, from its corner
    seen: np.ndarray  # (N, 2) float32 px of the picture as the network saw it, from the middle of its first pixel
    size: tuple[int, int]  # width and height of that, px
    descriptors: np.ndarray  # (N, D) float32


class Detector(Network):
    def __init__(self, path: Path) -> None:
        expected = "Expected ALIKED: image in; keypoints, descriptors and scores out. A file that holds detector and matcher has to be exported as two."
        super().__init__(path, OPTION, 1, "detects features", expected)  # one thread: pictures are worked on side by side, and no sum depends on their number
        images = [each for each in self.inputs if len(each.shape) == 4]
        extra = {each.name for each in self.inputs} - {each.name for each in images}
        of_colours = [each for each in images if each.type == "tensor(float)" and (each.shape[1] == 3 or not isinstance(each.shape[1], int))]
        if len(images) != 1 or not of_colours or not extra <= {"max_keypoints", "min_score"}:
            raise self.refused(f"it takes {in_words(self.inputs)}")
        self._given = {each.name for each in self.outputs}
        if not {"keypoints", "descriptors"} <= self._given:
            raise self.refused(f"it gives {in_words(self.outputs)}")
        self._input, self._extra = images[0].name, extra
        self._fixed = [side if isinstance(side, int) and side > 0 else None for side in images[0].shape[2:]]  # height, width

    def features(self, rgb: np.ndarray, mask: np.ndarray | None, most: int) -> Features:
        """The strongest features, at most so many, of an sRGB picture (H, W, 3) uint8, where the mask (H, W) uint8 is not black."""
        height, width = rgb.shape[:2]
        limits = [side or LONGEST_SIDE for side in self._fixed]
        scale = min(1.0 if None in self._fixed else np.inf, limits[0] / height, limits[1] / width)
        small = max(1, round(height * scale)), max(1, round(width * scale))
        picture = cv2.resize(rgb, small[::-1], interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
        padded = [fixed or -(-side // DIVISOR) * DIVISOR for side, fixed in zip(small, self._fixed, strict=True)]
        picture = np.pad(picture, ((0, padded[0] - small[0]), (0, padded[1] - small[1]), (0, 0)), mode="edge")
        inputs = {self._input: np.ascontiguousarray(picture.transpose(2, 0, 1)[None], np.float32) / np.float32(255)}
        extra: dict[str, np.ndarray] = {"max_keypoints": np.array(most, np.int64), "min_score": np.array(MIN_SCORE, np.float32)}
        inputs |= {name: extra[name] for name in self._extra}
        names = ["keypoints", "descriptors", *(["scores"] if "scores" in self._given else [])]
        found = dict(zip(names, self.run(names, inputs), strict=True))
        keypoints, descriptors = (found[name][0] if found[name].ndim == 3 and len(found[name]) == 1 else found[name] for name in names[:2])
        scores = np.asarray(found.get("scores", np.ones(len(keypoints)))).reshape(-1)
        if keypoints.ndim != 2 or keypoints.shape[1] != 2 or descriptors.ndim != 2 or not len(keypoints) == len(descriptors) == len(scores):
            raise self.refused(f"it gives key points {keypoints.shape}, descriptors {descriptors.shape} and scores {scores.shape}")
        if not all(np.isfinite(each).all() for each in (keypoints, descriptors, scores)):
            raise self.refused("it gives what is no number")
        seen = np.asarray(keypoints, np.float64)
        if np.abs(seen).max(initial=0.0) <= _IN_BOUNDS:
            seen = (seen + 1) / 2 * (np.array(padded[::-1]) - 1)
        xy = (seen + 0.5) * (width / small[1], height / small[0])
        inside = ((xy >= 0) & (xy < (width, height))).all(1)
        if mask is not None:
            inside[inside] = mask[tuple(xy[inside].astype(np.int64).T[::-1])] > 0
        kept = np.flatnonzero(inside)
        kept = kept[np.argsort(-scores[kept], kind="stable")[:most]]
        return Features(xy[kept], seen[kept].astype(np.float32), (small[1], small[0]), np.asarray(descriptors[kept], np.float32))


class Matcher(Network):
    def __init__(self, path: Path) -> None:
        expected = "Expected LightGlue: kpts0, kpts1, desc0, desc1 in, as LightGlue-ONNX or COLMAP export it; matches0 and mscores0 out."
        super().__init__(path, OPTION, 1, "matches features", expected)
        names, features, sizes = {each.name for each in self.inputs}, {"kpts0", "kpts1", "desc0", "desc1"}, {"image_size0", "image_size1"}
        if names not in (features, features | sizes):
            raise self.refused(f"it takes {in_words(self.inputs)}")
        if not {"matches0", "mscores0"} <= {each.name for each in self.outputs}:
            raise self.refused(f"it gives {in_words(self.outputs)}")
        self._in_pixels = names != features

    def matches(self, one: Features, other: Features) -> np.ndarray:
        """(M, 2) uint32, the numbers of the features that are the same in two pictures."""
        if min(len(one.xy), len(other.xy)) < MIN_MATCHES:
            return np.zeros((0, 2), np.uint32)
        inputs: dict[str, np.ndarray] = {}
        for k, each in enumerate((one, other)):
            size = np.array(each.size, np.float32)
            inputs[f"kpts{k}"] = (each.seen if self._in_pixels else (each.seen - size / 2) / (size.max() / 2))[None].astype(np.float32)
            inputs[f"desc{k}"] = each.descriptors[None]
            if self._in_pixels:
                inputs[f"image_size{k}"] = size[None]
        matches, scores = self.run(["matches0", "mscores0"], inputs)
        pairs, scores = self._pairs(matches, len(one.xy)), scores.reshape(-1)
        if len(pairs) != len(scores):
            raise self.refused(f"it gives matches {matches.shape} and scores {scores.shape}")
        pairs = pairs[(scores >= MIN_SCORE) & (pairs >= 0).all(1)]
        if (pairs >= (len(one.xy), len(other.xy))).any():
            raise self.refused("it matches features that there are not")
        return np.asarray(pairs, np.uint32)

    def _pairs(self, matches: np.ndarray, count: int) -> np.ndarray:
        """(M, 2) of either of the layouts, -1 where there is none."""
        found = matches.astype(np.int64)
        found = found[0] if found.ndim > 1 and found.shape[0] == 1 and found.shape[-1] in (2, count) and found.size != 2 else found
        if found.shape == (count,):
            return np.stack([np.arange(count), found], 1)
        if found.ndim != 2 or found.shape[1] != 2:
            raise self.refused(f"it gives matches {matches.shape}; expected (M, 2), or one for each of {count} features")
        return found


def given_networks(detector: str, matcher: str) -> tuple[Path, Path] | None:
    """The files of a detector and a matcher by the settings `poses.features_model` and `poses.matcher_model`, "off" or a path; None where both are off.

    Raises UsageError where one alone is given, and what `Detector` and `Matcher` raise: before cameras are looked for.
    """
    if (detector == "off") != (matcher == "off"):
        raise UsageError(f"{OPTION}: features and matches are found by a network each. Give poses.features_model and poses.matcher_model, or neither.")
    if detector == "off":
        return None
    paths = Path(detector), Path(matcher)
    Detector(paths[0]), Matcher(paths[1])
    return paths
