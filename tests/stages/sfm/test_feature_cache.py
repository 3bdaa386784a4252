"""Features: masked parts have none; those that were detected before are not detected again, and nothing but those is taken for them."""

import hashlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from PIL import Image

from stages.sfm import feature_cache, matches
from stages.sfm.colmap import quiet_pycolmap
from stages.sfm.database import FEATURES, WorkImage, database_path, open_database, rows_of
from stages.sfm.images import prepare_images
from tests.stages.sfm.still_life import QUIET


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    monkeypatch.setenv("ENERF_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.delenv("ENERF_FEATURE_CACHE_MIB")
    feature_cache.folder.cache_clear()
    yield tmp_path / "cache"
    feature_cache.folder.cache_clear()


@pytest.fixture
def photographs(tmp_path: Path) -> Path:
    rng = np.random.default_rng(0)
    (tmp_path / "photos").mkdir()
    for k in range(3):
        coarse = Image.fromarray(rng.integers(0, 255, (24, 32, 3), np.uint8))
        coarse.resize((256, 192), Image.Resampling.BICUBIC).save(tmp_path / "photos" / f"{k}.png")
    return tmp_path / "photos"


def opened(photographs: Path, work: Path, **changes: Any) -> list[WorkImage]:
    names = sorted(path.name for path in photographs.iterdir())
    how: dict[str, Any] = {"max_side": 256, "features": 200, "seed": 0, "masks": {}, "work": work, "warn": print, **QUIET, **changes}
    images, _ = prepare_images({name: photographs / name for name in names}, **how)
    open_database(work, images, print)
    return images


def detected(monkeypatch: pytest.MonkeyPatch, work: Path, images: list[WorkImage], **changes: Any) -> list[str]:
    """The images that COLMAP looked for features in."""
    asked: list[str] = []
    extract = matches._extract
    with monkeypatch.context() as patch:
        patch.setattr(matches, "_extract", lambda colmap, place, files, *more: (asked.extend(files), extract(colmap, place, files, *more)))
        matches.extract_features(work, images, **{"features": 200, **QUIET, **changes})
    return asked


def features(work: Path) -> list[Any]:
    return list(rows_of(database_path(work), FEATURES, range(1, 10)))


def test_masked_parts_give_no_features(tmp_path: Path, photographs: Path) -> None:
    mask = np.repeat(np.array([[0, 255]], np.uint8), 128, axis=1).repeat(192, axis=0)
    Image.fromarray(mask).save(tmp_path / "mask.png")
    images = opened(photographs, tmp_path / "work", masks={"1.png": tmp_path / "mask.png"})
    matches.extract_features(tmp_path / "work", images, features=200, **QUIET)
    with quiet_pycolmap() as pycolmap, pycolmap.Database.open(database_path(tmp_path / "work")) as database:
        whole, masked = (database.read_keypoints(i)[:, 0] for i in (1, 2))
    assert whole.min() < 100
    assert len(masked) > 10
    assert masked.min() >= 127


def test_the_same_images_are_not_looked_at_again_and_have_the_same_features(monkeypatch: pytest.MonkeyPatch, cache: Path, photographs: Path) -> None:
    first, second = cache.parent / "first", cache.parent / "second"
    assert detected(monkeypatch, first, opened(photographs, first)) == ["00000.png", "00001.png", "00002.png"]
    assert len(list(cache.rglob("*.features"))) == 3
    assert min(rows[0]["rows"] for _, rows in features(first)) > 20
    (photographs / "1.png").rename(photographs / "0b.png")  # other numbers, the same pictures
    Image.open(photographs / "2.png").rotate(180).save(photographs / "3.png")
    assert detected(monkeypatch, second, opened(photographs, second, seed=1)) == ["00003.png"]
    assert features(second)[:3] == features(first)


@pytest.mark.parametrize("damage", ["cut", "altered", "of_another_kind", "a_link"])
def test_a_damaged_file_is_no_features(monkeypatch: pytest.MonkeyPatch, cache: Path, photographs: Path, damage: str) -> None:
    first, second = cache.parent / "first", cache.parent / "second"
    detected(monkeypatch, first, opened(photographs, first))
    path = max(cache.rglob("*.features"))
    data = path.read_bytes()
    path.unlink()
    if damage == "a_link":
        path.symlink_to(min(cache.rglob("*.features")))
    else:
        rows = [{"rows": 5, "cols": 6, "data": b"1"}, {"rows": 5, "cols": 128, "data": b""}]
        other = msgspec.msgpack.encode(rows)
        made = {"cut": data[:-1], "altered": data[:-1] + bytes([data[-1] ^ 1]), "of_another_kind": hashlib.sha256(other).digest() + other}
        path.write_bytes(made[damage])
    assert len(detected(monkeypatch, second, opened(photographs, second))) == 1
    assert features(second) == features(first)


def test_the_least_recently_used_are_removed(monkeypatch: pytest.MonkeyPatch, cache: Path, photographs: Path) -> None:
    first, second = cache.parent / "first", cache.parent / "second"
    monkeypatch.setenv("ENERF_FEATURE_CACHE_MIB", "1")
    images = opened(photographs, first)
    old = feature_cache.folder()
    assert old is not None
    for number in range(2):
        (old / f"{number}.features").write_bytes(bytes(700_000))
        os.utime(old / f"{number}.features", (number, number))
    detected(monkeypatch, first, images)
    left = {path.name for path in cache.rglob("*.features")}
    assert "0.features" not in left
    assert sum(path.stat().st_size for path in cache.rglob("*.features")) <= 2**20
    assert detected(monkeypatch, second, opened(photographs, second)) == []
