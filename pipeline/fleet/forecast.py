"""How long a fleet will go on, by the stages that have been done; and the space on its disk: stages are admitted by what they will write, so that concurrent
stages do not fill it."""

import contextlib
import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean

from pipeline.fleet.state import SceneState
from pipeline.links import WORK

RESERVE, RESERVE_PER_SCENE = 4 * 2**20, 4096  # bytes that stay free: for fleet.json and its pages, while they are replaced


def free_space(fleet: Path) -> int:
    return shutil.disk_usage(fleet).free


def written_in(run: Path) -> int:
    """Bytes of what the stage that a run is at has written so far."""
    found = 0
    for parent, _, names in os.walk(run / WORK):
        for name in names:
            with contextlib.suppress(OSError):  # it was removed meanwhile
                found += os.lstat(os.path.join(parent, name)).st_size
    return found


def forecast_seconds(scenes: Sequence[SceneState], stages: Sequence[str], slots: int) -> float | None:
    """Seconds of all stages that wait or run, at the mean of those of the same name, on so many slots; None until each stage has been done once."""
    done: dict[str, list[float]] = {stage: [] for stage in stages}
    waiting = dict.fromkeys(stages, 0)
    for scene in scenes:
        for stage in stages:
            found = scene.stages.get(stage)
            if found is not None and found.state == "done":
                done[stage].append(found.seconds)
            elif scene.state in ("waiting", "running"):
                waiting[stage] += 1
    if any(count and not done[stage] for stage, count in waiting.items()):
        return None
    return sum(count * fmean(done[stage]) for stage, count in waiting.items() if count) / max(1, slots)
