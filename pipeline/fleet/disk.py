"""Free space on a fleet's disk: stages are admitted by what they will write, so that concurrent stages do not fill it."""

import os
import shutil
from collections.abc import Iterable
from pathlib import Path

from pipeline.links import WORK

RESERVE, SCENE = 4 * 2**20, 4096  # bytes that stay free: for fleet.json and its pages, and of these for each scene, while they are replaced


def free_space(fleet: Path) -> int:
    return shutil.disk_usage(fleet).free


def has_room(free: int, wanted: tuple[Path, int], running: Iterable[tuple[Path, int]]) -> bool:
    """Whether a stage fits on the disk together with those that run.

    free     bytes
    wanted   its run, and the bytes that it writes in all
    running  the same of those that run; what they have written already is no longer free
    """
    pairs = [wanted, *running]
    if sum(need for _, need in pairs) + RESERVE <= free:
        return True
    return sum(max(0, need - written_in(run)) for run, need in pairs) + RESERVE <= free


def written_in(run: Path) -> int:
    """Bytes of what the stage that a run is at has written so far."""
    found = 0
    for parent, _, names in os.walk(run / WORK):
        for name in names:
            try:
                found += os.lstat(os.path.join(parent, name)).st_size
            except OSError:  # it was removed meanwhile
                continue
    return found
