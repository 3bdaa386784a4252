"""Run the pipeline on some sources with default settings and write seconds and quality.

    python benchmarks/end_to_end.py SOURCE... --runs FOLDER [--json FILE]

Each source has a run of its own, FOLDER/<name of the source>. A run that exists is only read, with the seconds that its stages took. The machine, the
versions and, for runs made here, the load average are written too.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any

from stages.artifacts import BakeOutputs, EvaluateOutputs

LIBRARIES = ("torch", "numba", "numpy", "pycolmap")


def summary_of(source: Path, run: Path) -> dict[str, Any]:
    """Run `enerf run` and return its summary, the last JSON object that it prints."""
    command = [sys.executable, "-m", "workflows.cli.main", "run", str(source), "--out", str(run), "--json"]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
    summary = json.loads(done.stdout.splitlines()[-1])
    if done.returncode != 0:
        raise SystemExit(f"{source}: exit code {done.returncode}: {summary.get('error')}")
    return summary


def row_of(source: Path, run: Path) -> dict[str, Any]:
    summary = summary_of(source, run)
    metrics = json.loads(EvaluateOutputs.of_run(run).metrics.read_text(encoding="utf-8"))
    status = json.loads(subprocess.run([sys.executable, "-m", "workflows.cli.main", "status", str(run), "--json"], stdout=subprocess.PIPE, check=True).stdout)
    return {
        "source": source.name,
        "seconds": {stage["name"]: stage["seconds"] for stage in status["stages"]},
        "network": {name: metrics["network"][name] for name in ("psnr", "ssim", "psnr_in_box", "views", "scale")},
        "asset": {name: metrics["asset"][name] for name in ("psnr", "ssim", "psnr_in_box", "views")},
        "asset_bytes": BakeOutputs.of_run(run).asset.stat().st_size,
        "ok": summary["ok"],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sources", nargs="+", type=Path)
    parser.add_argument("--runs", type=Path, required=True, help="folder of the runs")
    parser.add_argument("--json", type=Path, help="where to write the table")
    arguments = parser.parse_args()
    rows = []
    for source in arguments.sources:
        before, existed = os.getloadavg(), (arguments.runs / source.name).exists()
        row = row_of(source, arguments.runs / source.name)
        if not existed:
            row["load"] = {"before": before, "after": os.getloadavg()}
        rows.append(row)
        total = sum(row["seconds"].values())
        quality = f"network {row['network']['psnr']:.2f} dB  asset {row['asset']['psnr']:.2f} dB, {row['asset_bytes'] / 1e6:.1f} MB"
        print(f"{row['source']:20} {total:6.0f} s  {quality}")
    if arguments.json is not None:
        machine = {"cores": os.cpu_count(), "processor": platform.machine(), "python": platform.python_version()}
        table = {"date": datetime.date.today().isoformat(), "machine": machine, "versions": {name: version(name) for name in LIBRARIES}, "rows": rows}
        arguments.json.write_text(json.dumps(table, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
