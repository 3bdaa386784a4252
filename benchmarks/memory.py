"""Peak memory and time of each stage for many large images, with several limits: by default 100 of 12 megapixels, rendered here, with known cameras.

    python benchmarks/memory.py [--memory 2g --memory 4g --memory auto] [--count 100] [--width 4000] [--set train.iterations=300] [--json FILE] [--keep FOLDER]

The scene is a patterned ball over a patterned floor under a plain sky, written as JPEGs and a transforms.json. It is trained at full size
(`poses.max_image_size` is the width), for a few hundred steps, and baked with a few refinement steps: quality is not measured. Each stage is a process of
its own; where one is refused for its memory, those after it are not tried. Peaks and estimates are those in the manifests. At last the cameras
of a few photographs of that width are found, which are those of the still life, enlarged.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

STAGES = ("poses", "train", "bake", "mesh", "splats", "evaluate", "turntable", "points")
QUICK = (
    "poses.test_every=50", "train.iterations=150", "train.preview_every=off", "bake.refine_steps=4", "bake.visibility_rays=60000", "bake.max_mib=8",
    "bake.samples_per_voxel=1", "evaluate.field_views=1", "evaluate.field_background_rays=10000", "turntable.frames=2",
    "mesh.density_threshold=2.0", "points.density_threshold=2.0",
)  # fmt: skip
STILL_LIFE = Path(__file__).parents[1] / "examples/still_life"
UPSAMPLED = 4  # pixels a side of an image for each that is computed; noise is added


def pose(angle: float, height: float) -> np.ndarray:
    """Camera to world, (4, 4), x right, y up, looking along -z from a circle of radius 4 at the ball's foot."""
    centre = np.array([4 * np.cos(angle), 4 * np.sin(angle), height])
    back = centre / np.linalg.norm(centre)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    out = np.eye(4)
    out[:3, 0], out[:3, 1], out[:3, 2], out[:3, 3] = right, np.cross(back, right), back, centre
    return out


def image_of(world_from_camera: np.ndarray, width: int, height: int, focal: float) -> np.ndarray:
    """(H, W, 3) uint8: a pinhole camera's image of a ball of radius 1 on a floor."""
    y, x = np.mgrid[0:height, 0:width]
    local = np.stack([(x + 0.5 - width / 2) / focal, -(y + 0.5 - height / 2) / focal, -np.ones(x.shape)], axis=-1)
    d = local @ world_from_camera[:3, :3].T
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    o = world_from_camera[:3, 3] - np.array([0.0, 0.0, 0.3])  # of the ball's centre
    with np.errstate(invalid="ignore", divide="ignore"):
        along = d @ o
        ball = -along - np.sqrt(along**2 - (o @ o - 1))
        floor = np.where(d[..., 2] < 0, -(o[2] + 1) / d[..., 2], np.nan)
    ball, floor = (np.nan_to_num(t, nan=np.inf)[..., None] for t in (ball, floor))
    nearest = np.minimum(ball, floor)
    at = np.where(np.isfinite(nearest), o + np.where(np.isfinite(nearest), nearest, 0) * d, 0)
    spots = 0.5 + 0.5 * np.sin(9 * at) * np.sin(7 * at[..., [1, 2, 0]])
    tiles = 0.35 + 0.3 * ((np.floor(2 * at[..., :1]) + np.floor(2 * at[..., 1:2])) % 2) * np.array([1.0, 0.9, 0.7])
    colour = np.where(ball < floor, 0.2 + 0.7 * spots, np.where(floor < 25, tiles, np.array([0.7, 0.8, 0.95])))
    return (255 * np.clip(colour, 0, 1)).astype(np.uint8)


def write_images(folder: Path, count: int, width: int) -> None:
    """The photographs and their transforms.json."""
    from PIL import Image

    height, rng = 3 * width // 4, np.random.default_rng(0)
    frames = []
    for n in range(count):
        camera = pose(2.399963 * n, 0.6 + 2.4 * n / count)  # turned by the golden angle
        small = image_of(camera, width // UPSAMPLED, height // UPSAMPLED, 0.9 * width / UPSAMPLED)
        image = np.asarray(Image.fromarray(small).resize((width, height), Image.Resampling.BICUBIC), np.int16)
        noisy = np.clip(image + rng.integers(-6, 7, image.shape, np.int16), 0, 255).astype(np.uint8)
        Image.fromarray(noisy).save(folder / f"{n:04d}.jpg", quality=92)
        frames.append({"file_path": f"{n:04d}.jpg", "transform_matrix": camera.tolist()})
    lens = {"camera_model": "PINHOLE", "w": width, "h": height, "fl_x": 0.9 * width, "fl_y": 0.9 * width, "cx": width / 2, "cy": height / 2}
    (folder / "transforms.json").write_text(json.dumps({**lens, "frames": frames}), encoding="utf-8")


def measured(source: Path, run: Path, memory: str, sets: list[str], stages: tuple[str, ...] = STAGES) -> dict[str, dict[str, Any]]:
    """What each stage took, what it had stated, and what it said of memory; the stage that was refused is the last."""
    rows: dict[str, dict[str, Any]] = {}
    for stage in stages:
        command = [
            sys.executable,
            "-m",
            "workflows.cli.main",
            "run",
            *([str(source)] if stage == stages[0] else []),
            "--out",
            str(run),
            "--until",
            stage,
            "--json",
        ]
        for text in sets if stage == stages[0] else []:
            command += ["--set", text]
        done = subprocess.run([*command, "--memory", memory], capture_output=True, text=True, check=False)
        events = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
        said = [event["text"] for event in events if event.get("event") == "warning" and "memory" in event["text"]]
        if done.returncode:
            refused = next((event.get("text") or event.get("error") for event in reversed(events) if event.get("exit_code")), done.stderr)
            rows[stage] = {"exit_code": done.returncode, "refused": refused, "said": said}
            print(f"{memory:6}{stage:10} exit code {done.returncode}: {refused}", flush=True)
            break
        made = json.loads((run / stage / "manifest.json").read_text(encoding="utf-8"))
        peak, stated = made["peak_memory"] / 2**20, made["facts"]["memory"]
        rows[stage] = {
            "seconds": round(made["seconds"], 1), "cpu_seconds": round(made["cpu_seconds"], 1), "peak_mib": round(peak), "stated_mib": stated["needed"] >> 20,
            "limit_mib": stated["limit"] and stated["limit"] >> 20, "terms_mib": {what: size >> 20 for what, size in stated["terms"].items()}, "said": said,
            "digest": made["digest"],
        }  # fmt: skip
        print(
            f"{memory:6}{stage:10}{made['seconds']:8.0f} s{peak:8.0f} MiB of {stated['needed'] >> 20} stated{'  ' + said[0][:80] if said else ''}", flush=True
        )
    return rows


def photographs_alone(folder: Path, count: int, width: int) -> Path:
    """A folder of photographs without cameras: neighbours of the still life, enlarged."""
    from PIL import Image

    from stages.io.pictures import opened

    folder.mkdir()
    for path in sorted(STILL_LIFE.glob("*.jpg"))[:count]:
        with opened(path) as image:
            image.resize((width, width * image.height // image.width), Image.Resampling.BICUBIC).save(folder / path.name, quality=92)
    return folder


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--memory", action="append", help="limit, as for enerf; may be given again (2g, 4g and auto)")
    parser.add_argument("--count", type=int, default=100, help="photographs")
    parser.add_argument("--width", type=int, default=4000, help="of each, pixels; three quarters as high")
    parser.add_argument("--features", type=int, default=8, help="photographs of the still life, enlarged to the same width, whose cameras are found; 0: none")
    parser.add_argument("--set", dest="sets", action="append", default=[], help="a setting of the run, as for enerf; may be given again")
    parser.add_argument("--json", type=Path, help="where to write the figures")
    parser.add_argument("--keep", type=Path, help="folder that is kept, with the photographs and the runs; else one that is removed")
    arguments = parser.parse_args()
    sets = [f"poses.max_image_size={arguments.width}", *QUICK, *arguments.sets]
    with tempfile.TemporaryDirectory() as temporary:
        folder = arguments.keep or Path(temporary)
        photographs = folder / "photographs"
        if not (photographs / "transforms.json").exists():
            photographs.mkdir(parents=True)
            write_images(photographs, arguments.count, arguments.width)
        load = os.getloadavg()
        limits = {memory: measured(photographs, folder / f"run_{memory}", memory, sets) for memory in arguments.memory or ["2g", "4g", "auto"]}
        features = {}
        if arguments.features:
            few = photographs_alone(folder / "few", arguments.features, arguments.width)
            wanted = [f"poses.feature_image_size={arguments.width}", "poses.format=photographs"]
            features = {memory: measured(few, folder / f"few_{memory}", memory, wanted, ("poses",)) for memory in ("1g", "1500m", "auto")}
    if arguments.json is not None:
        report: dict[str, Any] = {
            "date": time.strftime("%Y-%m-%d"), "photographs": arguments.count, "width": arguments.width, "height": 3 * arguments.width // 4, "settings": sets,
            "stages": limits, "features": features, "cores": len(os.sched_getaffinity(0)), "processor": platform.machine(), "load_before": load,
            "load_after": os.getloadavg(),
        }  # fmt: skip
        arguments.json.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
