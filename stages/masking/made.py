"""Masks as files, for photographs that have none."""

import contextlib
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Unpack

import cv2
import numpy as np

from efficientnerf.capture.keying import key_of, keyed
from pipeline.errors import BadInput
from pipeline.files import SafePoint
from stages.io.capture import Capture
from stages.io.photo import DecodedPhoto, read_photo
from stages.io.pictures import UnreadableImage
from stages.io.png import write_png
from stages.masking.network import MaskNetwork
from stages.masking.static import SIDE, StillBackground, sharpened
from stages.sfm.images import Callables

STATIC = "static"
MASK_SIDE = 2048  # px, longest side of the photographs that masks are made from
Make = Callable[[DecodedPhoto, Path], np.ndarray | None]  # the mask of a photograph, by its pixels and its file; None where it has none


def made_masks(paths: Mapping[str, Path], how: str, folder: Path, **callables: Unpack[Callables]) -> dict[str, Path]:
    """Name -> mask, written to a folder, of the photographs whose background is found.

    how    static, green, white or #rrggbb
    Raises BadInput where no photograph has one.
    """
    make = _by_stillness(paths, callables["safe_point"]) if how == STATIC else _by_key(how)
    return _all_made(paths, make, folder, f"--mask {how}", "such background", **callables)


def masks_by_network(paths: Mapping[str, Path], model: Path, folder: Path, **callables: Unpack[Callables]) -> dict[str, Path]:
    """The same of photographs in which a network finds a subject. Raises UsageError and BadInput."""
    network = MaskNetwork(model)

    def make(photo: DecodedPhoto, path: Path) -> np.ndarray | None:
        mask = network.mask(photo.rgb)
        return None if mask is None else sharpened(mask, photo.rgb)

    return _all_made(paths, make, folder, f"--mask-model {model.name}", "subject", **callables)


def _all_made(paths: Mapping[str, Path], make: Make, folder: Path, option: str, what: str, **callables: Unpack[Callables]) -> dict[str, Path]:
    names = sorted(paths)
    folder.mkdir(parents=True, exist_ok=True)
    found, without = {}, []
    for number, name in enumerate(names):
        callables["safe_point"]()
        callables["progress"](number, len(names), "masks")
        try:
            photo = read_photo(paths[name], MASK_SIDE)
        except UnreadableImage:
            continue  # reported where it is read
        if (mask := make(photo, paths[name])) is None:
            without.append(name)
        else:
            found[name] = folder / f"{number:05d}.png"
            write_mask(mask, (photo.width, photo.height), found[name])
    if not found:
        raise BadInput(f"{option}: no {what} in any photograph. Choose another, or omit {option.split()[0]}.")
    if without:
        callables["warn"](f"{option}: no {what} in {len(without)} of {len(names)} photographs, such as {without[0]}; they get no mask", images=without)
    return found


def _by_key(how: str) -> Make:
    key = key_of(how)
    return lambda photo, path: keyed(photo.rgb, key)


def _by_stillness(paths: Mapping[str, Path], safe_point: SafePoint) -> Make:
    small: dict[Path, np.ndarray] = {}
    for name in sorted(paths):
        safe_point()
        with contextlib.suppress(UnreadableImage):
            small[paths[name]] = read_photo(paths[name], SIDE).rgb
    shapes = [each.shape for each in small.values()]
    usual = max(dict.fromkeys(shapes), key=shapes.count, default=None)
    still = StillBackground(np.stack([each for each in small.values() if each.shape == usual]) if usual else np.zeros((0, 1, 1, 3), np.uint8))

    def make(photo: DecodedPhoto, path: Path) -> np.ndarray | None:
        mask = still.mask(small[path]) if small[path].shape == usual else np.zeros(0, np.uint8)
        return sharpened(mask, photo.rgb) if mask.any() else None

    return make


def with_masks(capture: Capture, masks: Mapping[str, Path | None]) -> Capture:
    """The capture with these masks, by name; other photographs keep theirs."""
    return replace(capture, photos=tuple(replace(photo, mask=masks.get(photo.camera.name, photo.mask)) for photo in capture.photos))


def write_mask(mask: np.ndarray, size: tuple[int, int], target: Path) -> None:
    """At the photograph's own size (width, height)."""
    if mask.shape[::-1] != size:
        mask = cv2.resize(mask, size, interpolation=cv2.INTER_LINEAR)
    write_png(mask, target, durable=False)
