"""How long a fleet will go on, by the stages that have been done."""

from collections.abc import Sequence
from statistics import fmean

from pipeline.fleet.state import SceneState


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
