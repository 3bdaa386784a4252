"""ICC profiles of pictures: to sRGB, through littlecms.

Cameras of phones write Display P3, others Adobe RGB or ProPhoto; CMYK and grey pictures have profiles of paper and of dots. Read as sRGB, they are pale.

The intent is relative colorimetric with black point compensation: a colour that sRGB has stays that colour whatever profile it came in, so that photographs of
one thing agree, and others are clipped to the nearest edge. The perceptual intent would move all colours as each profile's maker liked it. Matrix profiles,
which photographs nearly all have, give the same with either. docs/experiments/colour-profiles.md

A profile is known as sRGB by what it does to colours, not by its name: there are dozens of them under many names, and pictures with one keep their pixels.
"""

import io
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from PIL import Image, ImageCms

MAX_PROFILE = 8 << 20  # bytes; those of printers have up to three million
TOLERANCE = 2  # levels of 255 that sRGB's profiles differ by among each other
BAND = 256  # rows that are converted at once: no second picture in memory
_KINDS = {b"GRAY": "L", b"RGB ": "RGB", b"CMYK": "CMYK"}  # colour spaces of profiles, as Pillow calls those of pictures
_CLASSES = (b"scnr", b"mntr", b"prtr", b"spac")  # profiles that say what a picture's numbers mean; others join profiles, or name colours
_CONTRAST = 128  # levels that white is brighter than black by in any picture's profile


@dataclass(frozen=True, eq=False)
class Conversion:
    """How the numbers of a picture become sRGB."""

    mode: str = "RGB"  # "L", "RGB" or "CMYK", of what is converted
    transform: Any = None  # littlecms', None where the numbers are sRGB as they are
    fault: str | None = None  # why the picture's profile is not used, if it is not
    levels: np.ndarray | None = None  # (256, 3) uint8 what the transform makes of each grey

    def rgb_of(self, image: Any) -> np.ndarray:
        """(H, W, 3) uint8 sRGB of a decoded Pillow image of a mode that can be made this one's."""
        width, height = image.size
        rgb = np.empty((height, width, 3), np.uint8)
        for top in range(0, height, BAND):
            bottom = min(height, top + BAND)
            band = image.crop((0, top, width, bottom))
            band = band if band.mode == self.mode else band.convert(self.mode)
            rgb[top:bottom] = np.asarray(self.transform.apply(band)) if self.levels is None else self.levels[np.asarray(band)]
        return rgb


AS_IT_IS = Conversion()


def conversion_of(profile: bytes | None, mode: str) -> Conversion:
    """What a profile asks for.

    mode  of the picture's colours: "L", "RGB" or "CMYK"
    """
    return AS_IT_IS if not profile else _conversion(profile, mode) if len(profile) <= MAX_PROFILE else Conversion(fault=f"of {len(profile) >> 20} MiB")


@lru_cache(maxsize=8)
def _conversion(profile: bytes, mode: str) -> Conversion:
    space = _KINDS.get(profile[16:20])
    if len(profile) < 128 or profile[36:40] != b"acsp" or profile[12:16] not in _CLASSES:
        return Conversion(fault="damaged, or none of a picture")
    count = min(int.from_bytes(profile[128:132], "big"), (len(profile) - 132) // 12)
    if any(profile.startswith(b"D2B", 132 + 12 * index) for index in range(count)):
        return Conversion(fault="of multi-process elements")  # littlecms would calculate a million of them for every colour
    if space is None or (space != mode and (space, mode) != ("RGB", "L")):  # a grey picture may hold the greys of a space of colours
        return Conversion(fault=f"for {space or 'other'} pictures, and this one is {mode}")
    flags = ImageCms.Flags.BLACKPOINTCOMPENSATION | ImageCms.Flags.NOCACHE  # without a cache one transform serves all threads
    if space == "L":
        flags |= ImageCms.Flags.NOOPTIMIZE  # else it is off by up to three levels; slow, but for 256 of them
    try:
        transform = ImageCms.buildTransform(
            ImageCms.ImageCmsProfile(io.BytesIO(profile)),
            ImageCms.createProfile("sRGB"),
            space,
            "RGB",
            ImageCms.Intent.RELATIVE_COLORIMETRIC,
            flags,
        )
        found = Conversion(space, transform)
        expected, converted = _probe(found)
        found = replace(found, levels=converted) if space == "L" else found
    except MemoryError:
        raise
    except Exception:  # littlecms' own, and whatever Pillow stumbles over
        return Conversion(fault="damaged")
    if converted[-1].mean() - converted[0].mean() < _CONTRAST:
        return Conversion(fault="damaged: white is not brighter than black")
    alike = space != "CMYK" and np.abs(converted.astype(int) - expected).max() <= TOLERANCE
    return AS_IT_IS if alike else found


def _probe(conversion: Conversion) -> tuple[np.ndarray, np.ndarray]:
    """Colours all over the space, black first and white last: as sRGB would read them, (N, 3), and as the profile does."""
    levels = np.linspace(0, 255, 16).round().astype(np.uint8)
    if conversion.mode == "L":
        expected = np.repeat(np.arange(256, dtype=np.uint8)[:, None], 3, axis=1)
        probe = Image.fromarray(expected[None, :, 0].copy())
    else:
        expected = np.stack(np.meshgrid(levels, levels, levels, indexing="ij"), axis=-1).reshape(-1, 3)
        probe = Image.fromarray(expected[None]).convert(conversion.mode)
    return expected, conversion.rgb_of(probe)[0]
