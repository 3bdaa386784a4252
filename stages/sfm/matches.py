"""Features of the photographs' copies and verified matches between them, in COLMAP's database, resumable."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.files import SafePoint
from stages.cores import count_cores
from stages.io.png import FAST, write_png
from stages.sfm import feature_cache, pair_workers, pairs
from stages.sfm.colmap import quiet_pycolmap
from stages.sfm.database import FEATURES, PAIRS, WorkImage, database_path, images_of, inlier_counts, neighbours, pair_id_of, record
from stages.sfm.images import Progress
from stages.sfm.pairs import Pair, aggregated, in_blocks, likeness_of, ordered

UPSAMPLE_BELOW = 1000  # pixels, longest side: of smaller images features are detected at twice the size; docs/experiments/sfm.md
MAX_WORKERS = 8  # processes that match pairs
MIN_NEIGHBOURS = 3  # photographs that one overlaps with; of fewer, more are looked for
MIN_PAIRS_A_WORKER = 96  # a process is not worth its start for fewer


def extract_features(
    work: Path, images: Sequence[WorkImage], *, features: int, threads: int | None = None, contrast: float = 1.0, progress: Progress,
    safe_point: SafePoint,
) -> None:
    """SIFT features of the images that have none yet, a few images at a time; those that were detected before are taken from where they are kept.

    threads   None: as many as the process may use. An image's features do not depend on them
    contrast  that a feature must have, of COLMAP's default
    """
    threads, place = threads or count_cores(), images_of(work).parent
    with quiet_pycolmap() as pycolmap:
        with pycolmap.Database.open(database_path(work)) as database:
            ids = {image.name: image.image_id for image in database.read_all_images()}
            known = {name for name, image_id in ids.items() if database.exists_descriptors(image_id)}
        reader = pycolmap.ImageReaderOptions()
        if any((place / "masks").glob("*.png")):
            for image in images:  # COLMAP skips an image whose mask is missing
                if not (place / "masks" / f"{image.file}.png").exists():
                    everything = np.full((image.work_height, image.work_width), 255, np.uint8)
                    write_png(everything, place / "masks" / f"{image.file}.png", compress_level=FAST, durable=False)
            reader.mask_path = place / "masks"
        options = pycolmap.FeatureExtractionOptions()
        options.use_gpu = False
        options.num_threads = threads
        options.sift.max_num_features = features
        options.sift.peak_threshold *= contrast
        asked, done = {"features": features, "contrast": contrast}, len(known)
        progress(done, len(images), "detecting features")
        for octave in (-1, 0):
            options.sift.first_octave = octave
            todo = [i for i in images if i.file not in known and (max(i.work_width, i.work_height) < UPSAMPLE_BELOW) == (octave < 0)]
            for start in range(0, len(todo), 2 * threads):
                safe_point()
                some = [image.file for image in todo[start : start + 2 * threads]]
                keys = {ids[file]: key for file, key in feature_cache.keys_of(place, some, {**asked, "octave": octave}).items()}
                there = set(feature_cache.take(database_path(work), keys))
                if rest := [file for file in some if ids[file] not in there]:
                    _extract(pycolmap, work, rest, ids, reader, options)
                    feature_cache.put(database_path(work), {ids[file]: keys[ids[file]] for file in rest})
                record(work, f"features_{Path(some[0]).stem}", FEATURES, [ids[file] for file in some])
                done += len(some)
                progress(done, len(images), "detecting features")


def _extract(pycolmap: Any, work: Path, files: Sequence[str], ids: Mapping[str, int], reader: Any, options: Any) -> None:
    """Once more where COLMAP has written nothing of some, not even that they have no features; raises the OSError that may have kept it from reading one."""
    place, how = images_of(work).parent, {"reader_options": reader, "extraction_options": options, "device": pycolmap.Device.cpu}
    for _ in range(2):
        pycolmap.extract_features(database_path(work), place / "images", files, **how)
        with pycolmap.Database.open(database_path(work)) as database:
            left_out = [file for file in files if not database.exists_descriptors(ids[file])]
        if not left_out:
            break
        for path in [place / "images" / file for file in left_out] + [place / "masks" / f"{file}.png" for file in left_out]:
            if path.parent.name == "images" or path.exists():
                path.read_bytes()


def likeness(work: Path, seed: int, safe_point: SafePoint) -> np.ndarray:
    """(n, n) of the photographs, larger is more alike, by their features."""
    with quiet_pycolmap() as pycolmap, pycolmap.Database.open(database_path(work)) as database:
        descriptors = []
        for image in sorted(database.read_all_images(), key=lambda image: image.name):
            safe_point()
            every = np.asarray(database.read_descriptors(image.image_id).data, np.uint8).reshape(-1, 128)
            descriptors.append(aggregated(every).copy())  # not a view of all
    safe_point()
    return likeness_of(descriptors, seed)


def match_photographs(work: Path, images: Sequence[WorkImage], how: str, *, seed: int, workers: int, progress: Progress, safe_point: SafePoint) -> None:
    """Verified matches of the pairs that `how` stands for: "exhaustive", "sequential" or "retrieval". Of retrieval also of more pairs of the photographs
    that overlap with few others."""
    common: dict[str, Any] = {"seed": seed, "workers": workers, "progress": progress, "safe_point": safe_point}
    if how in ("exhaustive", "sequential"):
        match_pairs(work, images, pairs.all_pairs(len(images)) if how == "exhaustive" else pairs.sequential_pairs(len(images)), **common)
        return
    alike = likeness(work, seed, safe_point)
    match_pairs(work, images, pairs.retrieved_pairs(alike), **common)
    near = neighbours(work, len(images))
    weak = [i for i, others in near.items() if len(others) < MIN_NEIGHBOURS] + [i for part in pairs.components(near)[1:] for i in part]
    match_pairs(work, images, pairs.wider_pairs(alike, weak, near), name="wider_", **common)


def match_pairs(
    work: Path, images: Sequence[WorkImage], wanted: Iterable[Pair], *, seed: int, workers: int = 1, name: str = "", guided: bool = False,
    progress: Progress, safe_point: SafePoint,
) -> None:
    """Matches and two-view geometries of those of the wanted pairs that have none yet, a block at a time.

    workers  processes that may be busy at the same time; a pair's matches do not depend on them
    name     of the notes, one for each call on the same photographs
    guided   whether more matches are looked for along the geometry that the first ones fit, among less distinct ones

    A process compares on one thread: COLMAP's FAISS multiplies matrices by an OpenBLAS that is not thread-safe, which gave wrong matches in about one of
    sixty runs (docs/experiments/sfm.md). COLMAP verifies in another thread meanwhile, without BLAS.
    """
    with quiet_pycolmap() as pycolmap, pycolmap.Database.open(database_path(work)) as database:
        ids = {image.name: image.image_id for image in database.read_all_images()}
    verified = inlier_counts(database_path(work))
    blocks: dict[str, list[tuple[int, int]]] = {}
    total = done = 0
    for number, block in enumerate(in_blocks(wanted)):
        keys = [ordered(ids[images[i].file], ids[images[j].file]) for i, j in block]
        total += len(keys)
        todo = [key for key in keys if key not in verified]
        done += len(keys) - len(todo)
        if todo:
            blocks[f"pairs_{name}{number:06d}"] = todo
    left = total - done
    progress(done, total, "matching pairs")

    def more(count: int) -> None:
        nonlocal done
        done += count
        progress(done, total, "matching pairs")

    busy = min(workers, MAX_WORKERS, left // MIN_PAIRS_A_WORKER)
    if busy > 1:
        pair_workers.match(work, blocks, seed=seed, guided=guided, workers=busy, more=more, safe_point=safe_point)
        return
    names = {image_id: file for file, image_id in ids.items()}
    for note, block in blocks.items():
        safe_point()
        pair_workers.match_block(database_path(work), work / "pairs.txt", block, names, seed, guided)
        record(work, note, PAIRS, [pair_id_of(*pair) for pair in block])
        more(len(block))
