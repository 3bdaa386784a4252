"""Captures that no rule was made on: which share of the subject is masked before training. It must be 0.

    python -m benchmarks.made_captures --work FOLDER [--kinds gamepad,mirror] [--width 320] [--side 128] [--seed 0] [--out benchmarks/results]

Each capture of `benchmarks.scenes.captures` is read with its stated cameras and simulated sparse points, as the poses stage does, and the density voxels of an
untrained model are masked, as the train stage does. Of the voxels that hold a point of the subject which three training photographs show, `masked` are the
share that is masked. Writes made_captures.json and .md; exit code 1 where any is above MOST_MASKED. No photograph is rendered here.
"""

import argparse
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.project import RESULTS
from benchmarks.scenes import captures
from benchmarks.scenes.captures import MadeCapture
from efficientnerf.training.settings import TrainSettings
from pipeline.files import read_json, write_atomically, write_json
from pipeline.stage import Job
from stages.io import scene
from stages.poses.run import run as find_poses
from stages.poses.settings import PosesSettings
from stages.train.priors import Prior, mask_uncovered_cells

MOST_MASKED = 0.01  # of the subject's voxels: at the borders of photographs the middle of a voxel may be in view of fewer than the point in it
COLUMNS = (
    "capture",
    "photographs",
    "sparse points",
    "subject's voxels",
    "masked %",
    "of all voxels %",
    "refuted",
    "near planes",
    "subject's distance",
    "its size",
    "out of the box %",
)
SMALL = {"log2_hashmap_size": 8, "num_levels": 2, "finest_resolution": 32, "hidden_dim": 16, "coarse_hidden_dim": 16}  # of a model that is not trained


def measured(name: str, capture: MadeCapture, work: Path, width: int, side: int, seed: int) -> dict[str, Any]:
    """The row of one capture; its data set and its scene are left in `work`."""
    folder, poses = work / name, work / f"{name}-poses"
    write_blank_photographs(folder, capture, width)
    captures.write_model(folder, capture, width, seed)
    settings = PosesSettings(format="colmap")
    find_poses(Job(settings=settings, source=folder, out=poses, work=work / f"{name}-work"))
    found = scene.load(poses)
    trained = {Path(view.name).name for view in scene.views_of(found, "train")}
    right = [camera for n, camera in enumerate(captures.cameras(capture, width)) if camera.name in trained and n not in capture.wrong]
    points = found.world_from_capture.points(captures.subject_points(capture, right, seed=seed))
    (voxels, priors), of_subject = masked_voxels(found, poses, side), np.unique(cells_of(found, points, side), axis=0)
    planes, centres = np.array([view.near for view in found.views]), np.array([view.camera.centre for view in found.views])
    return {
        "photographs": len(found.views),
        "points": len(scene.read_points(poses).xyz),
        "voxels": len(of_subject),
        "masked": float(voxels[tuple(of_subject.T)].mean()),
        "masked_of_all": float(voxels.mean()),
        "outside": float(((points < found.bounds[0]) | (points > found.bounds[1])).any(axis=1).mean()),
        "size": float(np.ptp(np.quantile(points, [0.01, 0.99], axis=0), axis=0).max()),
        "priors": [asdict(prior) for prior in priors],
        "near": [float(value) for value in np.quantile(planes, [0.0, 0.5, 1.0])],
        "distance": float(np.median(np.linalg.norm(centres - points.mean(0), axis=1))),
    }


def masked_voxels(found: scene.Scene, poses: Path, side: int) -> tuple[np.ndarray, tuple[Prior, ...]]:
    """(D, D, D) bool of the density voxels that are masked before the first step, D = `side`; and by what."""
    from efficientnerf.model import model
    from stages.io.field_file import space_of

    views = scene.views_of(found, "train")
    made = model(space_of(found), TrainSettings(occupancy_resolution=side, **SMALL), found.background)
    priors = mask_uncovered_cells(made, views, Job(settings=made.settings, inputs={"poses": poses}, out=poses / "out", work=poses / "work"))
    return np.asarray(np.isneginf(made.voxels.values.numpy())), priors


def cells_of(found: scene.Scene, points: np.ndarray, side: int) -> np.ndarray:
    """(N, 3) density voxels that hold points (N, 3) of the training frame."""
    import torch

    from stages.io.field_file import space_of

    grid = space_of(found).grid(torch.from_numpy(points)).numpy()
    return np.clip((grid * side).astype(np.int64), 0, side - 1)


def write_blank_photographs(folder: Path, capture: MadeCapture, width: int) -> None:
    """Where none are: masking looks at no colours."""
    from PIL import Image

    (folder / "images").mkdir(parents=True, exist_ok=True)
    for camera in captures.cameras(capture, width):
        if not (folder / "images" / camera.name).exists():
            Image.new("RGB", (camera.width, camera.height), (128, 128, 128)).save(folder / "images" / camera.name)


def in_markdown(rows: Mapping[str, Mapping[str, Any]]) -> str:
    lines = ["# Captures that no rule was made on", "", "`python -m benchmarks.made_captures`: what is masked before training.", ""]
    lines += ["| " + " | ".join(COLUMNS) + " |", "|---" * len(COLUMNS) + "|"]
    for name, row in rows.items():
        near = " / ".join(f"{value:.2f}" for value in row["near"])
        parts = [name, row["photographs"], row["points"], row["voxels"], f"{100 * row['masked']:.2f}", f"{100 * row['masked_of_all']:.1f}"]
        parts += [", ".join(f"{prior['name']} ({100 * prior['contradicted']:.1f} %)" for prior in row["priors"] if not prior["applied"]), near]
        lines.append("| " + " | ".join(map(str, [*parts, f"{row['distance']:.2f}", f"{row['size']:.2f}", f"{100 * row['outside']:.1f}"])) + " |")
    note = "Refuted: priors that are dropped, for so many of the reliable sparse points contradict them. Near planes: least, median, greatest."
    return "\n".join(
        [*lines, "", f"{note} Out of the box: of the subject's points. Lengths are in units of the training frame, whose box is 2 along its longest side.", ""]
    )


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--kinds", default=",".join(captures.captures()))
    parser.add_argument("--width", type=int, default=320)
    parser.add_argument("--side", type=int, default=128, help="density voxels along a side")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=RESULTS)
    given = parser.parse_args(arguments)
    table, about = given.out / "made_captures.json", {"width": given.width, "side": given.side, "seed": given.seed}
    before = read_json(table) if table.exists() else {}
    rows = dict(before["rows"]) if about.items() <= before.items() else {}  # of other kinds
    for name in given.kinds.split(","):
        rows[name] = measured(name, captures.captures()[name], given.work.resolve(), given.width, given.side, given.seed)
        print(f"{name}: {100 * rows[name]['masked']:.2f} % of the subject masked, {100 * rows[name]['masked_of_all']:.1f} % of all", flush=True)
    given.out.mkdir(parents=True, exist_ok=True)
    rows = {name: rows[name] for name in captures.captures() if name in rows}
    write_json(table, {**about, "rows": rows})
    write_atomically(table.with_suffix(".md"), in_markdown(rows).encode())
    return 1 if any(row["masked"] > MOST_MASKED for row in rows.values()) else 0


if __name__ == "__main__":
    sys.exit(main())
