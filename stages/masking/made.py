"""Masks as files, for photographs that have none."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from efficientnerf.capture.keying import key_of, keyed
from pipeline.errors import BadInput
from stages.io.photo import read_photo
from stages.io.pictures import UnreadableImage
from stages.io.png import write_png
from stages.masking.network import MaskNetwork
from stages.masking.static import SIDE, StillBackground, sharpened

STATIC = "static"
MASK_SIDE = 2048  # px, longest side of the photographs that masks are made from
Warn = Callable[..., Any]


def made_masks(
    paths: Mapping[str, Path], how: str, folder: Path, *, safe_point: Callable[[], None], progress: Callable[[int, int, str], None], warn: Warn
) -> dict[str, Path]:
    """Name -> mask, written to a folder, of the photographs whose background is found.

    paths  photograph by name
    how    static, green, white or #rrggbb
    Raises BadInput where no photograph has one.
    """
    make = _by_stillness(paths, sorted(paths), safe_point) if how == STATIC else _by_key(how)
    return _all_made(paths, make, folder, f"--mask {how}", "such background", safe_point=safe_point, progress=progress, warn=warn)


def masks_by_network(
    paths: Mapping[str, Path], model: Path, folder: Path, *, safe_point: Callable[[], None], progress: Callable[[int, int, str], None], warn: Warn
) -> dict[str, Path]:
    """The same of photographs in which a network finds a subject. Raises UsageError and BadInput."""
    return _all_made(paths, _by_network(model), folder, f"--mask-model {model.name}", "subject", safe_point=safe_point, progress=progress, warn=warn)


def _all_made(
    paths: Mapping[str, Path],
    make: Callable[[Path, Path], bool],
    folder: Path,
    option: str,
    what: str,
    *,
    safe_point: Callable[[], None],
    progress: Callable[[int, int, str], None],
    warn: Warn,
) -> dict[str, Path]:
    """
    make  writes the mask of a photograph to a file; whether it has one
    """
    names = sorted(paths)
    folder.mkdir(parents=True, exist_ok=True)
    found, without = {}, []
    for number, name in enumerate(names):
        safe_point()
        progress(number, len(names), "masks")
        target = folder / f"{number:05d}.png"
        try:
            if make(paths[name], target):
                found[name] = target
            else:
                without.append(name)
        except UnreadableImage:
            continue  # reported where it is read
    if not found:
        article = "such a background" if what == "such background" else f"a {what}"
        raise BadInput(f"{option}: no photograph shows {article}. Choose another, or leave {option.split()[0]} away.")
    if without:
        warn(f"{option}: no {what} in {len(without)} of {len(names)} photographs, as in {without[0]}: they get no mask", images=without)
    return found


def _by_network(model: Path) -> Callable[[Path, Path], bool]:
    network = MaskNetwork(model)

    def make(photograph: Path, target: Path) -> bool:
        photo = read_photo(photograph, MASK_SIDE)
        mask = network.mask(photo.rgb)
        if mask is not None:
            write_mask(sharpened(mask, photo.rgb), (photo.width, photo.height), target)
        return mask is not None

    return make


def _by_key(how: str) -> Callable[[Path, Path], bool]:
    key = key_of(how)

    def make(photograph: Path, target: Path) -> bool:
        photo = read_photo(photograph, MASK_SIDE)
        mask = keyed(photo.rgb, key)
        if mask is not None:
            write_mask(mask, (photo.width, photo.height), target)
        return mask is not None

    return make


def _by_stillness(paths: Mapping[str, Path], names: list[str], safe_point: Callable[[], None]) -> Callable[[Path, Path], bool]:
    small: dict[Path, np.ndarray] = {}
    for name in names:
        safe_point()
        try:
            small[paths[name]] = read_photo(paths[name], SIDE).rgb
        except UnreadableImage:
            continue
    shapes = [each.shape for each in small.values()]
    usual = max(dict.fromkeys(shapes), key=shapes.count, default=None)
    still = StillBackground(np.stack([each for each in small.values() if each.shape == usual]) if usual else np.zeros((0, 1, 1, 3), np.uint8))

    def make(photograph: Path, target: Path) -> bool:
        photo = read_photo(photograph, MASK_SIDE)
        if small[photograph].shape != usual:
            return False
        mask = still.mask(small[photograph])
        if not mask.any():
            return False
        write_mask(sharpened(mask, photo.rgb), (photo.width, photo.height), target)
        return True

    return make


def write_mask(mask: np.ndarray, size: tuple[int, int], target: Path) -> None:
    """At the photograph's own size (width, height)."""
    if mask.shape[::-1] != size:
        mask = cv2.resize(mask, size, interpolation=cv2.INTER_LINEAR)
    write_png(mask, target, durable=False)
