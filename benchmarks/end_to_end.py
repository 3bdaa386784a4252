"""Run the pipeline on some sources with default settings and write quality, seconds and megabytes.

    python -m benchmarks.end_to_end --sets still_life,banana_photos,monstree,snowmiku,lund_door --runs FOLDER [--json FILE] [--markdown FILE] [SOURCE...]

Each source has a run of its own, FOLDER/<name of the set or the source>. A run that exists is resumed, or only read where nothing is left to do, with the
seconds that its stages took. A source that fails has a row that says so, and the others go on; the exit code is then 1. The machine, the versions and, for runs
made here, the load average are written too. Frames a second are of the asset alone at 640x480, along the captured cameras.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

from benchmarks.machine import processor
from stages.artifacts import BakeOutputs, EvaluateOutputs, PosesOutputs

ROOT = Path(__file__).parents[1]
DATA = ROOT.parent / "shared" / "data"
EXAMPLES = {"still_life": ROOT / "examples" / "still_life"}
FOLDERS = {
    "banana_photos": "banana_photos", "monstree": "monstree", "snowmiku": "snowmiku/photos", "lund_door": "lund_door_colmap", "lund_photos": "lund_photos",
    "fern": "fern_4", "chair": "chair_200",
}  # fmt: skip
LIBRARIES = ("torch", "numba", "numpy", "pycolmap")
SHOWN = ("psnr", "ssim", "psnr_in_box", "psnr_colour_fitted", "floaters", "views", "scale")
FRAMES, FRAME = 20, (640, 480)
COLUMNS = ("set", "views", "network dB / SSIM", "asset dB / SSIM", "gap dB", "holes %", "floaters % (network)", "over the network's surroundings dB", "seconds",
           "train, bake, evaluate", "MB", "frames/s")  # fmt: skip


def summary_of(source: Path, run: Path, more: Sequence[str]) -> dict[str, Any]:
    """Run `enerf run` and return its summary, the last JSON object that it prints. Raises RuntimeError where it fails."""
    command = [sys.executable, "-m", "workflows.cli.main", "run", str(source), "--out", str(run), "--json", *more]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
    lines = done.stdout.splitlines()
    summary: dict[str, Any] = json.loads(lines[-1]) if lines else {}
    if done.returncode != 0:
        raise RuntimeError(f"exit code {done.returncode}: {summary.get('error')}")
    return summary


def row_of(name: str, source: Path, run: Path, more: Sequence[str]) -> dict[str, Any]:
    """The figures of one source: run, or read from a run."""
    summary = summary_of(source, run, more)
    metrics = json.loads(EvaluateOutputs.of_run(run).metrics.read_text(encoding="utf-8"))
    status = json.loads(subprocess.run([sys.executable, "-m", "workflows.cli.main", "status", str(run), "--json"], stdout=subprocess.PIPE, check=True).stdout)
    scene = json.loads(PosesOutputs.of_run(run).scene.read_text(encoding="utf-8"))
    seconds = {stage["name"]: stage["seconds"] for stage in status["stages"]}
    return {
        "source": name,
        "photographs": len(scene["views"]),
        "seconds": seconds,
        "total_seconds": sum(filter(None, seconds.values())),
        **figures_of(metrics),
        "asset_bytes": BakeOutputs.of_run(run).asset.stat().st_size,
        "frames_per_second": frames_per_second(run),
        "ok": summary["ok"],
    }


def figures_of(metrics: Mapping[str, Any]) -> dict[str, Any]:
    """What of metrics.json is kept: means, and the views of the strips."""
    parts = ("network", "asset", "asset_with_network_background", "gap")
    kept = {part: metrics[part] and {key: metrics[part][key] for key in SHOWN if key in metrics[part]} for part in parts}
    return kept | {key: metrics[key] for key in ("holes", "floaters")} | {"strips": [{key: s[key] for key in ("which", "view")} for s in metrics["strips"]]}


def frames_per_second(run: Path) -> float:
    """Frames of 640x480 a second along the captured cameras, after one that is not counted."""
    from efficientnerf.asset import format
    from efficientnerf.asset.rendering import render
    from efficientnerf.geometry.cameras import resized
    from stages.framing.captured_path import captured_cameras
    from stages.io.scene import load

    tree = format.load(BakeOutputs.of_run(run).asset)
    path = [resized(camera, *FRAME) for camera in captured_cameras([view.camera for view in load(run / PosesOutputs.stage).views], FRAMES, FRAME[0])]
    background = None if getattr(tree, "environment", None) is not None else (1.0, 1.0, 1.0)
    render(tree, path[0], background=background)
    start = time.perf_counter()
    for camera in path:
        render(tree, camera, background=background)
    return len(path) / (time.perf_counter() - start)


def table_of(rows: Sequence[Mapping[str, Any]]) -> str:
    """A Markdown table, a line for each source."""

    def quality(part: Mapping[str, Any]) -> str:
        return " / ".join("" if part[key] is None else f"{part[key]:.{digits}f}" for key, digits in (("psnr", 2), ("ssim", 3)))

    def percent(share: float | None) -> str:
        return "" if share is None else f"{100 * share:.2f}"

    def cells(row: Mapping[str, Any]) -> list[str]:
        if not row["ok"]:
            return [row["source"], row["error"].replace("|", "/").replace("\n", " "), *[""] * (len(COLUMNS) - 2)]
        gap, over, stages = row["gap"]["psnr"], row["asset_with_network_background"], row["seconds"]
        return [
            row["source"],
            f"{row['asset']['views']} of {row['photographs']}",
            quality(row["network"]),
            quality(row["asset"]),
            "" if gap is None else f"{gap:+.2f}",
            percent(row["holes"]),
            f"{percent(row['floaters'])} ({percent(row['network']['floaters'])})",
            "" if over is None else f"{over['psnr']:.2f}",
            f"{row['total_seconds']:.0f}",
            ", ".join(f"{stages[stage] or 0:.0f}" for stage in ("train", "bake", "evaluate")),
            f"{row['asset_bytes'] / 1e6:.1f}",
            f"{row['frames_per_second']:.1f}",
        ]

    lines = [COLUMNS, ["---"] * len(COLUMNS), *(cells(row) for row in rows)]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def sources_of(sets: Sequence[str], paths: Sequence[Path], data: Path) -> dict[str, Path]:
    """Name -> folder of all that is asked for. Raises SystemExit for a set that is not known or not there."""
    known = EXAMPLES | {name: data / folder for name, folder in FOLDERS.items()}
    for name in sets:
        if name not in known or not known[name].is_dir():
            raise SystemExit(f"{name}: no such set{f' at {known[name]}' if name in known else ''}. Sets: {', '.join(known)}.")
    return {name: known[name] for name in sets} | {path.name: path for path in paths}


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sources", nargs="*", type=Path)
    parser.add_argument("--sets", default="", help=f"names, with commas between: {', '.join([*EXAMPLES, *FOLDERS])}")
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the sets that are not examples")
    parser.add_argument("--runs", type=Path, required=True, help="folder of the runs")
    parser.add_argument("--json", type=Path, help="where to write the figures; they are written after each source")
    parser.add_argument("--markdown", type=Path, help="where to write the table; by default beside the figures")
    parser.add_argument("--options", default="", help='more options of `enerf run`, in one text: "--preset tiny --seed 1"')
    given = parser.parse_args(arguments)
    sources = sources_of([name for name in given.sets.split(",") if name], given.sources, given.data)
    if not sources:
        parser.error("no source: give --sets or folders")
    rows: list[dict[str, Any]] = []
    for name, source in sources.items():
        before, existed = os.getloadavg(), (given.runs / name).exists()
        try:
            row = row_of(name, source, given.runs / name, given.options.split())
        except RuntimeError as error:
            row = {"source": name, "ok": False, "error": str(error)}
        if not existed:
            row["load"] = {"before": before, "after": os.getloadavg()}
        rows.append(row)
        print(table_of([row]).splitlines()[-1], flush=True)
        if given.json is not None:
            write(rows, given.json, given.markdown or given.json.with_suffix(".md"))
    print(table_of(rows))
    return 0 if all(row["ok"] for row in rows) else 1


def write(rows: Sequence[Mapping[str, Any]], figures: Path, table: Path) -> None:
    machine = {"cores": os.cpu_count(), "processor": processor(), "python": platform.python_version()}
    made = {"date": datetime.date.today().isoformat(), "machine": machine, "versions": {name: version(name) for name in LIBRARIES}, "rows": rows}
    figures.write_text(json.dumps(made, indent=1) + "\n", encoding="utf-8")
    table.write_text(table_of(rows), encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
