"""Viewer pages in headless Chromium: loading, memory, pictures against the CPU renderer's, seconds a picture: benchmarks/results/viewer.json.

    python -m benchmarks.viewer RUN|ASSET... [--size 640x480] [--views 5] [--pictures 2] [--shots FOLDER] [--out FILE.json]

Of each a page is made as `enerf export --to x.html` makes it. `load_s`: from the page's address until the scene can be drawn, `first_s` until it is drawn;
`cpu_s`: of all processes of the browser until then; `peak_mib`: what the process of the page, and that of the graphics, held at most, and at rest afterwards.
Pictures are those of the captured cameras, else of an orbit, at 320 pixels; `picture_s` is of --size. Without a graphics card Chromium draws by SwiftShader.
--shots: the page as it looks wide and narrow, light and dark.
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
from efficientnerf.asset.camera_paths import turntable_cameras
from efficientnerf.asset.captured import captured_of
from efficientnerf.asset.format import describe, load
from efficientnerf.asset.rendering import render
from efficientnerf.geometry.cameras import Camera
from stages.viewer.page import compact_bytes, viewer_page
from tests.stages.viewer import browser
from workflows.cli.target import asset_of, is_run
from workflows.report.viewer import captured

ROOT = Path(__file__).resolve().parents[1]
SIDE = 320  # pixels, of the pictures that are compared
LOOKS = [("wide", 1280, 800), ("narrow", 390, 780)]
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


def processes() -> dict[int, tuple[str, float, int, int]]:
    """Number -> kind, processor seconds, most and present bytes of each process below this one that is Chromium's."""
    parents, found = {}, {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                stat, status = (entry / "stat").read_text(), (entry / "status").read_text()
                words = (entry / "cmdline").read_bytes().decode("utf-8", "replace")
            except OSError:
                continue
            fields = stat.rpartition(")")[2].split()
            memory = {line.split(":")[0]: int(line.split()[1]) * 1024 for line in status.splitlines() if line.startswith(("VmHWM", "VmRSS"))}
            kind = words.partition("--type=")[2].partition("\0")[0].split(" ")[0] or "browser"
            parents[int(entry.name)] = int(fields[1])
            if "chrom" in words:
                seconds = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
                found[int(entry.name)] = (kind, seconds, memory.get("VmHWM", 0), memory.get("VmRSS", 0))
    below = {os.getpid()}
    while more := {pid for pid, parent in parents.items() if parent in below} - below:
        below |= more
    return {pid: each for pid, each in found.items() if pid in below}


def decibels(found: np.ndarray, expected: np.ndarray) -> float:
    return float(-10 * np.log10(max(np.mean((found.astype(np.float64) / 255 - expected) ** 2), 1e-12)))


def measured(chromium: Any, page: bytes, tree: Any, given: argparse.Namespace, folder: Path, name: str) -> dict[str, Any]:
    path = folder / f"{name}.html"
    path.write_bytes(page)
    width, height = map(int, given.size.split("x"))
    behind = None if tree.environment is not None else tree.background or (1.0, 1.0, 1.0)
    before = sum(each[1] for each in processes().values())
    begin = time.perf_counter()
    with browser.opened(chromium, path, viewport={"width": 640, "height": 480}) as shown:
        shown.ready()
        ready = time.perf_counter() - begin
        shown.page.evaluate(browser.RESTED)
        first, after = time.perf_counter() - begin, processes()
        pictures = []
        for camera in cameras_of(tree, given.views):
            own = np.clip(render(tree, camera, background=behind, normals=False).colour, 0, 1)
            pictures.append(decibels(shown.rendered(camera, background=behind or (0, 0, 0), surroundings=behind is None), own))
        spent = [shown.page.evaluate(SECONDS, [width, height]) for _ in range(given.pictures)]
        kinds = {kind: [max(each[n] for each in after.values() if each[0] == kind) for n in (2, 3)] for kind in ("renderer", "gpu-process")}
        row = {
            "page_mb": round(len(page) / 1e6, 1), "load_s": round(ready, 2), "first_s": round(first, 2),
            "cpu_s": round(sum(each[1] for each in after.values()) - before, 2),
            "peak_mib": {kind: [round(number / 2**20) for number in both] for kind, both in kinds.items()},
            "psnr": [round(number, 1) for number in pictures], "picture_s": [round(number, 2) for number in spent], "console": shown.console,
            "requests": [each for each in shown.requests if not each.startswith(("file:", "data:", "blob:"))],
        }  # fmt: skip
    if given.shots:
        for look, across, down in LOOKS:
            for scheme in ("light", "dark"):
                with browser.opened(chromium, path, viewport={"width": across, "height": down}, color_scheme=scheme) as shown:
                    shown.ready()
                    shown.page.evaluate(browser.RESTED)
                    shown.page.screenshot(path=str(given.shots / f"{name}_{look}_{scheme}.png"))
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("assets", type=Path, nargs="+")
    parser.add_argument("--size", default="640x480")
    parser.add_argument("--views", type=int, default=5)
    parser.add_argument("--pictures", type=int, default=2)
    parser.add_argument("--shots", type=Path)
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks/results/viewer.json")
    given = parser.parse_args()
    if browser.missing() is not None:
        raise SystemExit(browser.missing())
    rows = []
    for what in given.assets:
        begin, name = time.process_time(), what.absolute().stem
        page = page_of(what)
        about, tree = describe(asset_of(what)), load(asset_of(what))
        row = {"name": name, "asset_mb": round(about["bytes"] / 1e6, 1), "voxels": about["voxels"], "writing_cpu_s": round(time.process_time() - begin, 2)}
        with tempfile.TemporaryDirectory() as folder, browser.chromium() as chromium:
            row |= measured(chromium, page, tree, given, Path(folder), name)
            row |= {"load": round(os.getloadavg()[0], 1)}
            machine = {"processor": processor(), "cores": os.cpu_count(), "chromium": chromium.version}
        rows.append(row)
        print(json.dumps(row), flush=True)
    facts = {"date": datetime.datetime.now(datetime.UTC).date().isoformat(), "machine": machine, "size": given.size, "pages": rows}
    given.out.write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
