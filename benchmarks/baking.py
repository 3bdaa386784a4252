"""Time and memory of baking over the number of voxels: the same field at several resolutions.

    python benchmarks/baking.py RUN [--resolutions 96,144,192] [--json benchmarks/results/baking.json] [--set STAGE.NAME=VALUE]

RUN has to be trained; it is not changed. Linear fits separate what is fixed (starting, rendering the training pixels) from what each million voxels
adds. The number of grid cells is reported too.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from stage_runs import linked_copy, made, read_json

from stages.artifacts import BakeOutputs
from workflows.paper.document import hardware, versions


def row_of(run: Path, resolution: int, settings: dict[str, str]) -> dict[str, Any]:
    """Bake at a resolution; its figures."""
    took = made(run, "bake", {"bake.max_mib": 4096, **settings, "bake.resolution": resolution})
    report = read_json(BakeOutputs.of_run(run).report)
    cells, voxels = math.prod(report["resolution"]), report["voxels"]
    print(f"{resolution:5}: {voxels:11,} voxels of {cells:13,} cells: {took['seconds']:.1f} s, {took['cpu_seconds']:.1f} s of processor time, "
          f"{took['peak_mib']:.0f} MiB", flush=True)  # fmt: skip
    return {"resolution": report["resolution"], "cells": cells, "voxels": voxels, **took}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--resolutions", default="96,144,192", help="voxels along the longest side of the box")
    parser.add_argument("--json", type=Path, default=Path(__file__).resolve().parent / "results" / "baking.json")
    parser.add_argument("--set", action="append", default=[], dest="sets", metavar="STAGE.NAME=VALUE")
    given = parser.parse_args()
    settings = dict(text.split("=", 1) for text in given.sets)
    rows = []
    with tempfile.TemporaryDirectory(prefix="baking-", dir=given.run.resolve().parent) as folder:
        work = linked_copy(given.run, Path(folder) / "run")
        for resolution in sorted(int(word) for word in given.resolutions.split(",")):
            rows.append(row_of(work, resolution, settings))
    line = {}
    if len({row["voxels"] for row in rows}) > 1:
        for what in ("seconds", "cpu_seconds", "peak_mib"):
            slope, fixed = np.polyfit([row["voxels"] / 1e6 for row in rows], [row[what] for row in rows], 1)
            line[what] = {"fixed": float(fixed), "per_million_voxels": float(slope)}
            print(f"{what}: {fixed:.1f} and {slope:.2f} per million voxels")
    document = {"run": given.run.resolve().name, "settings": settings, "rows": rows, "line": line, "hardware": hardware("cpu"), "versions": versions()}
    given.json.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
