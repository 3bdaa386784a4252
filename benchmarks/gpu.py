"""A CUDA device at work: kernels, pictures, training steps and the whole pipeline, written to benchmarks/results/gpu.json after each part.

    python benchmarks/gpu.py [SOURCE] [--parts kernels,pictures,training,pipeline] [--seconds 560] [--preset standard] [--asset FILE] [--json FILE]

Says so and does nothing where torch has no CUDA device. What has not ended after --seconds is stopped and noted as such.
"""

from __future__ import annotations

import argparse
import json
import platform
import subprocess
import sys
import tempfile
import time
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
PARTS = ("kernels", "pictures", "training", "pipeline")
TILES = [((8, 4), 2), ((8, 8), 2), ((8, 8), 4), ((4, 4), 1), ((16, 2), 1), ((16, 4), 2)]


def run(source: Path, folder: Path, options: list[str], seconds: float) -> dict[str, Any]:
    """The summary of `enerf run`, and what it said last of its training."""
    command = [sys.executable, "-m", "workflows.cli", "run", str(source), "--out", str(folder), "--device", "cuda", "--json", *options]
    try:
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, timeout=max(1.0, seconds), check=False)
    except subprocess.TimeoutExpired as late:
        return {"stopped_after_seconds": round(late.timeout)}
    events = [json.loads(line) for line in done.stdout.splitlines()]
    if done.returncode != 0:
        return {"exit_code": done.returncode, "error": events[-1].get("error") if events else "it said nothing"}
    training = [event for event in events if event["event"] == "progress" and event["stage"] == "train"]
    summary = events[-1]
    took = summary["seconds"]
    steps = training[-1]["total"] if training else None
    return {
        "source": source.name,
        "options": options,
        "seconds": {"total": round(summary["elapsed"], 1), **{stage: round(t, 1) for stage, t in took.items()}},
        "training_steps_per_second": round(steps / took["train"], 1) if steps else None,
        "metrics": {name: summary["metrics"][name] for name in ("network", "asset")} if summary["metrics"] else None,
    }


def measured(part: str, given: argparse.Namespace, seconds: float) -> dict[str, Any]:
    """The figures of one part."""
    sys.path.insert(0, str(HERE))
    import gpu_kernels

    if part == "kernels":
        return {"copy_gb_per_second": round(gpu_kernels.copy_rate("cuda", 2048, 10)), **gpu_kernels.kernel_rates("cuda", 2**16, 19, 20)}
    if part == "pictures":
        from efficientnerf.nerftree.tree import NerfTree

        tree = NerfTree.load(given.asset) if given.asset else gpu_kernels.shell(384)
        return gpu_kernels.frame_rates("cuda", tree, 800, 10, TILES)
    if part == "training":
        return gpu_kernels.training_rates("cuda", 1500, 400, 40, samples=2**18, rays=2**16, levels=16, log2_table=19, finest=2048)
    options = ["--preset", given.preset, *(word for text in given.sets for word in ("--set", text))]
    with tempfile.TemporaryDirectory(prefix="gpu-") as folder:
        return run(given.source, Path(folder) / "run", options, seconds)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", nargs="?", type=Path, default=HERE.parent / "examples" / "still_life")
    parser.add_argument("--parts", default=",".join(PARTS))
    parser.add_argument("--seconds", type=float, default=560.0)
    parser.add_argument("--preset", default="standard")
    parser.add_argument("--set", action="append", default=[], dest="sets", metavar="STAGE.NAME=VALUE")
    parser.add_argument("--asset", type=Path, help="draw this tree instead of a made-up one")
    parser.add_argument("--json", type=Path, default=HERE / "results" / "gpu.json")
    given = parser.parse_args()
    wanted = given.parts.split(",")
    for part in wanted:
        if part not in PARTS:
            parser.error(f"--parts: found {part!r}, expected some of {', '.join(PARTS)}")

    import torch

    if not torch.cuda.is_available():
        print("gpu: no CUDA device that torch can use; nothing was run.")
        return 0
    started = time.monotonic()
    try:
        ours = version("efficientnerf")
    except PackageNotFoundError:
        ours = "not installed"
    result: dict[str, Any] = {"device": torch.cuda.get_device_name(), "torch": torch.__version__, "efficientnerf": ours, "platform": platform.platform()}
    failed = False
    for part in wanted:
        left = given.seconds - (time.monotonic() - started)
        try:
            result[part] = measured(part, given, left) if left > 0 else {"left_out": f"{given.seconds:g} s were over"}
        except Exception as error:  # the other parts are worth their figures all the same
            result[part] = {"error": f"{type(error).__name__}: {error}"}
            failed = True
        given.json.parent.mkdir(parents=True, exist_ok=True)
        given.json.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
        print(json.dumps({part: result[part]}, indent=1), flush=True)
    print(f"written to {given.json}")
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
