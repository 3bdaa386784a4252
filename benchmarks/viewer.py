"""Viewer pages in headless Chromium: loading, pictures against the CPU renderer's, seconds a picture: benchmarks/results/viewer.json.

    python -m benchmarks.viewer RUN|ASSET... [--size 640x480] [--views 5] [--pictures 2] [--out FILE.json]

Of each a page is made as `enerf export --to x.html` makes it. `load_s`: from the page's address until the scene can be drawn, `first_s` until it is drawn.
Pictures are those of the captured cameras, else of an orbit, at 320 pixels; `picture_s` is of --size. Without a graphics card Chromium draws by SwiftShader.
"""

import argparse
import datetime
import json
import os
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.machine import processor
from benchmarks.project import RESULTS
from efficientnerf.asset.camera_paths import turntable_cameras
from efficientnerf.asset.captured import captured_of
from efficientnerf.asset.format import describe, load
from efficientnerf.asset.rendering import render
from efficientnerf.evaluation.metrics import psnr
from efficientnerf.geometry.cameras import Camera
from pipeline.files import write_json
from stages.viewer.page import compact_bytes, viewer_page
from tests.stages.viewer import browser
from workflows.cli.target import asset_of, is_run
from workflows.report.viewer import captured

SIDE = 320  # pixels, of the pictures that are compared
SECONDS = """async ([width, height]) => {
  const begin = performance.now();
  await enerf.render(width, height);
  return (performance.now() - begin) / 1000;
}"""


def cameras_of(tree: Any, count: int) -> list[Camera]:
    """Some of the captured cameras, without their distortion; else of an orbit."""
    found = captured_of(tree.metadata)
    if found is None:
        return list(turntable_cameras(tree, frames=count, width=SIDE, height=SIDE * 3 // 4))
    scale = SIDE / found.width
    width, height = SIDE, round(found.height * scale)
    lens = (found.focal * scale, found.focal * scale, width / 2, height / 2)
    chosen = np.linspace(0, len(found.poses) - 1, count).round().astype(int)
    return [Camera(str(n), width, height, "PINHOLE", lens, found.poses[n]) for n in chosen]


def page_of(what: Path) -> bytes:
    cameras, photographs = captured(what) if is_run(what) else ([], {})
    return viewer_page(compact_bytes(asset_of(what)), cameras=cameras, photographs=photographs, title=what.absolute().stem)


def measured(chromium: Any, page: bytes, tree: Any, given: argparse.Namespace, path: Path) -> dict[str, Any]:
    """Seconds and decibels of a page, which is written to `path`."""
    path.write_bytes(page)
    behind = None if tree.environment is not None else tree.background or (1.0, 1.0, 1.0)
    begin = time.perf_counter()
    with browser.opened(chromium, path, **browser.WIDE) as shown:
        shown.ready()
        ready = time.perf_counter() - begin
        shown.page.evaluate(browser.RESTED)
        first = time.perf_counter() - begin
        pictures = []
        for camera in cameras_of(tree, given.views):
            own = np.clip(render(tree, camera, background=behind, normals=False).colour, 0, 1)
            pictures.append(psnr(shown.rendered(camera, background=behind or (0, 0, 0), surroundings=behind is None) / 255, own))
        spent = [shown.page.evaluate(SECONDS, [int(side) for side in given.size.split("x")]) for _ in range(given.pictures)]
    return {
        "page_mb": round(len(page) / 1e6, 1), "load_s": round(ready, 2), "first_s": round(first, 2),
        "psnr": [round(number, 1) for number in pictures], "picture_s": [round(number, 2) for number in spent],
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("assets", type=Path, nargs="+")
    parser.add_argument("--size", default="640x480")
    parser.add_argument("--views", type=int, default=5)
    parser.add_argument("--pictures", type=int, default=2)
    parser.add_argument("--out", type=Path, default=RESULTS / "viewer.json")
    given = parser.parse_args()
    if browser.missing() is not None:
        raise SystemExit(browser.missing())
    rows = []
    with tempfile.TemporaryDirectory() as folder, browser.chromium() as chromium:
        for what in given.assets:
            begin, name = time.process_time(), what.absolute().stem
            page = page_of(what)
            about, tree = describe(asset_of(what)), load(asset_of(what))
            row = {"name": name, "asset_mb": round(about["bytes"] / 1e6, 1), "voxels": about["voxels"], "writing_cpu_s": round(time.process_time() - begin, 2)}
            row |= measured(chromium, page, tree, given, Path(folder) / f"{name}.html") | {"load": round(os.getloadavg()[0], 1)}
            rows.append(row)
            print(json.dumps(row), flush=True)
        machine = {"processor": processor(), "cores": os.cpu_count(), "chromium": chromium.version}
    write_json(given.out, {"date": datetime.date.today().isoformat(), "machine": machine, "size": given.size, "pages": rows})


if __name__ == "__main__":
    main()
