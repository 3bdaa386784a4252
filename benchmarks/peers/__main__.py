"""Rows of peers for the table of quality over minutes: trained on a CPU for as long as we train, measured on the same test views with the same metric.

    python -m benchmarks.peers nerfacto --python ENVIRONMENT/bin/python --work FOLDER [--sets chair_800,object,gloss] [--minutes 1,5,10]
                                        [--stride 8] [--threads 2] [--out benchmarks/results]

A peer runs in an environment of its own (nerfacto: `pip install nerfstudio==1.1.5`) and reads a data set as Blender's, which made scenes are written as.
What is behind its renders is white, as behind the test images; PSNR is of float images clipped to 0-1, then the mean over views: as ours. A peer takes
minutes for what our renderer does in seconds, so only every stride-th row and column of each test view is rendered; SSIM needs whole images (--stride 1).
A peer has the settings that were the best of those tried: docs/experiments/peers.md. Writes peers.json; a row that is there is not measured again
(--again). Then `python -m benchmarks.quality_over_minutes --minutes= ...` shows all rows together.
"""

import argparse
import json
import os
import shutil
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.minutes import mean_quality, read_rows, same_row, with_row, write_rows
from benchmarks.project import DATA, RESULTS
from benchmarks.quality_over_minutes import PEERS, source_of
from benchmarks.scenes.__main__ import as_blender

SCRIPTS = {"nerfacto": Path(__file__).with_name("nerfacto.py")}


def _pixels(path: Path) -> np.ndarray:
    from stages.io.pictures import opened

    with opened(path) as image:
        return np.asarray(image)


def truth_of(folder: Path, stride: int) -> list[np.ndarray]:
    """The test images on white, of the pixels that were rendered: (H', W', 3) each, 0 to 1."""
    from stages.evaluate.views import subsample

    frames = json.loads((folder / "transforms_test.json").read_text(encoding="utf-8"))["frames"]
    images = (_pixels(folder / f"{frame['file_path']}.png") / 255.0 for frame in frames)
    return [subsample(pixels[..., :3] * pixels[..., 3:] + (1 - pixels[..., 3:]), stride) for pixels in images]


def row_of(named: Mapping[str, Any], data: Path, out: Path, given: argparse.Namespace) -> dict[str, Any]:
    """Train and render in the peer's environment, and compare here."""
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    load = os.getloadavg()
    command = [str(given.python), str(SCRIPTS[given.peer]), str(data), str(out), "--minutes", f"{named['minutes']:g}", "--stride", str(given.stride)]
    command += ["--threads", str(given.threads)]
    threads = {name: str(given.threads) for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS")}
    environment = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "VIRTUAL_ENV")}
    with open(out / "log.txt", "w", encoding="utf-8") as log:
        done = subprocess.run(command, stdout=log, stderr=subprocess.STDOUT, env=environment | threads, cwd=out, check=False)
    if done.returncode != 0:
        raise SystemExit(f"{given.peer}: exit code {done.returncode}; see {out / 'log.txt'}")
    report = json.loads((out / "report.json").read_text(encoding="utf-8"))
    pairs = [(np.clip(image, 0, 1), true) for image, true in zip(np.load(out / "renders.npy"), truth_of(data, given.stride), strict=True)]
    return {
        **named, **mean_quality(pairs, given.stride == 1), "stride": given.stride,
        "megabytes": report["model_bytes"] / 1e6, "peak_mib": report["peak_mib"], "seconds": report["seconds"], "load": load,
        "code": f"{given.peer} {report['versions'].get('nerfstudio', '')}".strip(),
        **{key: report[key] for key in ("steps", "rays_per_second", "rendering_seconds", "threads", "settings", "versions")},
    }  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("peer", choices=SCRIPTS)
    parser.add_argument("--python", type=Path, required=True, help="the interpreter of the peer's environment")
    parser.add_argument("--work", type=Path, required=True, help="folder for data sets, renders and logs")
    parser.add_argument("--sets", default="chair_800")
    parser.add_argument("--minutes", default="1,5,10")
    parser.add_argument("--stride", type=int, default=8)
    parser.add_argument("--threads", type=int, default=os.cpu_count())
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--scenes", type=Path, help="folder of made scenes; by default WORK/scenes")
    parser.add_argument("--out", type=Path, default=RESULTS)
    parser.add_argument("--again", action="store_true", help="measure rows again that are there")
    given = parser.parse_args(arguments)
    path = given.out / PEERS
    for name in given.sets.split(","):
        source, _ = source_of(name, given.data, given.scenes or given.work / "scenes")
        data = as_blender(source, given.work / "data" / name)
        for minutes in sorted(float(word) for word in given.minutes.split(",")):
            named = {"method": given.peer, "set": name, "minutes": minutes, "options": "smaller"}
            if not given.again and any(same_row(row, named) for row in read_rows(path)):
                continue
            row = row_of(named, data.resolve(), (given.work / given.peer / f"{name}-{minutes:g}m").resolve(), given)
            write_rows(path, with_row(read_rows(path), row))
            print(f"{given.peer}, {name}, {minutes:g} min: {row['psnr']:.2f} dB, {row['rays_per_second']:,.0f} rays/s", flush=True)


if __name__ == "__main__":
    main()
