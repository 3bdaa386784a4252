"""The poses artifact of an analytic ball, and jobs over it."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from efficientnerf.geometry.cameras import Similarity
from efficientnerf.geometry.orbit import Orbit
from pipeline.stage import Job
from stages.io.png import write_png
from stages.io.scene import Scene, View, save
from tests.efficientnerf import balls

SIMILARITY = Similarity(0.5, np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]), np.array([0.1, 0.2, 0.3]))
ORBIT = Orbit((0.0, 0.0, 0.1), 3.0, 20.0, False, 40.0)


def poses(folder: Path, *, count: int = 8, side: int = 16, photographs: bool = False, **changes: Any) -> Path:
    """A scene of `count` square views, the last a test view."""
    (folder / "images").mkdir(parents=True)
    views = []
    for n, camera in enumerate(balls.cameras(count, side)):
        write_png(balls.photograph(camera) if photographs else balls.picture(camera), folder / "images" / camera.name)
        split = "test" if n == count - 1 else "train"
        views.append(View(f"images/{camera.name}", None, split, camera, SIMILARITY.inverse().camera(camera), 1.0, 50.0 if photographs else 5.0))
    scene = Scene("ball", tuple(views), balls.BOUNDS, None if photographs else (1.0, 1.0, 1.0), SIMILARITY, ORBIT, metric=True)
    save(replace(scene, **changes), folder)
    return folder


def job(folder: Path, settings: Any, *, stop: Callable[[], int | None] | None = None, events: list[dict[str, Any]] | None = None, **inputs: Path) -> Job:
    """A job whose outputs lie in folder/out and whose scratch in folder/work."""
    return Job(settings=settings, inputs=inputs, out=folder / "out", work=folder / "work", stop=stop, report=None if events is None else events.append)


class StopAt:
    """A signal that arrives at the given calls of safe_point, counted over all attempts."""

    def __init__(self, *calls: int) -> None:
        self.calls, self.count = set(calls), 0

    def __call__(self) -> int | None:
        self.count += 1
        return 2 if self.count in self.calls else None
