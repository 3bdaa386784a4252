"""Pairs matched in several processes, each with a database of its own: one process has one thread that compares (`matches.match_pairs`).

A worker is a child as that of structure from motion (`stages.sfm.process`), started from it. For each block of pairs it copies the features of these images
into its database, matches, and reports; one process copies the rows into the database of all.
"""

import contextlib
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from pipeline.files import SafePoint, remove, write_atomically
from stages.sfm import process
from stages.sfm.colmap import quiet_pycolmap
from stages.sfm.database import FEATURES, PAIRS, attached, copy_rows, database_path, pair_id_of, record

GUIDED_RATIO = 0.88  # of the distances of the two best; COLMAP's own is 0.8
POLL_SECONDS = 0.1  # seconds between two checks of the workers
Block = Sequence[tuple[int, int]]  # of image ids, the smaller first


class _Stopped(Exception):
    """Another worker has failed, or the user has asked to stop."""


def match(work: Path, blocks: Mapping[str, Block], *, seed: int, guided: bool, workers: int, more: Callable[[int], None], safe_point: SafePoint) -> None:
    """Match blocks of pairs, by the name of the note of each.

    more  gets the number of pairs that are done
    """
    stop, one_at_a_time, failures, counts = threading.Event(), threading.Lock(), list[BaseException](), list[int]()
    names = list(blocks)

    def go_on() -> None:
        if stop.is_set():
            raise _Stopped

    def run_worker(number: int) -> None:
        scratch = work / f"worker_{number}"

        def finished(position: int, *_: Any) -> None:
            name = mine[position]
            with one_at_a_time:
                copy_rows(database_path(scratch), database_path(work), PAIRS, [pair_id_of(*pair) for pair in blocks[name]])
                record(work, name, PAIRS, [pair_id_of(*pair) for pair in blocks[name]])
                counts.append(len(blocks[name]))

        mine = names[number::workers]
        arguments = {"work": str(work), "scratch": str(scratch), "seed": seed, "guided": guided, "blocks": [list(map(list, blocks[name])) for name in mine]}
        try:
            process.run(arguments, task="pairs", progress=finished, safe_point=go_on, warn=lambda *_, **__: None)
        except _Stopped:
            pass
        except BaseException as error:
            failures.append(error)
            stop.set()
        finally:
            remove(scratch)

    threads = [threading.Thread(target=run_worker, args=(number,), name=f"pairs {number}") for number in range(workers)]
    for thread in threads:
        thread.start()
    try:
        for thread in threads:
            while thread.is_alive():
                safe_point()
                thread.join(POLL_SECONDS)
                while counts:
                    more(counts.pop(0))
    finally:
        stop.set()
        for thread in threads:
            thread.join()
    if failures:
        raise failures[0]


def match_for(arguments: Mapping[str, Any], *, progress: Callable[..., None], safe_point: SafePoint, warn: Callable[..., None]) -> None:
    """The work of one worker. The parent copies its rows between `progress` and the return of `safe_point`."""
    work, scratch = Path(arguments["work"]), Path(arguments["scratch"])
    remove(scratch)
    scratch.mkdir()
    names = _make_database(work, scratch)
    for position, block in enumerate(arguments["blocks"]):
        safe_point()
        # The features of the block's images take the place of all that is in the database.
        images = sorted({image for pair in block for image in pair})
        marks = ", ".join("?" * len(images))
        with contextlib.closing(attached(scratch, work)) as connection, connection:
            for table, _ in PAIRS:
                connection.execute(f"DELETE FROM {table}")
            for table, column in FEATURES:
                connection.execute(f"DELETE FROM {table}")
                connection.execute(f"INSERT INTO {table} SELECT * FROM everything.{table} WHERE {column} IN ({marks})", images)
        match_block(database_path(scratch), scratch / "pairs.txt", [(i, j) for i, j in block], names, arguments["seed"], arguments["guided"])
        progress(position)
    safe_point()


def match_block(database: Path, listed: Path, block: Block, names: Mapping[int, str], seed: int, guided: bool = False) -> None:
    """Match pairs of images on one thread."""
    with quiet_pycolmap() as pycolmap:
        matching = pycolmap.FeatureMatchingOptions()
        matching.use_gpu = False
        matching.num_threads = 1
        if guided:
            matching.guided_matching = True
            matching.sift.max_ratio = GUIDED_RATIO
        geometry = pycolmap.TwoViewGeometryOptions()
        geometry.ransac.random_seed = seed
        pairing = pycolmap.ImportedPairingOptions()
        pairing.match_list_path = listed
        write_atomically(listed, "".join(f"{names[i]} {names[j]}\n" for i, j in block).encode(), durable=False)
        pycolmap.match_image_pairs(database, matching, pairing, geometry, pycolmap.Device.cpu)


def _make_database(work: Path, scratch: Path) -> dict[int, str]:
    """A database of the same images and cameras without features; returns the name of each image by its id."""
    with quiet_pycolmap() as pycolmap:
        pycolmap.Database.open(database_path(scratch)).close()
    own = {table for table, _ in (*FEATURES, *PAIRS)}
    with contextlib.closing(attached(scratch, work)) as connection, connection:
        tables = [row[0] for row in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table' AND name NOT LIKE 'sqlite_%'")]
        for table in tables:
            if table not in own:
                connection.execute(f"DELETE FROM {table}")
                connection.execute(f"INSERT INTO {table} SELECT * FROM everything.{table}")
        return dict(connection.execute("SELECT image_id, name FROM images"))
