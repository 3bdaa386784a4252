"""Pictures that are not sRGB: one conversion, for cameras, training and textures alike; profiles that are none harm nothing."""

import random
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from stages.io import photo, pictures, working_images
from stages.io.capture import Photo
from stages.verdict import looks
from tests.stages import captures
from tests.stages.io import profiles
from tests.stages.io.profiles import ADOBE_RGB, DISPLAY_P3, PROPHOTO, linear_to_srgb, of_colours, of_greys, of_inks, power, srgb_to_linear, to_srgb

P3 = of_colours(DISPLAY_P3, srgb_to_linear)
SPACES: dict[str, tuple[np.ndarray, profiles.Curve]] = {
    "Display P3": (DISPLAY_P3, srgb_to_linear),
    "Adobe RGB": (ADOBE_RGB, power(563 / 256)),
    "ProPhoto": (PROPHOTO, power(1.8)),
}


def colours(seed: int = 0) -> np.ndarray:
    """(24, 32, 3) of all kinds, white and black among them."""
    made = np.random.default_rng(seed).integers(0, 256, (24, 32, 3)).astype(np.uint8)
    made[0, :2] = [[255] * 3, [0] * 3]
    return made


def saved(path: Path, image: Image.Image, kind: str, profile: bytes | None, **options: Any) -> Path:
    import pillow_heif

    pillow_heif.register_heif_opener()
    image.save(path, kind, **({} if profile is None else {"icc_profile": profile}), **options)
    return path


def read(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    with pictures.opened(path) as image:
        return pictures.rgb_and_alpha(image)


@pytest.mark.parametrize("space", SPACES)
def test_other_spaces_become_srgb(space: str, tmp_path: Path) -> None:
    primaries, curve = SPACES[space]
    path = saved(tmp_path / "a.png", Image.fromarray(colours()), "PNG", of_colours(primaries, curve))
    found = read(path)[0]
    assert np.abs(found - to_srgb(colours(), primaries, curve)).max() <= 2
    assert np.abs(found.astype(int) - colours()).max() > 20  # and that is no small matter
    np.testing.assert_array_equal(found[0, :2], [[255] * 3, [0] * 3])


@pytest.mark.parametrize("kind", ["JPEG", "TIFF", "WEBP", "HEIF", "AVIF"])
def test_profiles_of_every_format(kind: str, tmp_path: Path) -> None:
    red = np.full((24, 32, 3), (200, 60, 60), np.uint8)
    path = saved(tmp_path / "a", Image.fromarray(red), kind, P3)
    expected = to_srgb(red[0, 0], DISPLAY_P3, srgb_to_linear)
    assert expected[0] - 200 > 10
    assert np.abs(read(path)[0][12, 16] - expected).max() <= 6


def test_all_who_read_a_photograph_see_the_same_colours(tmp_path: Path) -> None:
    path = saved(tmp_path / "a.jpg", Image.fromarray(np.full((24, 32, 3), (200, 60, 60), np.uint8)), "JPEG", P3)
    decoded = working_images.decode(path)
    assert not decoded.verbatim  # later stages read the file itself where it is, and know no profiles
    np.testing.assert_array_equal(photo.read_photo(path, 100).rgb, decoded.pixels)
    camera = replace(captures.cameras(1)[0], width=32, height=24)
    written = working_images.write(Photo(camera, path), tmp_path / "scene", "a.jpg", max_side=64)
    assert (written.image, written.warnings) == ("images/a.png", ())
    np.testing.assert_array_equal(read(tmp_path / "scene" / written.image)[0], decoded.pixels)
    with Image.open(tmp_path / "scene" / written.image) as image:
        assert "icc_profile" not in image.info
    assert looks.grey_of(path)[12, 16] == looks.grey_of(tmp_path / "scene" / written.image)[12, 16]


def test_alpha_is_kept_and_palettes_are_converted(tmp_path: Path) -> None:
    rgba = np.dstack([colours(), np.arange(24 * 32).reshape(24, 32) % 256]).astype(np.uint8)
    rgb, alpha = read(saved(tmp_path / "a.png", Image.fromarray(rgba), "PNG", P3))
    np.testing.assert_array_equal(alpha, rgba[..., 3])
    np.testing.assert_array_equal(rgb, read(saved(tmp_path / "b.png", Image.fromarray(colours()), "PNG", P3))[0])
    few = Image.fromarray(colours()).quantize(16)
    expected = to_srgb(np.asarray(few.convert("RGB")), DISPLAY_P3, srgb_to_linear)
    assert np.abs(read(saved(tmp_path / "p.png", few, "PNG", P3))[0] - expected).max() <= 2


def test_cmyk_pictures(tmp_path: Path) -> None:
    black = np.zeros((24, 32, 4), np.uint8)
    black[..., 3] = np.linspace(0, 255, 32).astype(np.uint8)
    lightness = 100 * (1 - (black[..., 3] / 255.0) ** 1.4)
    luminance = np.where(lightness > 8, ((lightness + 16) / 116) ** 3, lightness / 903.3)
    for kind in ("TIFF", "JPEG"):
        path = saved(tmp_path / kind, Image.fromarray(black, "CMYK"), kind, of_inks(power(1.4)))
        assert np.abs(read(path)[0] - 255 * linear_to_srgb(luminance)[..., None]).max() <= (4 if kind == "TIFF" else 10)


# --- what is no profile


def edited(at: int, new: bytes) -> bytes:
    return P3[:at] + new + P3[at + len(new) :]


NO_PROFILES = {
    "a few bytes": b"\0",
    "cut short": P3[:300],
    "a link": edited(12, b"link"),
    "of greys": of_greys(power(1.2)),
    "of inks": of_inks(power(1.0)),
    "without tags": P3[:128] + bytes(4),
    "all black": of_colours(DISPLAY_P3, lambda values: 0 * values),
    "of elements": P3[:132] + b"D2B1" + P3[136:],
    "too large": P3 + bytes(9 << 20),
}


@pytest.mark.parametrize("what", NO_PROFILES)
def test_a_profile_that_cannot_be_used_is_said_and_harms_nothing(what: str, tmp_path: Path) -> None:
    pixels, camera = captures.picture(), captures.cameras(1)[0]
    path = saved(tmp_path / "a.tif", Image.fromarray(pixels), "TIFF", NO_PROFILES[what])
    np.testing.assert_array_equal(read(path)[0], pixels)
    np.testing.assert_array_equal(photo.read_photo(path, 1000).rgb, pixels)
    (warning,) = working_images.write(Photo(camera, path), tmp_path / "out", "a.tif", max_side=1000).warnings
    assert warning.startswith(f"{camera.name}: its colour profile is ")


def test_mutated_profiles_are_used_or_refused(tmp_path: Path) -> None:
    rng = random.Random(0)
    image = Image.fromarray(colours())
    for profile in (P3, of_inks(power(0.5)), of_greys(power(1.2))):
        picture = image.convert({b"RGB ": "RGB", b"CMYK": "CMYK", b"GRAY": "L"}[profile[16:20]])
        for _ in range(25):
            data = bytearray(profile)
            for _ in range(rng.choice((1, 4, 16))):
                at = rng.randrange(min(len(data), 400) if rng.random() < 0.8 else len(data))
                data[at] = rng.choice((0, 1, 127, 255, rng.randrange(256)))
            rgb, _ = read(saved(tmp_path / "a.tif", picture, "TIFF", bytes(data)))
            assert rgb.shape == (24, 32, 3)
