"""Quality of Gaussians over the size of their files: those of a run fitted with several counts, SPZ and SOG written, test views compared.

    python -m benchmarks.splat_sizes RUN [--counts 20000,40000,80000,160000,300000] [--degrees 2] [--seed 0] [--out benchmarks/results]

RUN is baked; it is not changed. PSNR and SSIM are of the Gaussians as SPZ has them, read again by the tests' reader, over all test views at full size. Of
captures with learned exposure this is not the figure of `evaluate`, which fits it. Writes splat_sizes_NAME.json and .md after each row, and keeps rows of
others.
"""

import argparse
import math
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.machine import hardware
from benchmarks.project import RESULTS, code_version
from efficientnerf.asset.format import load
from efficientnerf.asset.tree import NerfTree
from efficientnerf.geometry.cameras import Similarity
from efficientnerf.splats.gaussians import Gaussians
from efficientnerf.splats.rendering import render
from pipeline.files import read_json, write_atomically, write_json
from stages.artifacts import BakeOutputs, PosesOutputs, TrainOutputs
from stages.evaluate.views import evaluation_views, ground_truth
from stages.formats.exporters.glb import gltf_from_capture
from stages.formats.exporters.splats import sog, spz
from stages.formats.exporters.splats.frames import in_capture, moved
from stages.formats.exporters.writing import source_frame
from stages.io.refined_cameras import load_scene
from stages.splats.run import gaussians_of
from stages.splats.settings import SplatsSettings
from tests.stages.formats.gaussians import read_spz

COLUMNS = ("Gaussians", "degree", "seed", "SPZ 4 / MB", "SPZ 3 / MB", "SOG / MB", "PSNR / dB, SSIM of SPZ", "before it", "processor seconds")


def row_of(tree: NerfTree, folders: tuple[Path, Path], settings: SplatsSettings) -> dict[str, Any]:
    """Fit Gaussians, write them, read the SPZ again, compare both with the test views. `folders` of the stages poses and train."""
    began = time.process_time()
    gaussians = gaussians_of(tree, settings, lambda *_: None, folders)
    seconds, frame = time.process_time() - began, source_frame(tree.metadata)
    written = in_capture(gaussians, frame)
    with tempfile.TemporaryDirectory() as folder:
        paths = {name: Path(folder) / name for name in ("4.spz", "3.spz", "splats.sog")}
        spz.write_splats(written, paths["4.spz"], frame, version=4)
        spz.write_splats(written, paths["3.spz"], frame)
        sog.write_splats(written, paths["splats.sog"], frame)
        sizes = {name.replace("splats.", ""): path.stat().st_size / 1e6 for name, path in paths.items()}
        y_up = Similarity(1.0, gltf_from_capture(frame.up), np.zeros(3))
        read = moved(moved(read_spz(paths["4.spz"])[1], y_up.inverse()), frame.world_from_capture)
    return {
        "gaussians": len(gaussians), "count": settings.count, "degree": settings.sh_degree, "seed": settings.seed, "megabytes": sizes,
        "spz": quality(read, tree, folders), "exact": quality(gaussians, tree, folders), "cpu_seconds": round(seconds, 1),
    }  # fmt: skip


def quality(gaussians: Gaussians, tree: NerfTree, folders: tuple[Path, Path]) -> dict[str, float]:
    """Mean PSNR and SSIM over the test views."""
    scene = load_scene(*folders)
    views, _ = evaluation_views(scene)
    pairs = [(ground_truth(folders[0], view, scene.background), np.clip(render(gaussians, view.camera, scene.background or tree.background).colour, 0, 1))
             for view in views]  # fmt: skip
    return {kind: math.fsum(getattr(truth, kind)(image) for truth, image in pairs) / len(pairs) for kind in ("psnr", "ssim")} | {"views": len(pairs)}


def in_markdown(name: str, rows: Sequence[dict[str, Any]]) -> str:
    lines = [f"# Size and quality of Gaussians: {name}", "", f"| {' | '.join(COLUMNS)} |", "|---" * len(COLUMNS) + "|"]
    for row in rows:
        sizes = " | ".join(f"{row['megabytes'][key]:.2f}" for key in ("4.spz", "3.spz", "sog"))
        figures = f"{row['spz']['psnr']:.2f}, {row['spz']['ssim']:.4f} | {row['exact']['psnr']:.2f}, {row['exact']['ssim']:.4f} | {row['cpu_seconds']:.0f}"
        lines.append(f"| {row['gaussians']:,} | {row['degree']} | {row['seed']} | {sizes} | {figures} |")
    return "\n".join([*lines, "", f"Over {rows[0]['spz']['views']} test views at full size."]) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--counts", default="20000,40000,80000,160000,300000")
    parser.add_argument("--degrees", default="2")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=RESULTS)
    given = parser.parse_args()
    name = given.run.resolve().name
    file = given.out / f"splat_sizes_{name}.json"
    rows = read_json(file)["rows"] if file.exists() else []
    tree = load(BakeOutputs.of_run(given.run).asset)
    folders = PosesOutputs.of_run(given.run).folder, TrainOutputs.of_run(given.run).folder
    for degree, count in ((int(degree), int(count)) for degree in given.degrees.split(",") for count in given.counts.split(",")):
        settings = SplatsSettings(count=count, sh_degree=degree, seed=given.seed)
        row = {**row_of(tree, folders, settings), "code": code_version(), "hardware": hardware("cpu")}
        named_by = ("count", "degree", "seed")
        rows = sorted([*(old for old in rows if any(old[key] != row[key] for key in named_by)), row], key=lambda each: [each[key] for key in named_by])
        print(f"{row['gaussians']:,} of degree {degree}: SPZ {row['megabytes']['4.spz']:.2f} MB, {row['spz']['psnr']:.2f} dB", flush=True)
        write_json(file, {"run": name, "rows": rows})
        write_atomically(given.out / f"splat_sizes_{name}.md", in_markdown(name, rows).encode())


if __name__ == "__main__":
    main()
