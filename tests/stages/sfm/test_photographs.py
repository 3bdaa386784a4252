"""Cameras from photographs: reading them upright, features and matches that survive a kill, and the cameras that come out."""

import contextlib
import itertools
import shutil
import signal
import sqlite3
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from efficientnerf.geometry.cameras import Camera, project, rays
from pipeline.errors import StageFailed
from stages.io.capture import Capture
from stages.sfm import mapping, matches, pair_workers
from stages.sfm.cameras import find_cameras
from stages.sfm.colmap import quiet_pycolmap
from stages.sfm.database import FEATURES, PAIRS, WorkImage, database_path, open_database, record
from stages.sfm.images import prepare_images
from stages.sfm.pairs import all_pairs
from stages.sfm.reconstruction import Request, reconstruct
from tests.stages.sfm.still_life import QUIET, ROOT, SILENT, STILL_LIFE, errors_of, neighbours
from tests.stages.spoilers import SPOILERS

SIDE = 360  # px: enough for exact cameras, quick enough for a test


def find(folder: Path, names: list[str], work: Path, **callables: Any) -> Capture:
    return find_cameras(Request(folder, {name: folder / name for name in names}, work, SIDE), **SILENT | callables)


def numbers(capture: Capture) -> tuple[bytes, ...]:
    """Every figure of a capture, bit for bit."""
    cameras = [(p.camera.name, p.camera.model, np.array(p.camera.params).tobytes(), p.camera.world_from_camera.tobytes()) for p in capture.photos]
    return (repr(cameras).encode(), capture.points.xyz.tobytes(), capture.points.rgb.tobytes(), repr(capture.points.tracks).encode())


@pytest.fixture(scope="module")
def ten(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[str], Path, Capture]:
    names = neighbours(10)
    work = tmp_path_factory.mktemp("work")
    return names, work, find(STILL_LIFE, names, work)


def test_cameras_lie_where_the_photographs_were_taken(ten: tuple[list[str], Path, Capture]) -> None:
    names, _, capture = ten
    assert [photo.camera.name for photo in capture.photos] == names
    assert not capture.rejected
    assert np.sqrt((errors_of(capture) ** 2).mean()) < 0.005
    camera = capture.photos[0].camera
    assert (camera.width, camera.height) == (480, 360)  # of the source, not of the working copies
    assert camera.intrinsics["fx"] == pytest.approx(400, rel=0.01)
    assert camera.intrinsics["k1"] == pytest.approx(-0.04, abs=0.02)
    assert capture.kind == "photographs"
    assert capture.up is None
    assert not capture.metric
    assert capture.provenance.pairs_agreeing > 0.9
    assert max(max(seen) for seen in capture.points.tracks) < len(names)


def test_again_in_another_order_gives_the_same_bits(ten: tuple[list[str], Path, Capture], tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    names, _, capture = ten
    assert numbers(find(STILL_LIFE, names[::-1], tmp_path)) == numbers(capture)
    assert capfd.readouterr() == ("", "")  # COLMAP keeps silent


def test_the_process_changes_no_bit(ten: tuple[list[str], Path, Capture], tmp_path: Path) -> None:
    names, work, capture = ten
    shutil.copytree(work, tmp_path / "work")
    here = reconstruct(Request(STILL_LIFE, {name: STILL_LIFE / name for name in names}, tmp_path / "work", SIDE, 4096), **SILENT)
    assert numbers(here) == numbers(capture)
    assert (here.provenance, here.warnings, here.rejected, here.reprojection_error) == (
        capture.provenance, capture.warnings, capture.rejected, capture.reprojection_error,
    )  # fmt: skip


KILLED = """
import os, signal, sys
from pathlib import Path
from stages.sfm.cameras import find_cameras
from stages.sfm.reconstruction import Request
folder, work, phase, moment, side = Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3], int(sys.argv[4]), int(sys.argv[5])
def progress(done, total, text="", **facts):
    if text == phase and done >= moment:
        os.kill(os.getpid(), signal.SIGKILL)
find_cameras(Request(folder, {name: folder / name for name in sys.argv[6:]}, work, side), progress=progress, safe_point=lambda: None, warn=print)
"""


@pytest.mark.parametrize(("phase", "moment"), [("detecting features", 6), ("matching pairs", 20)])
def test_killed_and_resumed_gives_the_same_bits(ten: tuple[list[str], Path, Capture], tmp_path: Path, phase: str, moment: int) -> None:
    names, _, capture = ten
    command = [sys.executable, "-c", KILLED, str(STILL_LIFE), str(tmp_path), phase, str(moment), str(SIDE), *names]
    assert subprocess.run(command, cwd=ROOT, check=False, timeout=200).returncode == -signal.SIGKILL
    first_seen: dict[str, int] = {}

    def progress(done: int, total: int, text: str = "", **facts: object) -> None:
        first_seen.setdefault(text, done)

    assert numbers(find(STILL_LIFE, names, tmp_path, progress=progress)) == numbers(capture)
    assert first_seen["detecting features"] >= 6  # what was found before the kill is used


def test_an_image_that_colmap_cannot_read_is_not_left_out(resumed: tuple[Path, list[WorkImage]]) -> None:
    work, images = resumed
    last = work / "images" / images[-1].file
    last.rename(work / "hidden.png")
    with pytest.raises(StageFailed, match=r"\w+.png"):
        mapping.sub_models(work, images, 0, mapping.DEFAULTS, **QUIET)
    assert not list(work.glob("colmap_log*"))
    with pytest.raises(StageFailed, match="COLMAP"):
        open_database(work, images, lambda *a, **k: None)
    (work / "hidden.png").rename(last)
    with contextlib.closing(sqlite3.connect(database_path(work))) as connection:
        for table, _ in (*FEATURES, *PAIRS):
            connection.execute(f"DELETE FROM {table}")
        connection.commit()
    last.rename(work / "hidden.png")
    with pytest.raises(FileNotFoundError):
        matches.extract_features(work, images[-2:], features=256, **QUIET)


@pytest.fixture
def resumed(ten: tuple[list[str], Path, Capture], tmp_path: Path) -> tuple[Path, list[WorkImage]]:
    """A copy of the work folder, and its images."""
    names, work, _ = ten
    shutil.copytree(work, tmp_path / "work")
    images, _ = prepare_images(
        {name: STILL_LIFE / name for name in names}, max_side=SIDE, features=4096, seed=0, masks={}, work=tmp_path / "work", **SILENT
    )
    return tmp_path / "work", images


def rows_of(work: Path) -> dict[str, set[int]]:
    with contextlib.closing(sqlite3.connect(database_path(work))) as connection:
        return {table: {row[0] for row in connection.execute(f"SELECT {column} FROM {table}")} for table, column in (*FEATURES, *PAIRS)}


@pytest.mark.parametrize(
    "statement",
    [
        "UPDATE keypoints SET rows = 1000000 WHERE image_id = 1", "UPDATE keypoints SET cols = 3 WHERE image_id = 1",
        "UPDATE descriptors SET cols = 64, rows = 2 * rows WHERE image_id = 1", "UPDATE keypoints SET rows = -1 WHERE image_id = 1",
        "UPDATE two_view_geometries SET data = replace(hex(data), '0', 'F')", "UPDATE matches SET data = NULL", "UPDATE two_view_geometries SET F = x'00'",
        "UPDATE matches SET rows = 'many'", "DROP TABLE matches", "ALTER TABLE matches RENAME TO other; CREATE VIEW matches AS SELECT * FROM other",
        "UPDATE matches SET data = (SELECT data FROM keypoints LIMIT 1), rows = (SELECT length(data) / 8 FROM keypoints LIMIT 1)",
    ],
)  # fmt: skip
def test_a_database_that_colmap_could_not_bear_is_not_handed_to_it(resumed: tuple[Path, list[WorkImage]], statement: str) -> None:
    """With notes that say it was written so."""
    work, images = resumed
    with contextlib.closing(sqlite3.connect(database_path(work))) as connection:
        connection.executescript(statement)
    with contextlib.suppress(sqlite3.Error):
        record(work, "features_00000", FEATURES, range(1, 11))
        record(work, "pairs_000000", PAIRS, sorted(rows_of(work)["two_view_geometries"]))
    for path in sorted(work.glob("features_*"))[1:] + sorted(work.glob("pairs_*.json"))[1:]:
        path.unlink()
    said: list[str] = []
    open_database(work, images, said.append)
    assert len(said) == 1
    with quiet_pycolmap() as pycolmap, pycolmap.Database.open(database_path(work)) as database:
        assert len(database.read_all_images()) == 10
    found = rows_of(work)
    assert 1 not in found["keypoints"] or not found["matches"]


@pytest.mark.parametrize("first", [0, 1])
def test_every_scratch_file_of_finding_cameras_may_be_damaged(ten: tuple[list[str], Path, Capture], tmp_path: Path, first: int) -> None:
    """Every second file each time, in all ways in turn; the database both times."""
    names, work, capture = ten
    shutil.copytree(work, tmp_path / "work")
    ways = itertools.cycle(SPOILERS.values())
    for k, path in enumerate(sorted(path for path in work.rglob("*") if path.is_file() and path.name != "request.json")):
        if k % 2 == first or path.name.startswith("database"):
            next(ways)(tmp_path / "work" / path.relative_to(work))
    assert numbers(find(STILL_LIFE, names, tmp_path / "work")) == numbers(capture)


def test_mixed_sizes_rotation_and_a_truncated_file(ten: tuple[list[str], Path, Capture], tmp_path: Path) -> None:
    names, _, _ = ten
    folder = tmp_path / "photos"
    (folder / "more").mkdir(parents=True)
    placed = []
    for index, name in enumerate(names):
        image: Image.Image = Image.open(STILL_LIFE / name)
        exif = Image.Exif()
        exif.get_ifd(34665)[41989] = 29  # 35 mm equivalent, as in the originals
        target = name
        if index < 3:  # held upright, stored lying
            exif[274] = 6
            image = image.transpose(Image.Transpose.ROTATE_90)
        elif index < 6:
            image = image.resize((400, 300), Image.Resampling.LANCZOS)
            target = f"more/{name}"
        image.save(folder / target, quality=95, exif=exif)
        placed.append(target)
    whole = (folder / placed[9]).read_bytes()
    (folder / placed[9]).write_bytes(whole[: len(whole) // 2])
    said: list[str] = []
    capture = find(folder, placed, tmp_path / "work", warn=lambda text, **facts: said.append(text))
    assert [name for name, _ in capture.rejected] == [placed[9]]
    assert any(placed[9] in text for text in said)
    by_name = {photo.camera.name: photo.camera for photo in capture.photos}
    assert len(by_name) == 9
    assert {(c.width, c.height) for c in by_name.values()} == {(480, 360), (400, 300)}
    for camera in by_name.values():
        assert camera.intrinsics["fx"] == pytest.approx(400 * camera.width / 480, rel=0.02)
    assert errors_of(capture).max() < 0.02


def test_lens_with_more_than_one_term_of_distortion(tmp_path: Path) -> None:
    """Fourteen photographs drawn again as a lens with two radial and two tangential terms would have taken them."""
    names = neighbours(14)
    old = Camera("old", 480, 360, "SIMPLE_RADIAL", (400.0, 240.0, 180.0, -0.04), np.eye(4))
    new = Camera("new", 480, 360, "OPENCV", (440.0, 440.0, 240.0, 180.0, -0.28, 0.22, 0.002, -0.001), np.eye(4))
    from_pixel = project(old, rays(new)[1])[0].reshape(360, 480, 2).astype(np.float32) - 0.5  # cv2's pixel centres are integers
    for name in names:
        with Image.open(STILL_LIFE / name) as image:
            drawn = cv2.remap(np.asarray(image), from_pixel[..., 0], from_pixel[..., 1], cv2.INTER_CUBIC)
        Image.fromarray(drawn).save(tmp_path / name, quality=96)
    capture = find(tmp_path, names, tmp_path / "work")
    camera = capture.photos[0].camera
    assert camera.model == "OPENCV"
    assert camera.intrinsics["fx"] == pytest.approx(440, rel=0.01)
    assert camera.intrinsics["k1"] == pytest.approx(-0.28, abs=0.04)
    assert np.sqrt((errors_of(capture) ** 2).mean()) < 0.002


def without_pairs(work: Path) -> dict[str, list[Any]]:
    """Remove all pairs from the database, and the notes of them; what they were."""
    with contextlib.closing(sqlite3.connect(database_path(work))) as connection, connection:
        found = {table: connection.execute(f"SELECT * FROM {table} ORDER BY {column}").fetchall() for table, column in PAIRS}
        for table, _ in PAIRS:
            connection.execute(f"DELETE FROM {table}")
    for note in work.glob("pairs_*.json"):
        note.unlink()
    return found


def test_pairs_matched_by_several_processes_are_the_same(resumed: tuple[Path, list[WorkImage]], monkeypatch: pytest.MonkeyPatch) -> None:
    work, images = resumed
    before = without_pairs(work)
    monkeypatch.setattr(matches, "MIN_PAIRS_A_WORKER", 8)
    seen: list[tuple[int, int]] = []
    quiet: dict[str, Any] = {"progress": lambda done, total, text: seen.append((done, total)), "safe_point": lambda: None}
    monkeypatch.setattr(pair_workers, "match_block", lambda *a: pytest.fail("matched in this process"))
    matches.match_pairs(work, images, all_pairs(10), seed=0, workers=2, **quiet)
    assert without_pairs(work) == before
    assert (seen[0], seen[-1]) == ((0, 45), (45, 45))
    assert not list(work.glob("worker_*"))
    matches.match_pairs(work, images, [], seed=0, workers=2, **quiet)
