"""Free space on a fleet's disk: stages are admitted by what they will write, so that concurrent stages do not fill it."""

import os
import shutil
from pathlib import Path

from pipeline.links import WORK

RESERVE, RESERVE_PER_SCENE = 4 * 2**20, 4096  # bytes that stay free: for fleet.json and its pages, while they are replaced


def free_space(fleet: Path) -> int:
    return shutil.disk_usage(fleet).free


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
