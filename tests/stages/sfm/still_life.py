"""Photographs of the still life in examples/, whose true cameras are known, and how far found cameras are off."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.poses import aligned_errors, true_centres
from stages.io.capture import Capture

ROOT = Path(__file__).resolve().parents[3]
STILL_LIFE, TRUTH = ROOT / "examples" / "still_life", ROOT / "tests" / "data" / "still_life_cameras.json"
QUIET: dict[str, Any] = {"progress": lambda *a, **k: None, "safe_point": lambda: None}
SILENT: dict[str, Any] = {**QUIET, "warn": lambda *a, **k: None}


def neighbours(count: int) -> list[str]:
    """The names of so many photographs along a part of the circle, sorted."""
    centres = true_centres(TRUTH)
    names = sorted(path.name for path in STILL_LIFE.glob("*.jpg"))
    if len(names) < count:
        pytest.skip("examples/still_life is not there")
    return sorted(sorted(names, key=lambda name: -centres[name][0])[:count])


def errors_of(capture: Capture, centres: Mapping[str, np.ndarray] | None = None) -> np.ndarray:
    """(C,) as `aligned_errors`; the true centres by the names of the photographs, without their folders: of the still life, unless others are given."""
    centres = true_centres(TRUTH) if centres is None else centres
    cameras = [photo.camera for photo in capture.photos]
    return aligned_errors(np.array([camera.centre for camera in cameras]), np.array([centres[Path(camera.name).name] for camera in cameras]))
