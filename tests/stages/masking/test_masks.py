"""Masks that are made: of screens of one colour, and of backgrounds that stand still."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from efficientnerf.capture.keying import key_of, keyed
from pipeline.errors import BadInput
from stages.io.png import read_png, write_png
from stages.masking.made import made_masks
from stages.masking.static import StillBackground

H, W = 96, 128


def disc(centre: tuple[float, float], radius: float) -> np.ndarray:
    """(H, W) from 0 to 1, soft at its edge."""
    y, x = np.mgrid[:H, :W] + 0.5
    return np.clip(radius - np.hypot(x - centre[0], y - centre[1]) + 0.5, 0, 1)


def photograph(behind: np.ndarray, cover: np.ndarray, seed: int, noise: float = 2.0) -> np.ndarray:
    """A textured disc over what is behind (H, W, 3), with noise."""
    rng = np.random.default_rng(seed)
    texture = cv2.resize(rng.integers(20, 236, (24, 32, 3)).astype(np.uint8), (W, H), interpolation=cv2.INTER_CUBIC).astype(float)
    texture[..., 1] = np.minimum(texture[..., 1], texture[..., [0, 2]].max(-1))  # nothing greener than it is red or blue
    mixed = texture * cover[..., None] + behind * (1 - cover[..., None]) + rng.normal(0, noise, (H, W, 3))
    return np.clip(np.round(mixed), 0, 255).astype(np.uint8)


def uneven(colour: tuple[float, float, float]) -> np.ndarray:
    """A screen lit from the left."""
    return np.asarray(colour) * np.linspace(1.1, 0.75, W)[None, :, None] * np.linspace(1, 0.9, H)[:, None, None]


def overlap(mask: np.ndarray, cover: np.ndarray) -> float:
    """Intersection over union."""
    one, two = mask > 127, cover > 0.5
    return float((one & two).sum() / (one | two).sum())


def test_a_hole_shows_a_green_screen_and_white_inside_an_object_stays() -> None:
    ring = np.minimum(disc((64, 48), 36), 1 - disc((64, 48), 12))
    through = keyed(photograph(uneven((60, 190, 80)), ring, 1), key_of("green"))
    assert overlap(through, ring) > 0.94  # its edges are as long as 40 % of its pixels
    assert through[48, 64] == 0
    before_white = photograph(np.full((H, W, 3), 235.0), disc((64, 48), 36), 2)
    before_white[40:56, 56:72] = 235  # a white label on the object
    whole = keyed(before_white, key_of("white"))
    assert whole[48, 64] == 255
    assert overlap(whole, disc((64, 48), 36)) > 0.95


@pytest.mark.parametrize("name", ["", "red", "#12", "#gggggg", "0x112233"])
def test_keys_are_names_or_colours(name: str) -> None:
    with pytest.raises(ValueError, match=r"#rrggbb|hexadecimal|fromhex"):
        key_of(name)


def turned(number: int, count: int = 9) -> tuple[np.ndarray, np.ndarray]:
    """What a camera on a stand sees of an object that turns: a disc whose texture changes and that moves a little; and where it is."""
    wall = cv2.resize(np.random.default_rng(9).integers(40, 200, (12, 16, 3)).astype(np.uint8), (W, H), interpolation=cv2.INTER_CUBIC).astype(float)
    cover = disc((64 + 4 * np.cos(6.28 * number / count), 50), 24)
    return photograph(wall * (1 + 0.04 * np.sin(number)), cover, 20 + number), cover


def test_a_background_that_stands_still_is_left_out() -> None:
    pictures = [turned(number) for number in range(9)]
    still = StillBackground(np.stack([picture for picture, _ in pictures]))
    for picture, cover in pictures:
        assert overlap(still.mask(picture), cover) > 0.85


def test_a_background_that_moves_is_refused() -> None:
    rng = np.random.default_rng(0)
    walls = [cv2.resize(rng.integers(0, 255, (12, 16, 3)).astype(np.uint8), (W, H)) for _ in range(8)]
    with pytest.raises(BadInput):
        StillBackground(np.stack(walls))
    with pytest.raises(BadInput):
        StillBackground(np.stack(walls[:2]))


def written(folder: Path, pictures: list[np.ndarray]) -> dict[str, Path]:
    folder.mkdir()
    for number, picture in enumerate(pictures):
        write_png(picture, folder / f"{number}.png")
    return {path.name: path for path in sorted(folder.iterdir())}


@pytest.mark.parametrize("how", ["static", "green"])
def test_masks_are_files_at_the_size_of_their_photographs(tmp_path: Path, how: str) -> None:
    pairs = [turned(number) for number in range(6)]
    if how == "green":
        pairs = [(photograph(uneven((60, 190, 80)), cover, number), cover) for number, (_, cover) in enumerate(pairs)]
    other = np.full((40, 90, 3), 128, np.uint8)  # of another size, and without a screen
    paths = written(tmp_path / "photographs", [*(picture for picture, _ in pairs), other])
    (tmp_path / "photographs" / "torn.png").write_bytes(b"\x89PNG torn")
    told: list[str] = []
    masks = made_masks(
        {**paths, "torn.png": tmp_path / "photographs" / "torn.png"}, how, tmp_path / "masks",
        safe_point=lambda: None, progress=lambda *_: None, warn=lambda text, **_: told.append(text),
    )  # fmt: skip
    assert sorted(masks) == sorted(paths)[:6]
    for (_, cover), path in zip(pairs, masks.values(), strict=True):
        mask = read_png(path)
        assert mask.shape == (H, W)
        assert overlap(mask, cover) > 0.85
    assert len(told) == 1
    assert told[0] == f"--mask {how}: no such background in 1 of 8 photographs, such as 6.png; they get no mask"
