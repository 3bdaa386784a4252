"""Photographs to features and verified matches, resumable.

The work folder holds copies of the photographs after EXIF rotation at working size (`images/`), their masks (`masks/`) and COLMAP's database. Features
depend on their image alone and verified matches on their two images alone, so that a resumed run has the same database as an undisturbed one.
"""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import json
import os
import signal
import sqlite3
import sys
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from pipeline.files import remove, rename, write_atomically
from stages.io.photo import DecodedPhoto, read_mask_file, read_photo
from stages.io.pictures import UnreadableImage
from stages.io.png import FAST, read_png, write_png
from stages.scratch import note, noted, once, opened

LAYOUT = 2  # of the work folder; raise it when what is written there changes meaning
BLOCK_SIZE = 8  # images along a side of a block of pairs: between two blocks lies a safe point, a second or three apart
UPSAMPLE_BELOW = 1000  # pixels, longest side: of smaller images features are detected at twice the size; docs/experiments/sfm.md
OVERLAP = 10  # of sequential matching: images that follow each one
KEYFRAMES = 40  # images of a sequence that are all matched with each other, for loop closure

Side = Annotated[int, msgspec.Meta(ge=1, le=2**20)]  # pixels
Progress = Callable[..., None]
SafePoint = Callable[[], None]


@dataclass(frozen=True)
class WorkImage:
    """The copy of one photograph after EXIF rotation.

    name            of the photograph
    file            of the copy: numbers in sorted order of name
    width, height   of the photograph after EXIF rotation, pixels
    work_width, work_height  of the copy
    focal           pixels of the photograph, from its EXIF data, or None
    camera_key      photographs with equal keys share a COLMAP camera: same size, maker and focal length
    """

    name: str
    file: str
    width: Side
    height: Side
    work_width: Side
    work_height: Side
    focal: Annotated[float, msgspec.Meta(gt=0)] | None
    camera_key: str


# glog installs handlers of these when pycolmap is imported; they print a stack trace and abort, at SIGTERM too.
_GLOG_SIGNALS = (signal.SIGSEGV, signal.SIGILL, signal.SIGFPE, signal.SIGABRT, signal.SIGBUS, signal.SIGTERM)
_SIGACTION_BYTES = 1024  # bytes; a struct sigaction takes 152 on Linux


def import_pycolmap() -> Any:
    """pycolmap, the only place that imports it.

    zlib, numpy and Pillow come first: the libraries inside of pycolmap 4 hide those of the same names that are loaded later, and zlib then frees what
    it never had. Signal handlers are restored afterwards, by sigaction(2): Python's signal module knows nothing of handlers that faulthandler or
    another library has set, and works in the main thread only.
    """
    if "pycolmap" not in sys.modules:
        import zlib  # noqa: F401

        import numpy  # noqa: F401
        import PIL.Image  # noqa: F401

        libc = ctypes.CDLL(None)
        handlers = [(number, ctypes.create_string_buffer(_SIGACTION_BYTES)) for number in _GLOG_SIGNALS]
        for number, handler in handlers:
            libc.sigaction(int(number), None, handler)
        # A SIGTERM that arrives meanwhile is delivered to the restored handler.
        blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})
        try:
            import pycolmap
        finally:
            for number, handler in handlers:
                libc.sigaction(int(number), handler, None)
            signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
    import pycolmap

    return pycolmap


@contextlib.contextmanager
def quiet_pycolmap() -> Iterator[Any]:
    """pycolmap with its log silenced, except for fatal errors."""
    pycolmap = import_pycolmap()
    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = 3
    try:
        yield pycolmap
    finally:
        pycolmap.logging.minloglevel = before


def num_threads() -> int:
    """CPUs this process may use."""
    return max(1, len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1)


def _sha256(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def prepare_images(
    folder: Path,
    names: Sequence[str],
    *,
    max_side: int,
    features: int,
    seed: int,
    masks: Mapping[str, Path],
    paths: Mapping[str, Path] | None = None,
    work: Path,
    progress: Progress,
    safe_point: SafePoint,
    warn: Callable[..., None],
) -> tuple[list[WorkImage], list[tuple[str, str]]]:
    """Copies of the photographs in `work/images` after EXIF rotation, longest side at most `max_side`; without those that cannot be read.

    paths    of some or all names: the file that is read, where it is not the name below the folder
    returns  the copies in sorted order of name, and (name, reason) of each photograph left out

    What an earlier, killed call with the same photographs and settings left in `work` is kept, anything else there is removed.
    """
    paths = {name: folder / name for name in names} | dict(paths or {})
    request = {"layout": LAYOUT, "max_side": max_side, "features": features, "seed": seed, "photographs": _digests(paths, masks, safe_point)}
    text = json.dumps(request, indent=1, sort_keys=True)
    record = work / "request.json"
    parts = work / "images", work / "masks"
    work.mkdir(parents=True, exist_ok=True)
    if not _holds(record, text.encode()) or any(part.is_symlink() or not part.is_dir() for part in parts):
        for entry in list(work.iterdir()):
            remove(entry)
        for part in parts:
            part.mkdir()
        write_atomically(record, text.encode(), durable=False)
    images: list[WorkImage] = []
    rejected: list[tuple[str, str]] = []
    warn_once = once(warn)
    for index, name in enumerate(sorted(paths)):
        safe_point()
        record = work / f"copy_{index:05d}.json"
        copied = noted(record, Copy, warn_once, partial(_check, name, index, max_side, work))
        if copied is None:
            copied, outputs = _copy(name, paths[name], index, max_side, masks.get(name), work)
            note(record, msgspec.to_builtins(copied), outputs)
        if copied.image is None:
            rejected.append((name, copied.remark))
            warn(f"{name}: {copied.remark}; left out.")
        else:
            if copied.remark:
                warn(f"{name}: {copied.remark}")
            images.append(copied.image)
        progress(index + 1, len(paths), "reading photographs")
    return images, rejected


def _digests(paths: Mapping[str, Path], masks: Mapping[str, Path], safe_point: SafePoint) -> list[list[str | None]]:
    rows: list[list[str | None]] = []
    for name in sorted(paths):
        safe_point()
        try:
            digest = _sha256(paths[name])
        except OSError as error:
            digest = str(error.strerror)
        rows.append([name, digest, _sha256(masks[name]) if name in masks else None])
    return rows


@dataclass(frozen=True)
class Copy:
    """What became of a photograph: its copy, or None where it could not be read; and a remark, or the reason."""

    image: WorkImage | None
    remark: str


def _file(index: int) -> str:
    return f"{index:05d}.png"


def _copy(name: str, path: Path, index: int, max_side: int, mask_path: Path | None, work: Path) -> tuple[Copy, list[Path]]:
    """Copy one photograph; with the files written."""
    try:
        photo: DecodedPhoto = read_photo(path, max_side)
    except UnreadableImage as error:
        return Copy(None, str(error)), []
    outputs = [work / "images" / _file(index)]
    write_png(photo.rgb, outputs[0], compress_level=FAST, durable=False)
    mask, remark = photo.opaque, ""
    if mask_path is not None:
        try:
            given = read_mask_file(mask_path, photo)
            mask = given if mask is None else mask & given
        except UnreadableImage as error:
            remark = f"its mask is not used: {error}"
    if mask is not None:
        outputs.append(work / "masks" / f"{_file(index)}.png")
        write_png(np.where(mask, np.uint8(255), np.uint8(0)), outputs[1], compress_level=FAST, durable=False)
    height, width = photo.rgb.shape[:2]
    focal = None if photo.focal is None else float(photo.focal)
    key = f"{photo.width}x{photo.height} {photo.maker} {focal if focal is None else round(focal, 1)}"
    return Copy(WorkImage(name, _file(index), photo.width, photo.height, width, height, focal, key), remark), outputs


def _check(name: str, index: int, max_side: int, work: Path, copied: Copy, outputs: Collection[str]) -> None:
    """Raises where this is not what became of a photograph, or its copy and mask are not there at working size."""
    image = copied.image
    if image is None:
        return
    if (image.name, image.file) != (name, _file(index)) or max(image.work_width, image.work_height) > max_side:
        raise ValueError("of another photograph")
    for path in (work / "images" / image.file, work / "masks" / f"{image.file}.png"):
        there = path.relative_to(work).as_posix() in outputs
        if there and read_png(path).shape[:2] != (image.work_height, image.work_width):
            raise ValueError(f"{path.name} is of another size")
        if not there and path.parent.name == "images":
            raise ValueError(f"{path.name} is missing")
        if not there:
            remove(path)  # that of a photograph without a mask, of which only `extract_features` knows


def _holds(path: Path, data: bytes) -> bool:
    """Whether a plain file has exactly this content."""
    try:
        with opened(path) as file:
            return file.read(len(data) + 1) == data
    except OSError:
        return False


def database_path(work: Path) -> Path:
    return work / "database.db"


def remove_database(work: Path) -> None:
    for suffix in ("", "-wal", "-shm", "-journal"):
        Path(str(database_path(work)) + suffix).unlink(missing_ok=True)


def open_database(work: Path, images: Sequence[WorkImage]) -> bool:
    """Make a database of exactly `images`, each with its camera, unless there is an intact one.

    returns  whether features or matches of an earlier call are kept
    """
    if database_path(work).exists():
        if _is_intact(database_path(work), images):
            return True
        remove_database(work)
    # The database appears by rename: a kill while the images are being listed leaves none.
    aside = work / "database.part"
    for suffix in ("", "-wal", "-shm", "-journal"):
        Path(str(aside) + suffix).unlink(missing_ok=True)
    with quiet_pycolmap() as pycolmap:
        cameras: dict[str, int] = {}
        for image in images:
            if image.camera_key not in cameras:
                with pycolmap.Database.open(aside) as database:
                    cameras[image.camera_key] = database.write_camera(_first_guess(image))
            options = pycolmap.ImageReaderOptions()
            options.existing_camera_id = cameras[image.camera_key]
            pycolmap.import_images(aside, work / "images", pycolmap.CameraMode.SINGLE, [image.file], options)
    with contextlib.closing(sqlite3.connect(aside)) as connection:
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    rename(aside, database_path(work))
    return False


def _first_guess(image: WorkImage) -> Any:
    """SIMPLE_RADIAL, which few photographs suffice for; `mapping.bundle_adjusted` tries OPENCV. Without EXIF data the initial focal length is 1.2
    times the longest side, as COLMAP has it.
    """
    pycolmap = import_pycolmap()
    scale = np.sqrt(image.work_width * image.work_height / (image.width * image.height))
    focal = image.focal * scale if image.focal else 1.2 * max(image.work_width, image.work_height)
    camera = pycolmap.Camera(
        model="SIMPLE_RADIAL", width=image.work_width, height=image.work_height, params=[focal, image.work_width / 2, image.work_height / 2, 0.0]
    )
    camera.has_prior_focal_length = image.focal is not None
    return camera


def _is_intact(path: Path, images: Sequence[WorkImage]) -> bool:
    """Whether SQLite finds no damage, the images are `images`, and no image or pair is written in part."""
    try:
        with contextlib.closing(sqlite3.connect(path)) as connection:
            execute = connection.execute
            if execute("PRAGMA integrity_check").fetchall() != [("ok",)]:
                return False
            if [row[0] for row in execute("SELECT name FROM images ORDER BY image_id")] != [image.file for image in images]:
                return False
            if execute("SELECT COUNT(DISTINCT camera_id) FROM images").fetchone()[0] != len({image.camera_key for image in images}):
                return False
            keypoints = dict(execute("SELECT image_id, rows FROM keypoints").fetchall())
            descriptors = dict(execute("SELECT image_id, rows FROM descriptors").fetchall())
            if keypoints != descriptors:
                return False
            matched = {row[0] for row in execute("SELECT pair_id FROM matches")}
            return {row[0] for row in execute("SELECT pair_id FROM two_view_geometries")} <= matched
    except sqlite3.Error:
        return False


def extract_features(work: Path, images: Sequence[WorkImage], *, features: int, threads: int | None = None, progress: Progress, safe_point: SafePoint) -> None:
    """SIFT features of the images that have none yet, a few images at a time.

    threads  None: as many as the process may use. An image's features do not depend on them
    """
    threads = threads or num_threads()
    with quiet_pycolmap() as pycolmap:
        with pycolmap.Database.open(database_path(work)) as database:
            known = {image.name for image in database.read_all_images() if database.exists_descriptors(image.image_id)}
        reader = pycolmap.ImageReaderOptions()
        if any((work / "masks").glob("*.png")):
            for image in images:  # COLMAP skips an image whose mask is missing
                if not (work / "masks" / f"{image.file}.png").exists():
                    everything = np.full((image.work_height, image.work_width), 255, np.uint8)
                    write_png(everything, work / "masks" / f"{image.file}.png", compress_level=FAST, durable=False)
            reader.mask_path = work / "masks"
        options = pycolmap.FeatureExtractionOptions()
        options.use_gpu = False
        options.num_threads = threads
        options.sift.max_num_features = features
        done = len(known)
        progress(done, len(images), "detecting features")
        for octave in (-1, 0):
            options.sift.first_octave = octave
            todo = [i for i in images if i.file not in known and (max(i.work_width, i.work_height) < UPSAMPLE_BELOW) == (octave < 0)]
            for start in range(0, len(todo), 2 * threads):
                safe_point()
                some = [image.file for image in todo[start : start + 2 * threads]]
                pycolmap.extract_features(
                    database_path(work), work / "images", some, reader_options=reader, extraction_options=options, device=pycolmap.Device.cpu
                )
                done += len(some)
                progress(done, len(images), "detecting features")


def pairs_to_match(count: int, how: str) -> list[list[tuple[int, int]]]:
    """Blocks of pairs (i < j) of positions in the sorted list of images.

    exhaustive  every pair
    sequential  each image with the OVERLAP that follow and those 2, 4, 8 times as far; and up to KEYFRAMES images, evenly spaced, with each other
                for loop closure
    """
    if how == "exhaustive":
        wanted = {(i, j) for i in range(count) for j in range(i + 1, count)}
    elif how == "sequential":
        offsets = [*range(1, OVERLAP + 1), *(OVERLAP * 2**k for k in range(1, 4))]
        wanted = {(i, i + offset) for i in range(count) for offset in offsets if i + offset < count}
        key = range(0, count, max(1, -(-count // KEYFRAMES)))
        wanted |= {(i, j) for i in key for j in key if i < j}
    else:
        raise ValueError(f"matching {how!r}: expected 'exhaustive' or 'sequential'")
    blocks: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for i, j in sorted(wanted):
        blocks.setdefault((i // BLOCK_SIZE, j // BLOCK_SIZE), []).append((i, j))
    return [blocks[place] for place in sorted(blocks)]


def match_pairs(work: Path, images: Sequence[WorkImage], *, how: str, seed: int, progress: Progress, safe_point: SafePoint) -> None:
    """Matches and two-view geometries of the pairs that have none yet, a block at a time.

    On one thread: COLMAP's FAISS multiplies matrices by an OpenBLAS that is not thread-safe, which gave wrong matches in about one of sixty runs
    (docs/experiments/sfm.md). COLMAP verifies in another thread meanwhile, without BLAS.
    """
    with quiet_pycolmap() as pycolmap:
        with pycolmap.Database.open(database_path(work)) as database:
            ids = {image.name: image.image_id for image in database.read_all_images()}
            verified = {tuple(sorted(pair)) for pair in verified_pairs(database_path(work))}
        matching = pycolmap.FeatureMatchingOptions()
        matching.use_gpu = False
        matching.num_threads = 1
        geometry = pycolmap.TwoViewGeometryOptions()
        geometry.ransac.random_seed = seed
        pairing = pycolmap.ImportedPairingOptions()
        pairing.match_list_path = pairs = work / "pairs.txt"
        blocks = pairs_to_match(len(images), how)
        total, done = sum(map(len, blocks)), 0
        for block in blocks:
            safe_point()
            todo = [(i, j) for i, j in block if tuple(sorted((ids[images[i].file], ids[images[j].file]))) not in verified]
            if todo:
                write_atomically(pairs, "".join(f"{images[i].file} {images[j].file}\n" for i, j in todo).encode(), durable=False)
                pycolmap.match_image_pairs(database_path(work), matching, pairing, geometry, pycolmap.Device.cpu)
            done += len(block)
            progress(done, total, "matching pairs")


def verified_pairs(path: Path) -> list[tuple[int, int]]:
    """Image ids of each pair in the table of two-view geometries, in order."""
    with contextlib.closing(sqlite3.connect(path)) as connection:
        return [image_ids_of_pair(row[0]) for row in connection.execute("SELECT pair_id FROM two_view_geometries ORDER BY pair_id")]


def image_ids_of_pair(pair: int) -> tuple[int, int]:
    """The two image ids of a pair id in COLMAP's database."""
    return (pair - pair % 2147483647) // 2147483647, pair % 2147483647
