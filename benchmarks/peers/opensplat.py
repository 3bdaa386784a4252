"""OpenSplat on the cameras and photographs of a run, and our own Gaussians in the same minutes: PSNR of the same held-out views by the same renderer.

    python -m benchmarks.peers.opensplat --binary opensplat --work FOLDER --minutes 5,10 [--out FILE] RUN=SOURCE [RUN=SOURCE ...]

RUN is a run whose poses are made, SOURCE the photographs that it was made from. OpenSplat is built outside of this repository (docs/experiments/peers.md). It
reads the training photographs at working size, their cameras and the sparse points, all in the training frame, and is ended when its minutes have passed; the
last Gaussians that it wrote count. Ours is `enerf run --budget`, which covers field, asset and Gaussians. Both begin once cameras are known, one after the
other. OpenSplat has its own options for 30,000 steps: with schedules made as short as the steps that fit it was worse (docs/experiments/peers.md).
"""

import argparse
import os
import shutil
import signal
import subprocess
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.minutes import OURS, mean_quality, read_rows, with_row, write_rows
from benchmarks.project import ENERF, RESULTS, code_version
from efficientnerf.splats.gaussians import Gaussians
from efficientnerf.splats.rendering import render
from efficientnerf.surface.mesh import PointCloud
from pipeline.files import read_json, write_json
from stages.artifacts import EvaluateOutputs
from stages.formats.exporters.cameras import transforms_from_scene
from stages.formats.exporters.ply import write_points
from stages.formats.exporters.splats.ply import read_splats
from stages.io import scene
from stages.io.png import write_png

SAVE_EVERY = 30  # steps: what it has learned since the last save is lost when it is ended
BEHIND = (0.6130, 0.0101, 0.3984)  # OpenSplat's colour behind all Gaussians


def write_project(poses: Path, folder: Path) -> None:
    """The training views of a scene at working size as nerfstudio has them: transforms.json, images, and the sparse points as PLY."""
    found, views = scene.load(poses), []
    (folder / "images").mkdir(parents=True, exist_ok=True)
    for number, view in enumerate(scene.views_of(found, "train")):
        camera = replace(view.camera, name=f"images/{number:04d}.png")
        views.append(replace(view, camera=camera, source_camera=camera))
        write_png(scene.read_image(poses, view)[..., :3], folder / camera.name)
    document = {"camera_model": "OPENCV", "ply_file_path": "points.ply"} | transforms_from_scene(replace(found, views=tuple(views)))
    write_json(folder / "transforms.json", document)
    points = scene.read_points(poses)
    write_points(PointCloud(points.xyz, np.tile([0.0, 0.0, 1.0], (len(points.xyz), 1)), points.rgb.astype(np.float32) / 255), folder / "points.ply")


def trained(binary: Path, project: Path, out: Path, seconds: float) -> int:
    """Let OpenSplat train for so long; the last step that it reached. Its Gaussians are out/splat*.ply."""
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    command = [str(binary), str(project), "-o", str(out / "splat.ply"), "--keep-crs", "--cpu", "-s", str(SAVE_EVERY), "-n", "30000"]
    with open(out / "log.txt", "w", encoding="utf-8") as log:
        child = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, start_new_session=True)
        try:
            child.wait(seconds)
        except subprocess.TimeoutExpired:
            os.killpg(child.pid, signal.SIGKILL)
            child.wait()
    steps = [line for line in (out / "log.txt").read_text(encoding="utf-8").splitlines() if line.startswith("Step ")]
    if not steps:
        raise SystemExit(f"opensplat took no step; see {out / 'log.txt'}")
    return int(steps[-1].split()[1].rstrip(":"))


def gaussians_of(out: Path) -> Gaussians:
    """The last Gaussians that OpenSplat wrote whole: by their step, the end's before all. Its quaternions have any length; ours are unit quaternions."""
    for path in sorted(out.glob("splat*.ply"), key=lambda path: int(path.stem.partition("_")[2] or 2**31), reverse=True):
        header, _, body = path.read_bytes().partition(b"end_header\n")
        columns = header.count(b"property float ")
        count = int(header.partition(b"element vertex ")[2].split()[0])
        if len(body) == 4 * columns * count:
            rows = np.frombuffer(body, "<f4").reshape(count, columns).copy()
            rows[:, -4:] /= np.linalg.norm(rows[:, -4:], axis=1, keepdims=True)
            unit = out / "unit.ply"
            unit.write_bytes(header + b"end_header\n" + rows.tobytes())
            return read_splats(unit)
    raise SystemExit(f"{out}: no Gaussians were written")


def quality(poses: Path, gaussians: Gaussians) -> dict[str, Any]:
    """Mean PSNR and SSIM over the test views, by our renderer, of 8-bit images."""
    pairs = [
        (np.clip(render(gaussians, view.camera, BEHIND).colour, 0, 1), scene.read_image(poses, view)[..., :3].astype(np.float32) / 255)
        for view in scene.views_of(scene.load(poses), "test")
    ]
    return mean_quality(pairs) | {"gaussians": len(gaussians)}


def ours(run: Path, source: Path, out: Path, minutes: float) -> dict[str, Any]:
    """Field, asset and Gaussians of a copy of the run's poses, in so many minutes."""
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    shutil.copytree(run / "poses", out / "poses")
    shutil.copyfile(run / "run.json", out / "run.json")
    with open(out / "log.txt", "w", encoding="utf-8") as log:
        command = [*ENERF, "run", str(source), "--out", str(out), "--budget", f"{minutes:g}m"]
        subprocess.run([*command, "--until", "evaluate"], stdout=log, stderr=subprocess.STDOUT, check=True)
    report = read_json(EvaluateOutputs.of_run(out).metrics)
    return {"asset": report["asset"]["psnr"], "psnr": report["splats"]["psnr"], "ssim": report["splats"]["ssim"], "views": len(report["views"])}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", metavar="RUN=SOURCE")
    parser.add_argument("--binary", type=Path, required=True)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--minutes", default="5")
    parser.add_argument("--out", type=Path, default=RESULTS / "opensplat.json")
    given = parser.parse_args()
    rows = read_rows(given.out)
    for word in given.runs:
        run, source = (Path(part).absolute() for part in word.split("=", 1))
        project, folder = given.work / run.name / "project", given.work / run.name
        write_project(run / "poses", project)
        for minutes in (float(word) for word in given.minutes.split(",")):
            out, began, load = folder / f"opensplat-{minutes:g}", time.perf_counter(), os.getloadavg()[0]
            reached = trained(given.binary, project, out, 60 * minutes)
            row = {"method": "OpenSplat", "set": run.name, "minutes": minutes, "options": "default", "steps": reached, "load": load}
            rows = with_row(rows, row | {"seconds": time.perf_counter() - began} | quality(run / "poses", gaussians_of(out)))
            load = os.getloadavg()[0]
            row = {"method": OURS, "set": run.name, "minutes": minutes, "options": "", "load": load, "code": code_version()}
            rows = with_row(rows, row | ours(run, source, folder / f"ours-{minutes:g}", minutes))
            print(*(row for row in rows if (row["set"], row["minutes"]) == (run.name, minutes)), sep="\n", flush=True)
            write_rows(given.out, rows)


if __name__ == "__main__":
    main()
