"""COLMAP's database in the work folder.

Features depend on their image alone and verified matches on their two images alone, so that a resumed run has the same database as an undisturbed one.
COLMAP writes without syncing, and the folder may come from someone else: a run that is resumed begins with a new database, into which those rows of the
old one are copied that are as a note says they were written (`stages.scratch`), and that COLMAP can read without reaching beyond them.
"""

import contextlib
import hashlib
import sqlite3
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import StageFailed
from pipeline.files import remove, rename
from stages.scratch import Warn, note, noted, once, opened, unusable
from stages.sfm.colmap import import_pycolmap, quiet_pycolmap

# Tables of which a row each belongs to an image, or to a pair of them, and the column that names it.
FEATURES = ("keypoints", "image_id"), ("descriptors", "image_id")
PAIRS = ("matches", "pair_id"), ("two_view_geometries", "pair_id")
_WRITTEN = ("", "-wal", "-shm", "-journal")  # files of a database
_BLOBS = {"F": 72, "E": 72, "H": 72, "qvec": 32, "tvec": 24}  # bytes, where there are any
MAX_IMAGES = 2147483647  # COLMAP's
_MAX_KEYPOINTS = 2**20
FISHEYE_FOCAL = 0.4  # of the longest side: 180 degrees along the diagonal of a picture of 4:3
TIED = "markers"  # folder in a scratch folder, of the database with corners of markers
OVERLAPPING = 30  # verified matches, from which two photographs count as overlapping
HOMOGRAPHIES = (4, 5, 6)  # of COLMAP's two-view geometries: planar, panoramic, either of them

Row = dict[str, Any]


@dataclass(frozen=True)
class WorkImage:
    """The copy of one photograph after EXIF rotation."""

    name: str  # of the photograph
    file: str  # of the copy: numbers in sorted order of name
    # width, height: of the photograph after EXIF rotation, pixels
    width: int
    height: int
    # work_width, work_height: of the copy
    work_width: int
    work_height: int
    focal: float | None  # pixels of the photograph, from its EXIF data, or None
    camera_key: str  # photographs with equal keys share a COLMAP camera: same size, maker, focal length and kind of lens; without either same folder
    fisheye: bool = False  # whether it was taken through a fisheye lens


def images_of(work: Path) -> Path:
    """The folder of the copies; for a step's own scratch folder, that of its parent."""
    here = work / "images"
    return here if here.is_dir() else work.parent / "images"


def database_path(work: Path) -> Path:
    return work / "database.db"


def mapper_database(work: Path) -> Path:
    """That cameras are found from: with corners of markers, where there are any (`stages.sfm.added.markers`)."""
    tied = database_path(work / TIED)
    return tied if tied.exists() else database_path(work)


def remove_database(path: Path) -> None:
    for suffix in _WRITTEN:
        remove(Path(str(path) + suffix))


def open_database(work: Path, images: Sequence[WorkImage], warn: Warn) -> None:
    """Make a database of exactly `images`, each with its camera, and with the features and matches of an earlier call that are as they were written."""
    aside = work / "database.part"
    remove_database(aside)
    # The database appears by rename: a kill while the images are being listed leaves none.
    _list_images(aside, work, images)
    with contextlib.closing(sqlite3.connect(aside)) as fresh:
        if database_path(work).exists():
            _copy_rows(work, fresh, images, once(warn))
        fresh.commit()
        fresh.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    remove_database(database_path(work))
    rename(aside, database_path(work))


def _list_images(aside: Path, work: Path, images: Sequence[WorkImage]) -> None:
    with quiet_pycolmap() as pycolmap:
        cameras: dict[str, int] = {}
        for image in images:
            if image.camera_key not in cameras:
                with pycolmap.Database.open(aside) as database:
                    cameras[image.camera_key] = database.write_camera(_first_guess(image))
            options = pycolmap.ImageReaderOptions()
            options.existing_camera_id = cameras[image.camera_key]
            pycolmap.import_images(aside, images_of(work), pycolmap.CameraMode.SINGLE, [image.file], options)
        with pycolmap.Database.open(aside) as database:
            listed = {image.name for image in database.read_all_images()}
    for image in images:
        if image.file not in listed:  # COLMAP silently leaves out what it cannot read
            raise StageFailed(f"poses: {images_of(work) / image.file}: could not be read by COLMAP. Run again: what is done is kept.")


def _first_guess(image: WorkImage) -> Any:
    """SIMPLE_RADIAL: few photographs suffice for it; `mapping.bundle_adjusted` tries OPENCV. Without EXIF data the initial focal length is 1.2
    times the longest side, as in COLMAP.

    A fisheye lens gets OPENCV_FISHEYE. Its focal length counts as known: pairs are then verified by rays, which lie on epipolar planes, while on such pictures
    no fundamental matrix fits.
    """
    pycolmap = import_pycolmap()
    scale = np.sqrt(image.work_width * image.work_height / (image.width * image.height))
    usual = FISHEYE_FOCAL if image.fisheye else 1.2
    focal = image.focal * scale if image.focal else usual * max(image.work_width, image.work_height)
    if image.fisheye:
        params = [focal, focal, image.work_width / 2, image.work_height / 2, 0.0, 0.0, 0.0, 0.0]
        camera = pycolmap.Camera(model="OPENCV_FISHEYE", width=image.work_width, height=image.work_height, params=params)
        camera.has_prior_focal_length = True
        return camera
    camera = pycolmap.Camera(
        model="SIMPLE_RADIAL", width=image.work_width, height=image.work_height, params=[focal, image.work_width / 2, image.work_height / 2, 0.0]
    )
    camera.has_prior_focal_length = image.focal is not None
    return camera


def copy_rows(source: Path, target: Path, tables: Sequence[tuple[str, str]], keys: Sequence[int]) -> None:
    """Copy the rows of these keys, all or none, from one database to another that has none of them."""
    with contextlib.closing(sqlite3.connect(source)) as old, contextlib.closing(sqlite3.connect(target, timeout=60.0)) as fresh, fresh:
        for key in keys:
            rows = _rows(old, tables, key)
            if rows is None:
                raise StageFailed(f"poses: COLMAP has matched no pair {image_ids_of_pair(key)}. Run again: what is done is kept.")
            _insert(fresh, tables, rows)


def rows_of(path: Path, tables: Sequence[tuple[str, str]], keys: Iterable[int]) -> Iterator[tuple[int, list[Row]]]:
    """(key, its row of each of the tables without the key), of those keys that have all."""
    with contextlib.closing(sqlite3.connect(path)) as connection:
        for key in keys:
            if (rows := _rows(connection, tables, key)) is not None:
                yield key, [{name: value for name, value in row.items() if name != column} for (_, column), row in zip(tables, rows, strict=True)]


def insert_features(path: Path, image: int, rows: Sequence[Row]) -> bool:
    """Give an image, which has none, features as `rows_of` returned them; False where they are not what COLMAP can read."""
    with contextlib.closing(sqlite3.connect(path, timeout=60.0)) as connection, connection:
        whole = [{column: image, **row} for (_, column), row in zip(FEATURES, rows)]
        columns = [{row[1] for row in connection.execute(f"PRAGMA table_info({table})")} for table, _ in FEATURES]
        if [set(row) for row in whole] != columns:
            return False
        try:
            _check_features(image, whole, image)
        except (ValueError, TypeError):
            return False
        _insert(connection, FEATURES, whole)
    return True


def copy_database(work: Path, place: Path) -> None:
    """A copy of the database in another scratch folder, in the place of what is there."""
    remove_database(database_path(place))
    with contextlib.closing(sqlite3.connect(database_path(work))) as old, contextlib.closing(sqlite3.connect(database_path(place))) as fresh:
        old.backup(fresh)


def copy_with_own_cameras(work: Path, place: Path, images: Sequence[WorkImage]) -> None:
    """Replace the database of another scratch folder by one of the same images, features and matches, but with a camera for each image, of the first guess."""
    remove_database(database_path(place))
    _list_images(database_path(place), place, [replace(image, camera_key=image.file) for image in images])
    with contextlib.closing(attached(place, work)) as connection, connection:
        for table, _ in (*FEATURES, *PAIRS):
            connection.execute(f"INSERT INTO {table} SELECT * FROM everything.{table}")


def attached(work: Path, other: Path) -> sqlite3.Connection:
    """The database of a scratch folder, with that of another attached as `everything`."""
    connection = sqlite3.connect(database_path(work), timeout=60.0)
    connection.execute("PRAGMA synchronous = OFF")
    connection.execute("ATTACH DATABASE ? AS everything", (str(database_path(other)),))
    return connection


def forget(work: Path, tables: Sequence[tuple[str, str]], keys: Sequence[int]) -> None:
    """Remove the rows of these keys."""
    with contextlib.closing(sqlite3.connect(database_path(work))) as connection, connection:
        for table, column in tables:
            connection.executemany(f"DELETE FROM {table} WHERE {column} = ?", [(key,) for key in keys])


def record(work: Path, name: str, tables: Sequence[tuple[str, str]], keys: Sequence[int]) -> None:
    """Note that the rows of these keys are written: the next call copies them, and no others."""
    with contextlib.closing(sqlite3.connect(database_path(work))) as connection:
        digests = {str(key): _digest(rows) for key in keys if (rows := _rows(connection, tables, key)) is not None}
    note(work / f"{name}.json", digests)


def _rows(connection: sqlite3.Connection, tables: Sequence[tuple[str, str]], key: int) -> list[Row] | None:
    """The row of a key in each of the tables; None where one has none."""
    rows = []
    for table, column in tables:
        cursor = connection.execute(f"SELECT * FROM {table} WHERE {column} = ?", (key,))
        values = cursor.fetchone()
        if values is None:
            return None
        rows.append(dict(zip((column[0] for column in cursor.description), values, strict=True)))
    return rows


def _digest(rows: Sequence[Row]) -> str:
    digest = hashlib.sha256()
    for row in rows:
        digest.update(repr({name: len(value) if isinstance(value, bytes) else value for name, value in row.items()}).encode())
        for value in row.values():
            if isinstance(value, bytes):
                digest.update(value)
    return digest.hexdigest()


def _copy_rows(work: Path, fresh: sqlite3.Connection, images: Sequence[WorkImage], warn: Warn) -> None:
    """Copy the rows of the database of an earlier call that are as noted."""
    try:
        opened(database_path(work)).close()
        with contextlib.closing(sqlite3.connect(database_path(work))) as old:
            if any(_definition(old, table) != _definition(fresh, table) for table, _ in (*FEATURES, *PAIRS)):
                raise ValueError("tables of another version of pycolmap")
            features: dict[int, int] = {}
            for key, rows in _noted_rows(work, old, "features_*.json", FEATURES, warn):
                features[key] = _check_features(key, rows, len(images))
                _insert(fresh, FEATURES, rows)
            counts = dict(fresh.execute("SELECT image_id, rows FROM keypoints"))
            for key, rows in _noted_rows(work, old, "pairs_*.json", PAIRS, warn):
                _check_pair(key, rows, counts)
                _insert(fresh, PAIRS, rows)
    except (sqlite3.Error, OSError, ValueError, TypeError, KeyError) as error:
        warn(unusable(database_path(work), error))


def _definition(connection: sqlite3.Connection, table: str) -> list[tuple[str, str]]:
    return connection.execute("SELECT type, sql FROM sqlite_master WHERE name = ?", (table,)).fetchall()


def _noted_rows(work: Path, old: sqlite3.Connection, pattern: str, tables: Sequence[tuple[str, str]], warn: Warn) -> Iterator[tuple[int, list[Row]]]:
    """(key, rows) of all notes, of those rows that are as they were written."""
    seen: set[int] = set()
    for path in sorted(work.glob(pattern)):
        for text, digest in (noted(path, dict[str, str], warn) or {}).items():
            key = int(text)
            rows = _rows(old, tables, key)
            if rows is None or _digest(rows) != digest:
                warn(unusable(database_path(work), f"the {tables[0][0]} of {key} are not as they were written"))
            elif key not in seen:
                seen.add(key)
                yield key, rows


def _insert(fresh: sqlite3.Connection, tables: Sequence[tuple[str, str]], rows: Sequence[Row]) -> None:
    for (table, _), row in zip(tables, rows, strict=True):
        fresh.execute(f"INSERT INTO {table} ({', '.join(row)}) VALUES ({', '.join('?' * len(row))})", (*row.values(),))


def _check_features(key: int, rows: Sequence[Row], images: int) -> int:
    """The number of features; ValueError where the rows do not have the bytes that they state, or belong to no image."""
    keypoints, descriptors = rows
    count, whole = keypoints["rows"], all(isinstance(row[name], int) for row in rows for name in ("rows", "cols"))
    if not whole or not 1 <= key <= images or not 0 <= count <= _MAX_KEYPOINTS or descriptors["rows"] != count:
        raise ValueError(f"features of image {key}")
    if not count:
        return 0
    if keypoints["cols"] not in (2, 4, 6) or _size(keypoints) != 4 * count * keypoints["cols"]:
        raise ValueError(f"keypoints of image {key}")
    if descriptors["cols"] != 128 or _size(descriptors) != 128 * count:
        raise ValueError(f"descriptors of image {key}")
    return int(count)


def _check_pair(key: int, rows: Sequence[Row], counts: Mapping[int, int]) -> None:
    """ValueError where matches do not have the bytes that they state, or point to features that there are not."""
    limits = [counts.get(image, 0) for image in image_ids_of_pair(key)]
    for row in rows:
        if not isinstance(row["rows"], int) or row["rows"] < 0 or _size(row) != 8 * row["rows"] or (row["rows"] and row["cols"] != 2):
            raise ValueError(f"matches of pair {key}")
        if row["rows"] and (np.frombuffer(row["data"], np.uint32).reshape(-1, 2) >= limits).any():
            raise ValueError(f"matches of pair {key} with features that there are not")
    if any(rows[1].get(name) is not None and len(rows[1][name]) != size for name, size in _BLOBS.items()):
        raise ValueError(f"geometry of pair {key}")


def _size(row: Row) -> int:
    return len(row["data"] or b"")


def inlier_counts(path: Path) -> dict[tuple[int, int], int]:
    """Verified matches of each pair of image ids that was compared, in order."""
    with contextlib.closing(sqlite3.connect(path)) as connection:
        return {image_ids_of_pair(row[0]): int(row[1]) for row in connection.execute("SELECT pair_id, rows FROM two_view_geometries ORDER BY pair_id")}


def neighbours(work: Path, count: int) -> dict[int, set[int]]:
    """The positions of the photographs that each of `count` overlaps with."""
    found: dict[int, set[int]] = {i: set() for i in range(count)}
    for (i, j), inliers in inlier_counts(database_path(work)).items():
        if inliers >= OVERLAPPING:
            found[i - 1].add(j - 1)
            found[j - 1].add(i - 1)
    return found


def planar_share(path: Path) -> float | None:
    """Share of the verified pairs whose matches one homography explains: of a camera that only turned, or of one plane; None without such pairs."""
    with contextlib.closing(sqlite3.connect(path)) as connection:
        kinds = [int(row[0]) for row in connection.execute("SELECT config FROM two_view_geometries WHERE rows > 0")]
    return sum(kind in HOMOGRAPHIES for kind in kinds) / len(kinds) if kinds else None


def pair_id_of(first: int, second: int) -> int:
    """COLMAP's number of a pair of images, the smaller id first."""
    return first * MAX_IMAGES + second


def image_ids_of_pair(pair: int) -> tuple[int, int]:
    """The two image ids of a pair id in COLMAP's database."""
    return (pair - pair % MAX_IMAGES) // MAX_IMAGES, pair % MAX_IMAGES
