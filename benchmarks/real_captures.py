"""Cameras of photographs as people take them: what `enerf check` forecasts, what `enerf run --until poses` then finds, and whether it finds it again.

    python -m benchmarks.real_captures FOLDER [FOLDER ...] [--reference NAME=CAMERAS.json] [--out benchmarks/results]

Each folder is run twice, each time in a new run; a repetition counts where all files of the stage but its log are the same to the byte. A reference is a
transforms.json, or a list of {"img_name", "position"} as trainers of 3D Gaussians write them; its own error is not known. Writes real_captures.json and .md.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.poses import aligned_errors, true_centres
from workflows.paper.document import hardware

ROOT = Path(__file__).resolve().parents[1]
ENERF = (sys.executable, "-m", "workflows.cli.main")
ITS_OWN = ("manifest.json", "log.jsonl")  # of each attempt: they have its times


def reference_centres(path: Path) -> dict[str, np.ndarray]:
    """Centres by the stems of the photographs' names."""
    found = json.loads(path.read_text(encoding="utf-8"))
    if isinstance(found, list):
        return {Path(camera["img_name"]).stem: np.array(camera["position"]) for camera in found}
    return {Path(name).stem: centre for name, centre in true_centres(path).items()}


def centres_of(run: Path) -> dict[str, np.ndarray]:
    views = json.loads((run / "poses" / "scene.json").read_text(encoding="utf-8"))["views"]
    return {Path(view["source_camera"]["name"]).stem: np.array(view["source_camera"]["world_from_camera"])[:3, 3] for view in views}


def percent_off(run: Path, reference: dict[str, np.ndarray]) -> float | None:
    """Root mean square of the centres' distances, of their mean distance from the middle; None where they have fewer than four in common."""
    found = centres_of(run)
    names = sorted(found.keys() & reference.keys())
    if len(names) < 4:
        return None
    errors = aligned_errors(np.array([found[name] for name in names]), np.array([reference[name] for name in names]))
    return round(100 * float(np.sqrt((errors**2).mean())), 3)


def digest_of(stage: Path) -> str:
    """Of names and bytes of all files below but those of the attempt itself."""
    total = hashlib.sha256()
    for path in sorted(path for path in stage.rglob("*") if path.is_file() and path.name not in ITS_OWN):
        total.update(f"{path.relative_to(stage)}\0{hashlib.sha256(path.read_bytes()).hexdigest()}\n".encode())
    return total.hexdigest()


def summary_of(command: list[str]) -> dict[str, Any]:
    """What a command with --json says last, its exit code, and `wall`, seconds."""
    started = time.monotonic()
    done = subprocess.run([*ENERF, *command, "--json"], capture_output=True, text=True, check=False, cwd=ROOT)
    wall = round(time.monotonic() - started, 1)
    lines = [line for line in done.stdout.splitlines() if line.startswith("{")]
    if not lines:
        raise SystemExit(f"{' '.join(command)}: exit code {done.returncode}, {done.stderr[-2000:]}")
    return {**json.loads(lines[-1]), "exit_code": done.returncode, "wall": wall}


def row_of(folder: Path, work: Path, reference: dict[str, np.ndarray] | None) -> dict[str, Any]:
    checked = summary_of(["check", str(folder)])
    row: dict[str, Any] = {
        "photographs": checked["photographs"],
        "forecast": checked["grade"],
        "forecast_problems": [problem["what"] for problem in checked["problems"]],
        "check_seconds": checked["wall"],
        "forecast_seconds": checked["forecast"]["poses_seconds"],
        "load": [round(load, 1) for load in os.getloadavg()],
    }
    runs = [work / f"{folder.name}-{k}" for k in range(2)]
    done = [summary_of(["run", str(folder), "--out", str(run), "--until", "poses"]) for run in runs]
    row |= {"exit_code": done[0]["exit_code"], "seconds": [each["wall"] for each in done]}
    if done[0]["exit_code"] == 0:
        verdict = json.loads((runs[0] / "poses" / "verdict.json").read_text(encoding="utf-8"))
        row |= {"registered": verdict["registered"], "grade": verdict["grade"], "problems": [problem["what"] for problem in verdict["problems"]]}
        row["processor_seconds"] = round(json.loads((runs[0] / "poses" / "manifest.json").read_text(encoding="utf-8"))["cpu_seconds"], 1)
        row["the_same_again"] = digest_of(runs[0] / "poses") == digest_of(runs[1] / "poses")
        row["percent_off_reference"] = None if reference is None else percent_off(runs[0], reference)
    return row


def in_markdown(rows: dict[str, dict[str, Any]]) -> str:
    columns = (
        "capture", "photographs", "`check` forecasts", "and names", "in s", "registered", "grade", "names", "off the reference, %", "s forecast", "s",
        "processor s", "same bytes again",
    )  # fmt: skip
    lines = ["# Photographs as people take them", "", "`python -m benchmarks.real_captures`: the stage `poses`.", ""]
    lines += ["| " + " | ".join(columns) + " |", "|---" * len(columns) + "|"]
    for name, row in rows.items():
        off = "" if row.get("percent_off_reference") is None else row["percent_off_reference"]
        parts = [name, row["photographs"], row["forecast"], ", ".join(row["forecast_problems"]), row["check_seconds"]]
        parts += [row.get("registered", ""), row.get("grade", "failed"), ", ".join(row.get("problems", [])), off]
        parts += [row["forecast_seconds"], row["seconds"][0], row.get("processor_seconds", "")]
        lines.append("| " + " | ".join(map(str, [*parts, "yes" if row.get("the_same_again") else "**no**"])) + " |")
    return "\n".join([*lines, ""])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--reference", action="append", default=[], metavar="NAME=CAMERAS.json", help="of the folder of this name")
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "results")
    given = parser.parse_args()
    references = {name: reference_centres(Path(path)) for name, _, path in (text.partition("=") for text in given.reference)}
    given.out.mkdir(parents=True, exist_ok=True)
    table = given.out / "real_captures.json"
    rows: dict[str, dict[str, Any]] = json.loads(table.read_text(encoding="utf-8"))["rows"] if table.exists() else {}
    for folder in given.folders:
        name = folder.parent.name if folder.name in ("photos", "images") else folder.name
        with tempfile.TemporaryDirectory() as work:
            rows[name] = row_of(folder.resolve(), Path(work), references.get(name))
        print(f"{name}: {json.dumps(rows[name])}", flush=True)
        table.write_text(json.dumps({"machine": hardware("cpu"), "rows": rows}, indent=1) + "\n", encoding="utf-8")
        table.with_suffix(".md").write_text(in_markdown(rows), encoding="utf-8")


if __name__ == "__main__":
    main()
