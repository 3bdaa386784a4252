"""The whole pipeline on a CUDA device: seconds per stage, training speed and quality, written to benchmarks/results/gpu.json.

    python benchmarks/gpu.py [SOURCE] [--preset standard] [--json FILE]

Says so and does nothing where torch has no CUDA device.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import platform
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent


def run(source: Path, folder: Path, options: list[str]) -> dict[str, Any]:
    """The summary of `enerf run`, and what it said last of its training."""
    command = [sys.executable, "-m", "workflows.cli", "run", str(source), "--out", str(folder), "--device", "cuda", "--json", *options]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        events = [json.loads(line) for line in child.stdout]
    if child.returncode != 0:
        raise SystemExit(f"gpu: the run ended with {child.returncode}: {events[-1].get('error') if events else 'it said nothing'}")
    training = [event for event in events if event["event"] == "progress" and event["stage"] == "train"]
    return {**events[-1], "training": training[-1] if training else None}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", nargs="?", type=Path, default=HERE.parent / "examples" / "still_life")
    parser.add_argument("--preset", default="standard")
    parser.add_argument("--set", action="append", default=[], dest="sets", metavar="STAGE.NAME=VALUE")
    parser.add_argument("--json", type=Path, default=HERE / "results" / "gpu.json")
    given = parser.parse_args()

    import torch

    if not torch.cuda.is_available():
        print("gpu: no CUDA device that torch can use; nothing was run.")
        return 0
    options = ["--preset", given.preset, *(word for text in given.sets for word in ("--set", text))]
    with tempfile.TemporaryDirectory(prefix="gpu-") as folder:
        summary = run(given.source, Path(folder) / "run", options)
    seconds = summary["seconds"]
    steps = summary["training"]["total"] if summary["training"] else None
    result = {
        "source": given.source.name,
        "options": options,
        "device": torch.cuda.get_device_name(),
        "torch": torch.__version__,
        "efficientnerf": importlib.metadata.version("efficientnerf"),
        "platform": platform.platform(),
        "seconds": {"total": round(summary["elapsed"], 1), **{stage: round(took, 1) for stage, took in seconds.items()}},
        "training_steps_per_second": round(steps / seconds["train"], 1) if steps else None,
        "metrics": {name: summary["metrics"][name] for name in ("network", "asset")} if summary["metrics"] else None,
    }
    given.json.parent.mkdir(parents=True, exist_ok=True)
    given.json.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    print(json.dumps(result, indent=1))
    print(f"written to {given.json}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
