"""What is said of photographs before a run of them."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from pipeline.errors import BadInput
from stages.formats.importers import IMPORTERS
from stages.io.photo import read_photo
from stages.poses.settings import PosesSettings
from stages.sfm import matches
from stages.sfm.colmap import quiet_pycolmap
from stages.sfm.database import database_path, open_database
from stages.sfm.images import prepare_images
from stages.verdict import preflight
from stages.verdict.preflight import Small, check, overlap_of
from tests.stages import captures, turntables
from tests.stages.sfm.still_life import QUIET, STILL_LIFE, neighbours

SIZE = 240, 180


def panorama(seed: int) -> np.ndarray:
    """(400, 900) uint8 with structures of several sizes."""
    rng = np.random.default_rng(seed)
    layers = [cv2.resize(rng.uniform(0, 1, (400 // step, 900 // step)).astype(np.float32), (900, 400), interpolation=cv2.INTER_CUBIC) for step in (6, 14, 40)]
    total = sum(layers) / 3  # type: ignore[arg-type]
    return np.asarray(np.clip(total * 255, 0, 255).astype(np.uint8))


def relief(picture: np.ndarray, x: float, y: float = 80.0) -> np.ndarray:
    """What a camera at x sees: the lower half is nearer than the upper one, and moves more."""
    width, height = SIZE
    columns, rows = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    nearer = (rows > height / 2) * 0.6 + rows / height * 0.3 + 1.0
    return np.asarray(cv2.remap(picture, (columns + 40 + x * nearer).astype(np.float32), rows + np.float32(y), cv2.INTER_LINEAR))


def write(folder: Path, pictures: dict[str, np.ndarray], focal: dict[str, int] | None = None) -> Path:
    folder.mkdir(exist_ok=True)
    for name, picture in pictures.items():
        exif = Image.Exif()
        if focal:
            exif.get_ifd(34665)[41989] = focal[name]
        Image.fromarray(picture).save(folder / name, exif=exif)
    return folder


def along(seed: int, count: int, name: str = "{:02d}.png", step: float = 14.0) -> dict[str, np.ndarray]:
    scene = panorama(seed)
    return {name.format(k): relief(scene, step * k) for k in range(count)}


def problems(folder: Path, **settings: object) -> dict[str, str]:
    found = check(folder, PosesSettings(**settings), 2)  # type: ignore[arg-type]
    return {problem.what: problem.grade for problem in found.problems if problem.what not in ("small", "few")}


def small_of(picture: np.ndarray, path: Path) -> Small:
    Image.fromarray(picture).save(path)
    return preflight._small(path, picture)


def test_overlap_counts_what_moves_alike_and_what_stands_still(tmp_path: Path) -> None:
    scene = panorama(0)
    one, near, far, other = (small_of(p, tmp_path / "p.png") for p in (relief(scene, 0), relief(scene, 12), relief(scene, 400), relief(panorama(1), 0)))
    same = overlap_of(one, one)
    assert (same.still, same.plane) == (1.0, 1.0)
    moved = overlap_of(one, near)
    assert moved.matches >= preflight.OVERLAP
    assert moved.still < 0.1
    assert overlap_of(one, far) is None
    assert overlap_of(one, other) is None
    assert overlap_of(one, small_of(np.full((180, 240), 200, np.uint8), tmp_path / "p.png")) is None


def test_photographs_along_a_way_overlap(tmp_path: Path) -> None:
    found = check(write(tmp_path / "a", along(0, 14)), PosesSettings(), 2)
    assert [problem.what for problem in found.problems if problem.what != "small"] == []
    assert found.figures["overlapping"] == 1.0
    assert found.figures["photographs"] == found.figures["looked_at"] == 14
    forecast = found.figures["forecast"]
    assert forecast["pairs"] == 14 * 13 // 2
    assert 0 < forecast["poses_seconds"] < 300
    assert forecast["poses_bytes"] > 100 * 2**20


def test_two_scenes_in_one_folder_are_told(tmp_path: Path) -> None:
    folder = write(tmp_path / "a", along(0, 9) | along(1, 5, "z{}.png"))
    found = check(folder, PosesSettings(), 2)
    assert {problem.what: problem.images for problem in found.problems}["overlap"] == tuple(f"z{k}.png" for k in range(5))
    assert found.grade == "usable"


def test_a_camera_that_stood_still_is_told(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    view = relief(panorama(0), 0).astype(np.float32)
    noisy = {f"{k:02d}.png": np.clip(view + rng.normal(0, 3, view.shape), 0, 255).astype(np.uint8) for k in range(12)}
    found = problems(write(tmp_path / "a", noisy))
    assert found["stands still"] == "poor"
    assert found["duplicates"] == "poor"


def test_a_small_subject_that_turns_before_much_of_a_wall_is_told(tmp_path: Path) -> None:
    pictures = {camera.name: turntables.picture(camera, number) for number, camera in enumerate(turntables.cameras(9, 80.0))}
    found = problems(write(tmp_path / "a", pictures))
    assert found.get("background") == "usable"
    assert "stands still" not in found


def test_a_camera_that_only_turns_is_told(tmp_path: Path) -> None:
    scene = panorama(0)
    turned = {f"{k:02d}.png": np.ascontiguousarray(scene[60 + 3 * k : 240 + 3 * k, 24 * k : 24 * k + 240]) for k in range(12)}
    assert problems(write(tmp_path / "a", turned)) == {"parallax": "usable"}


def test_noise_and_tiny_pictures_are_told(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    noisy = {name: np.clip(picture + rng.normal(0, 35, picture.shape), 0, 255).astype(np.uint8) for name, picture in along(0, 6).items()}
    assert problems(write(tmp_path / "a", noisy))["noise"] == "usable"
    tiny = {name: cv2.resize(picture, (96, 72), interpolation=cv2.INTER_AREA) for name, picture in along(0, 6).items()}
    found = {problem.what: problem for problem in check(write(tmp_path / "b", tiny), PosesSettings(), 2).problems}
    assert found["tiny"].grade == "poor"
    assert "96 px" in found["tiny"].sentence
    assert "small" not in found
    assert "noise" not in found


def test_time_of_matching_follows_the_number_of_features(tmp_path: Path) -> None:
    """Against COLMAP's own detector, on one side of the size below which it looks at twice the size and on the other."""
    names = neighbours(2)
    for width in (480, 1040):
        folder, work = tmp_path / str(width), tmp_path / f"work{width}"
        folder.mkdir()
        for name in names:
            with Image.open(STILL_LIFE / name) as image:
                image.resize((width, 3 * width // 4), Image.Resampling.BICUBIC).save(folder / name, quality=95)
        images, _ = prepare_images({name: folder / name for name in names}, max_side=1600, features=20000, seed=0, masks={}, work=work, warn=print, **QUIET)
        open_database(work, images, print)
        matches.extract_features(work, images, features=20000, **QUIET)
        with quiet_pycolmap() as pycolmap, pycolmap.Database.open(database_path(work)) as database:
            counts = [database.num_keypoints_for_image(k + 1) for k in range(len(names))]
        for name, count in zip(names, counts, strict=True):
            assert preflight.count_features(read_photo(folder / name, 1600).rgb) == pytest.approx(count, rel=0.25)


def test_zooms_and_files_that_cannot_be_read_are_named(tmp_path: Path) -> None:
    pictures = along(0, 12, "{:02d}.jpg")
    focal = {name: 28 if k < 8 else 50 if k < 11 else 29 for k, name in enumerate(pictures)}
    folder = write(tmp_path / "a", pictures, focal)
    (folder / "broken.jpg").write_bytes(b"no picture")
    found = check(folder, PosesSettings(), 2)
    by_name = {problem.what: problem for problem in found.problems}
    assert by_name["zoom"].images == ("08.jpg", "09.jpg", "10.jpg")
    assert by_name["unreadable"].images == ("broken.jpg",)
    (tmp_path / "b").mkdir()
    (tmp_path / "b/x.jpg").write_bytes(b"no picture")
    with pytest.raises(BadInput, match=r"no photograph can be read: x\.jpg"):
        check(tmp_path / "b", PosesSettings(), 2)


def test_cameras_that_are_known_need_no_overlap(tmp_path: Path) -> None:
    source = captures.colmap_txt(tmp_path / "source")
    found = check(source, PosesSettings(), 2)
    assert found.figures["format"] == "colmap"
    assert "overlap" not in {problem.what for problem in found.problems}
    assert found.figures["forecast"]["pairs"] == 0
    assert check(source, PosesSettings(format="photographs"), 2).figures["forecast"]["pairs"] == 15


def test_stated_cameras_that_a_run_would_refuse_are_told(tmp_path: Path) -> None:
    """As of a file that another system wrote, which lists photographs elsewhere."""
    captures.blender(tmp_path / "good")
    assert check(tmp_path / "good", PosesSettings(), 2).grade != "failed"
    for path in (tmp_path / "good").glob("transforms*.json"):
        path.write_text(path.read_text().replace('"./', '"../elsewhere/'))
    found = check(tmp_path / "good", PosesSettings(), 2)
    assert (found.grade, found.problems[0].what) == ("failed", "cameras")
    with pytest.raises(BadInput):
        IMPORTERS["blender"].read(tmp_path / "good", PosesSettings())
    assert "cameras" not in problems(tmp_path / "good", format="photographs")
