"""Accuracy and speed of finding cameras from the sample photographs.

    python -m benchmarks.poses [--photographs FOLDER] [--truth FILE.json | --no-truth] [--out benchmarks/results/poses_cpu.json]

Prints, and saves as the row of the folder's name: photographs registered, RMS and largest error of the camera centres after a similarity
alignment, in per cent of their mean distance to the centroid, the camera model, seconds, processor seconds and the load average before and after.
"""

import argparse
import json
import os
import platform
import resource
import tempfile
import time
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path

import numpy as np

from benchmarks.project import ROOT
from efficientnerf.geometry.cameras import closest_similarity, pose_from_opengl
from pipeline.files import read_json
from stages.artifacts import PosesOutputs
from stages.sfm.cameras import find_cameras
from stages.sfm.reconstruction import Request

STILL_LIFE, TRUTH = ROOT / "examples" / "still_life", ROOT / "tests" / "data" / "still_life_cameras.json"


def aligned_errors(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """(C,) distances after the best similarity from (C, 3) found to true centres, over the mean distance of the true ones to their centroid."""
    away = closest_similarity(found, true).points(found) - true
    return np.asarray(np.linalg.norm(away, axis=1) / np.linalg.norm(true - true.mean(0), axis=1).mean())


def percent_off(found: Mapping[str, np.ndarray], true: Mapping[str, np.ndarray]) -> float | None:
    """Root mean square of the errors of centres, by names, in per cent; None where fewer than four have the same name."""
    names = sorted(found.keys() & true.keys())
    if len(names) < 4:
        return None
    errors = aligned_errors(*(np.array([which[name] for name in names]) for which in (found, true)))
    return round(100 * float(np.sqrt((errors**2).mean())), 3)


def true_centres(path: Path) -> dict[str, np.ndarray]:
    frames = json.loads(path.read_text())["frames"]
    return {frame["file_path"]: pose_from_opengl(np.array(frame["transform_matrix"]))[:3, 3] for frame in frames}


def found_centres(run: Path) -> dict[str, np.ndarray]:
    """The centres of a run's cameras in the capture's frame, by the names of their photographs."""
    cameras = [view["source_camera"] for view in read_json(PosesOutputs.of_run(run).scene)["views"]]
    return {camera["name"]: np.array(camera["world_from_camera"])[:3, 3] for camera in cameras}


def processor_seconds() -> float:
    """Of this process and of those that it has waited for: structure from motion runs in some of its own."""
    both = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(each.ru_utime + each.ru_stime for each in both)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--photographs", type=Path, default=STILL_LIFE)
    parser.add_argument("--truth", type=Path, default=TRUTH)
    parser.add_argument("--no-truth", action="store_true", help="of photographs whose true cameras are not known")
    parser.add_argument("--out", type=Path, default=None)
    arguments = parser.parse_args()
    truth = {} if arguments.no_truth else true_centres(arguments.truth)
    found = sorted(path.name for path in arguments.photographs.iterdir())
    names = [name for name in found if name in truth] if truth else [name for name in found if name.lower().endswith((".jpg", ".jpeg", ".png"))]
    load_before, started, used = os.getloadavg()[0], time.perf_counter(), processor_seconds()
    phases: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as work:
        capture = find_cameras(
            Request(arguments.photographs, {name: arguments.photographs / name for name in names}, Path(work)),
            progress=lambda done, total, text="", **facts: phases.update({text: round(time.perf_counter() - started, 2)}),
            safe_point=lambda: None,
            warn=lambda text, **facts: print(text),
        )
    seconds, used = time.perf_counter() - started, processor_seconds() - used
    result: dict[str, object] = {
        "photographs": len(names),
        "registered": len(capture.photos),
        "matches_that_agree": capture.provenance.pairs_agreeing,
        "reprojection_error_px": round(float(capture.reprojection_error or 0), 4),
        "lens": {capture.photos[0].camera.model: capture.photos[0].camera.params},
        "seconds": round(seconds, 2),
        "processor_seconds": round(used, 2),
        "phase_ends_at": phases,
        "load_before": load_before,
        "load_after": os.getloadavg()[0],
        "machine": {"cores": len(os.sched_getaffinity(0)), "processor": platform.machine(), "pycolmap": version("pycolmap")},
    }
    if truth:
        errors = aligned_errors(np.array([photo.camera.centre for photo in capture.photos]), np.array([truth[photo.camera.name] for photo in capture.photos]))
        result |= {"centre_rms_percent": round(100 * float(np.sqrt((errors**2).mean())), 4), "centre_max_percent": round(100 * float(errors.max()), 4)}
    print(json.dumps(result, indent=1))
    if arguments.out:
        rows = json.loads(arguments.out.read_text())["rows"] if arguments.out.exists() else {}
        rows[arguments.photographs.name] = result
        arguments.out.write_text(json.dumps({"rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
