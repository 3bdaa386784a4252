"""Features of the photographs' copies and verified matches between them, in COLMAP's database, resumable."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.files import write_atomically
from stages.io.png import FAST, write_png
from stages.sfm.colmap import num_threads, quiet_pycolmap
from stages.sfm.database import FEATURES, PAIRS, database_path, pair_id_of, record, verified_pairs
from stages.sfm.images import Progress, SafePoint, WorkImage

BLOCK_SIZE = 8  # images along a side of a block of pairs: between two blocks lies a safe point, a second or three apart
UPSAMPLE_BELOW = 1000  # pixels, longest side: of smaller images features are detected at twice the size; docs/experiments/sfm.md
OVERLAP = 10  # of sequential matching: images that follow each one
KEYFRAMES = 40  # images of a sequence that are all matched with each other, for loop closure


def extract_features(work: Path, images: Sequence[WorkImage], *, features: int, threads: int | None = None, progress: Progress, safe_point: SafePoint) -> None:
    """SIFT features of the images that have none yet, a few images at a time.

    threads  None: as many as the process may use. An image's features do not depend on them
    """
    threads = threads or num_threads()
    with quiet_pycolmap() as pycolmap:
        with pycolmap.Database.open(database_path(work)) as database:
            ids = {image.name: image.image_id for image in database.read_all_images()}
            known = {name for name, image_id in ids.items() if database.exists_descriptors(image_id)}
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
                for _ in range(2):
                    pycolmap.extract_features(
                        database_path(work), work / "images", some, reader_options=reader, extraction_options=options, device=pycolmap.Device.cpu
                    )
                    if not _check_readable(work, _without_features(pycolmap, work, ids, some)):
                        break
                record(work, f"features_{Path(some[0]).stem}", FEATURES, [ids[file] for file in some])
                done += len(some)
                progress(done, len(images), "detecting features")


def _without_features(pycolmap: Any, work: Path, ids: Mapping[str, int], files: Sequence[str]) -> list[str]:
    """Those that COLMAP has written no features of, not even that there are none."""
    with pycolmap.Database.open(database_path(work)) as database:
        return [file for file in files if not database.exists_descriptors(ids[file])]


def _check_readable(work: Path, files: Sequence[str]) -> bool:
    """Whether there are any; raises the OSError that may have kept COLMAP from reading one, for it goes on without."""
    for file in files:
        (work / "images" / file).read_bytes()
        if (mask := work / "masks" / f"{file}.png").exists():
            mask.read_bytes()
    return bool(files)


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
            verified = {(min(pair), max(pair)) for pair in verified_pairs(database_path(work))}
        matching = pycolmap.FeatureMatchingOptions()
        matching.use_gpu = False
        matching.num_threads = 1
        geometry = pycolmap.TwoViewGeometryOptions()
        geometry.ransac.random_seed = seed
        pairing = pycolmap.ImportedPairingOptions()
        pairing.match_list_path = pairs = work / "pairs.txt"
        blocks = pairs_to_match(len(images), how)
        total, done = sum(map(len, blocks)), 0
        for number, block in enumerate(blocks):
            safe_point()
            keys = {(i, j): _ordered(ids[images[i].file], ids[images[j].file]) for i, j in block}
            todo = [pair for pair in block if keys[pair] not in verified]
            if todo:
                write_atomically(pairs, "".join(f"{images[i].file} {images[j].file}\n" for i, j in todo).encode(), durable=False)
                pycolmap.match_image_pairs(database_path(work), matching, pairing, geometry, pycolmap.Device.cpu)
                record(work, f"pairs_{number:06d}", PAIRS, [pair_id_of(*pair) for pair in keys.values()])
            done += len(block)
            progress(done, total, "matching pairs")


def _ordered(first: int, second: int) -> tuple[int, int]:
    return min(first, second), max(first, second)
