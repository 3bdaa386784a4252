"""Benchmarks on a CUDA device: tests, kernels, renders, rays of tree training, training steps, a bake and the pipeline; written to
benchmarks/results/gpu.json after each part.

    python benchmarks/gpu.py [SOURCE] [--parts tests,kernels,renders,trees,training,asset,pipeline] [--seconds 570] [--preset standard]
                             [--json FILE]

Prints a line and ends where torch has no CUDA device. Each part runs in a process of its own, because an error on a device can break what follows it;
a part that has not ended after its share of --seconds is stopped and recorded as such. All but the pipeline need METHOD alone
(the tests pytest too): neither pycolmap nor this project has to be installed.
"""

import argparse
import importlib.util
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
# Seconds at most. Most of the tests' time is compilation of kernels.
PARTS = {"tests": 200.0, "kernels": 60.0, "renders": 90.0, "trees": 60.0, "training": 60.0, "asset": 90.0, "pipeline": 600.0}
TESTS = ["tests/efficientnerf", "tests/benchmarks/paper", "--ignore=tests/efficientnerf/backends/test_cuda_builds.py", "-k",
         "cuda or readback or device or gpu"]  # fmt: skip
METHOD = ["torch", "triton", "numba", "scipy", "safetensors", "msgspec", "platformdirs"]
PIPELINE = [
    "msgspec", "platformdirs", "jinja2",
    "click", "rich", "filelock", "safetensors", "PIL", "cv2", "scipy", "skimage", "matplotlib", "OpenEXR", "av", "trimesh", "fast_simplification",
]  # fmt: skip


def ended(command: list[str], seconds: float, **options: Any) -> tuple[int | None, str]:
    """Exit code of a program, None where it took too long and was stopped; and what it printed."""
    with tempfile.TemporaryFile("w+") as output:
        try:
            code: int | None = subprocess.run(command, stdout=output, stderr=subprocess.STDOUT, timeout=seconds, check=False, **options).returncode
        except subprocess.TimeoutExpired:
            code = None
        output.seek(0)
        return code, output.read()


def run(source: Path, folder: Path, options: list[str], seconds: float) -> dict[str, Any]:
    """The summary of `enerf run`, and the last progress of its training."""
    needed = PIPELINE if list(source.glob("transforms*.json")) else [*PIPELINE, "pycolmap"]
    missing = [name for name in needed if importlib.util.find_spec(name) is None]
    if missing:
        return {"left_out": f"not installed here: {', '.join(missing)}"}
    command = [sys.executable, "-m", "workflows.cli.main", "run", str(source), "--out", str(folder), "--device", "cuda", "--json", *options]
    code, output = ended(command, seconds)
    if code is None:
        return {"stopped_after_seconds": round(seconds)}
    events = [json.loads(line) for line in output.splitlines() if line.startswith("{")]
    if code != 0:
        return {"exit_code": code, "error": (events[-1].get("error") if events else None) or output[-2000:]}
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


def tests(seconds: float) -> dict[str, Any]:
    """Result of the kernels' tests on the device, and the last line of pytest."""
    if importlib.util.find_spec("pytest") is None:
        return {"left_out": "not installed here: pytest"}
    # Other versions of the libraries may warn of deprecations.
    command = [sys.executable, "-m", "pytest", "-q", "-W", "default", "-p", "no:cacheprovider", "--continue-on-collection-errors", *TESTS]
    if importlib.util.find_spec("xdist") is not None:
        command += ["-n", str(min(8, os.cpu_count() or 1))]
    code, output = ended(command, seconds, cwd=ROOT)
    lines = output.splitlines()
    failed = [line for line in lines if line.startswith(("FAILED", "ERROR", "E   "))]
    return {"exit_code": code, **({} if code == 0 else {"failed": failed[:80]}), "last": lines[-1] if lines else ""}


def measured(part: str, given: argparse.Namespace, seconds: float) -> dict[str, Any]:
    """The figures of one part."""
    sys.path[:0] = [str(ROOT), str(HERE)]
    if part == "tests":
        return tests(seconds)
    if part == "pipeline":
        options = ["--preset", given.preset, *(word for text in given.sets for word in ("--set", text))]
        with tempfile.TemporaryDirectory(prefix="gpu-") as folder:
            return run(given.source, Path(folder) / "run", options, seconds)
    missing = [name for name in METHOD if importlib.util.find_spec(name) is None]
    if missing:
        return {"left_out": f"not installed here: {', '.join(missing)}"}
    import gpu_asset
    import gpu_kernels

    if part == "kernels":
        splats = {"splats_ms": gpu_kernels.splat_rates("cuda", 200_000, 512, 10)}
        return {"copy_gb_per_second": round(gpu_kernels.copy_rate("cuda", 2048, 10)), **gpu_kernels.kernel_rates("cuda", 2**16, 19, 20), **splats}
    if part == "renders":
        return gpu_kernels.frame_rates("cuda", gpu_kernels.shell(384), 800, 10)
    if part == "trees":
        import gpu_tree

        return {f"degree_{n}": gpu_tree.tree_rates("cuda", gpu_kernels.shell(384, n), 800, 8, 2048, 20) for n in (0, 2)}
    if part == "asset":
        return gpu_asset.asset_rates(
            "cuda", steps=2000, side=400, views=60, resolution=256, pixels=1_000_000, refine_steps=160, rays=32768, sample_batch_size=2**18
        )
    settings = {"sample_batch_size": 2**18, "max_rays_per_batch": 2**16, "num_levels": 16, "log2_hashmap_size": 19, "finest_resolution": 2048}
    return gpu_kernels.training_rates("cuda", 1500, 400, 40, **settings)


def in_child(part: str, seconds: float) -> dict[str, Any]:
    """The figures of one part, from a child process with the same arguments."""
    with tempfile.TemporaryDirectory(prefix="gpu-") as folder:
        figures = Path(folder) / "figures.json"
        command = [sys.executable, __file__, *sys.argv[1:], "--only", part, "--seconds", str(max(1.0, seconds - 10)), "--json", str(figures)]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))}
        begun = time.monotonic()
        code, text = ended(command, seconds, env=environment)
        if code is None:
            return {"stopped_after_seconds": round(seconds)}
        if code != 0 or not figures.exists():
            return {"error": text[-3000:] or f"exit code {code}"}
        return {**json.loads(figures.read_text(encoding="utf-8")), "seconds_in_all": round(time.monotonic() - begun, 1)}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", nargs="?", type=Path, default=ROOT / "examples" / "still_life")
    parser.add_argument("--parts", default=",".join(PARTS))
    parser.add_argument("--seconds", type=float, default=570.0)
    parser.add_argument("--preset", default="standard")
    parser.add_argument("--set", action="append", default=[], dest="sets", metavar="STAGE.NAME=VALUE")
    parser.add_argument("--json", type=Path, default=HERE / "results" / "gpu.json")
    parser.add_argument("--only", help=argparse.SUPPRESS)
    given = parser.parse_args()
    wanted = given.parts.split(",")
    for part in wanted:
        if part not in PARTS:
            parser.error(f"--parts: found {part!r}, expected some of {', '.join(PARTS)}")
    if given.only:
        given.json.write_text(json.dumps(measured(given.only, given, given.seconds)), encoding="utf-8")
        return 0

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
        left = min(PARTS[part], given.seconds - (time.monotonic() - started))
        result[part] = in_child(part, left) if left > 15 else {"left_out": f"{given.seconds:g} s were over"}
        failed |= "error" in result[part] or result[part].get("exit_code", 0) != 0
        given.json.parent.mkdir(parents=True, exist_ok=True)
        given.json.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
        print(json.dumps({part: result[part]}, indent=1), flush=True)
    print(f"written to {given.json}")
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
