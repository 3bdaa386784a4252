"""Samples per second of each CPU kernel of the hash field's training step, and what the machine can copy, gather and multiply.

    python benchmarks/kernels.py [--json FILE] [--seconds 1.0] [--threads 1,2]

Each kernel is timed alone, on the sizes of a step of the default preset in its steady state, with one thread and with all; each figure is the best of
many repetitions within `--seconds`. The floor of a kernel is the larger of two times: the bytes it must move over the measured bandwidth, and the
products it must compute over the measured rate. Each number of threads is measured in a process of its own, because some libraries read the number once.
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
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

from machine import processor

RAYS, PER_RAY = 8192, 4  # coarse samples; fine ones are about as many
ROOT = Path(__file__).resolve().parents[1]


def best(work: Callable[[], object], seconds: float) -> float:
    """Shortest of the repetitions, in seconds."""
    work()
    shortest, until = float("inf"), time.perf_counter() + seconds
    while time.perf_counter() < until:
        began = time.perf_counter()
        work()
        shortest = min(shortest, time.perf_counter() - began)
    return shortest


def machine(seconds: float) -> dict[str, float]:
    """Upper bounds: copying, gathering 8-byte entries of a table of 1 MiB and of 12, products of matrices."""
    import numba
    import numpy as np
    import torch

    @numba.njit(parallel=True, error_model="numpy")
    def gather(table, place, tasks):  # type: ignore[no-untyped-def]
        total = np.zeros(tasks, np.int64)
        share = len(place) // tasks
        for task in numba.prange(tasks):
            some = np.int64(0)
            for n in range(task * share, (task + 1) * share):
                some += table[place[n]]
            total[task] = some
        return total

    threads = numba.get_num_threads()
    large = torch.empty(2**26)  # 256 MiB
    other = torch.empty_like(large)
    out = {"copy_bytes": 2 * 4 * len(large) / best(lambda: other.copy_(large), seconds)}
    place = np.random.default_rng(0).integers(0, 2**17, 2**21).astype(np.uint32)
    for name, entries in (("gather_1_mib", 2**17), ("gather_12_mib", 12 * 2**17)):
        table = np.arange(entries)
        at = (place * np.uint32(entries // 2**17)).astype(np.uint32)
        out[name] = len(at) / best(lambda table=table, at=at: gather(table, at, threads), seconds)  # type: ignore[misc]
    for name, dtype in (("float32", torch.float32), ("bfloat16", torch.bfloat16)):
        a = torch.randn(1536, 1536).to(dtype)
        b = torch.randn(1536, 1536).to(dtype)
        out[f"multiply_{name}"] = 2 * 1536**3 / best(lambda a=a, b=b: a @ b, seconds)  # type: ignore[misc]
    return out


def row(samples: int, seconds: float, moved: float, operations: float = 0.0) -> dict[str, Any]:
    """Figures of one call: samples, seconds, bytes that must be moved at least, multiplications and additions."""
    return {"samples": samples, "seconds": seconds, "bytes": moved, "operations": operations}


def kernels(seconds: float) -> dict[str, Any]:
    """name -> `row`."""
    return {**field_kernels(seconds), **compositing_kernels(seconds), **march_kernel(seconds), **adam_kernel(seconds)}


def default_field() -> Any:
    """The fine field of the default preset, untrained."""
    import torch

    from efficientnerf.fields.hash import HashField
    from efficientnerf.training.settings import FINEST, LOG2_TABLE, TrainSettings

    s = TrainSettings()
    return HashField(
        levels=s.num_levels, log2_table=LOG2_TABLE, coarsest=16, finest=FINEST, hidden=s.hidden_dim, layers=s.num_layers, degree=s.sh_degree,
        initial_density=s.initial_density, generator=torch.Generator().manual_seed(0), precision=s.precision,
    )  # fmt: skip


def field_kernels(seconds: float) -> dict[str, Any]:
    """The encoding, the network, and the field's passes as a whole."""
    import numpy as np
    import torch

    from efficientnerf.backends.numba import hash_grid, mlp
    from efficientnerf.backends.torch.linear_chain import has_bfloat16
    from efficientnerf.fields.hash import FEATURES

    field, rng = default_field(), np.random.default_rng(0)
    # Samples follow each other on rays that end on a sphere, as in a trained scene.
    count = RAYS * PER_RAY
    surface = rng.normal(size=(RAYS, 1, 3))
    surface *= 0.3 / np.linalg.norm(surface, axis=2, keepdims=True)
    points = torch.from_numpy((0.5 + surface * (1 + 0.01 * np.arange(PER_RAY)[:, None])).reshape(-1, 3).astype(np.float32))
    across = points.t().contiguous().numpy()
    features = np.empty((FEATURES * len(field.sides), count), np.float32)
    grad_features = rng.normal(size=features.shape).astype(np.float32)
    table_grad = np.zeros_like(field.table.detach().numpy())
    levels = (field.sides, field.dense, field.starts, field.mask)
    corners = count * len(field.sides) * 8
    encode = best(lambda: hash_grid.encode(across, field.table.detach().numpy(), *levels, features), seconds)
    encode_back = best(lambda: hash_grid.encode_backward(across, grad_features, *levels, table_grad), seconds)

    wide = 2 if has_bfloat16("cpu") and field.precision != "float32" else 4
    weights = [weight.detach().numpy() for weight in field.weights]
    products, activations = 2 * count * sum(w.size for w in weights), wide * count * sum(len(w) for w in weights[:-1])
    out, grad_out = np.empty((count, len(weights[-1])), np.float32), rng.normal(size=(count, len(weights[-1]))).astype(np.float32)
    prepared = mlp.pack_weights(weights, bfloat16=wide == 2)
    kept = mlp.forward(features, prepared, 0.0, out, keep=True)
    network = best(lambda: mlp.forward(features, prepared, 0.0, out, keep=True), seconds)
    network_back = best(lambda: mlp.backward(grad_out, features, prepared, kept, [w.shape for w in weights]), seconds)
    both = best(lambda: field(points).backward(torch.from_numpy(grad_out)), seconds)
    ends = features.nbytes + out.nbytes
    return {
        "encode": row(count, encode, corners * 8 + features.nbytes, corners * 4),
        "encode backward": row(count, encode_back, corners * 16 + features.nbytes, corners * 4),
        "network": row(count, network, ends + activations, products),
        "network backward": row(count, network_back, ends + features.nbytes + activations, 2.0 * products),
        "field, forward and backward": row(count, both, corners * 24 + 2 * ends + 2 * features.nbytes + 2 * activations, 3.0 * products),
    }


def compositing_kernels(seconds: float) -> dict[str, Any]:
    import numpy as np
    import torch

    from efficientnerf.backends.numba import compositing
    from efficientnerf.rendering.harmonics import basis, harmonics_count
    from efficientnerf.training.settings import TrainSettings

    degree, count = TrainSettings().sh_degree, RAYS * PER_RAY
    raw, length, first = torch.randn(count, 1 + 3 * harmonics_count(degree)), torch.full((count,), 0.02), torch.arange(0, count + 1, PER_RAY)
    harmonics = basis(torch.nn.functional.normalize(torch.randn(RAYS, 3), dim=1), degree)
    packed = [t.numpy() for t in (raw, length, first, harmonics, torch.rand(RAYS, 3))]
    colour, opacity, distortion = np.empty((RAYS, 3), np.float32), np.empty(RAYS, np.float32), np.empty(RAYS, np.float32)
    outputs = np.empty(count, np.float32), np.empty((count, 3), np.float32)  # weights and colours of samples
    grad_raw, grad_background, ones = np.empty(raw.shape, np.float32), np.empty((RAYS, 3), np.float32), np.ones(count, np.float32)
    forward = best(lambda: compositing.composite(*packed, True, colour, opacity, distortion, *outputs), seconds)
    backward = best(lambda: compositing.composite_backward(*packed, True, *outputs, colour, opacity, distortion, ones, grad_raw, grad_background), seconds)
    return {
        "composite": row(count, forward, packed[0].nbytes + 16 * count),
        "composite backward": row(count, backward, 2 * packed[0].nbytes + 16 * count),
    }


def march_kernel(seconds: float) -> dict[str, Any]:
    """Rays through voxels that hold a shell."""
    import numpy as np
    import torch

    from efficientnerf.backends import dispatch
    from efficientnerf.geometry.spaces import BoundedSpace
    from efficientnerf.training.settings import TrainSettings

    s = TrainSettings()
    side = BoundedSpace.occupancy_resolution if s.occupancy_resolution == "auto" else s.occupancy_resolution
    axis = (torch.arange(side) + 0.5) / side * 2 - 1
    distance = (axis[:, None, None] ** 2 + axis[None, :, None] ** 2 + axis[None, None, :] ** 2).sqrt()
    voxels = ((distance - 0.6).abs() < 0.04).float()
    origins = torch.nn.functional.normalize(torch.randn(RAYS, 3), dim=1) * 4
    directions = torch.nn.functional.normalize(torch.rand(RAYS, 3) - 0.5 - origins, dim=1)
    near, far, offset = torch.full((RAYS,), 2.0), torch.full((RAYS,), 6.0), torch.rand(RAYS)
    space, step = BoundedSpace(np.array([[-1.0] * 3, [1.0] * 3])), 2 * 3**0.5 / BoundedSpace.num_coarse_samples
    marched = (space, origins, directions, near, far, offset, step, BoundedSpace.num_coarse_samples + 1, voxels, 0.5)
    found = dispatch.valid_samples(*marched)
    took = best(lambda: dispatch.valid_samples(*marched), seconds)
    return {"march (intervals)": row(found.tried, took, found.tried * 4 + len(found.start) * 24)}


def adam_kernel(seconds: float) -> dict[str, Any]:
    """A step on the table of which two thirds of the entries have a gradient, which it clears; the time to fill it again is subtracted."""
    import numpy as np

    from efficientnerf.backends.numba import adam as cpu_adam

    entries, size = default_field().table.shape[0], default_field().table.numel()
    value, first_moment, second_moment = (np.zeros(size, np.float32) for _ in range(3))
    touched = np.random.default_rng(0).random(entries) < 0.65
    kept = np.repeat(np.where(touched, 1.0, 0.0), size // entries).astype(np.float32)
    grad = kept.copy()
    refill = best(lambda: np.copyto(grad, kept), seconds / 4)
    numbers = [np.float32(x) for x in (0.01, 0.9, 0.99, 0.5, 0.5, 1e-15)]

    def adam() -> None:
        np.copyto(grad, kept)
        cpu_adam.adam(value, grad, first_moment, second_moment, *numbers, True)

    return {"Adam (entries of the table)": row(entries, best(adam, seconds) - refill, 7.0 * grad.nbytes)}


def measured(seconds: float) -> dict[str, Any]:
    """Both, with the threads of this process."""
    import torch

    from efficientnerf.backends.torch.linear_chain import has_bfloat16

    torch.set_num_threads(int(os.environ["OMP_NUM_THREADS"]))
    rates = machine(seconds)
    rate = rates["multiply_bfloat16" if has_bfloat16("cpu") else "multiply_float32"]
    found = kernels(seconds)
    for row in found.values():
        row["samples_per_second"] = row["samples"] / row["seconds"]
        row["floor_seconds"] = max(row["bytes"] / rates["copy_bytes"], row["operations"] / rate)
        row["share_of_floor"] = row["floor_seconds"] / row["seconds"]
    return {"machine": rates, "kernels": found}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, help="where to write the figures")
    parser.add_argument("--seconds", type=float, default=1.0, help="for each kernel and number of threads")
    parser.add_argument("--threads", default=f"1,{len(os.sched_getaffinity(0))}", help="numbers of threads, with commas")
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.child:
        print(json.dumps(measured(arguments.seconds)))
        return
    load = os.getloadavg()
    found: dict[str, Any] = {}
    for threads in dict.fromkeys(arguments.threads.split(",")):
        environment = {**os.environ, "OMP_NUM_THREADS": threads, "NUMBA_NUM_THREADS": threads, "OMP_WAIT_POLICY": "PASSIVE"}
        command = [sys.executable, __file__, "--child", "--seconds", str(arguments.seconds)]
        done = subprocess.run(command, env={**environment, "PYTHONPATH": str(ROOT)}, stdout=subprocess.PIPE, text=True, check=True)
        found[threads] = json.loads(done.stdout.splitlines()[-1])
    one, most = found[next(iter(found))], found[list(found)[-1]]
    print(f"{'':32}{'Msamples/s':>12}{'of floor':>10}{'scaling':>9}")
    for name, row in one["kernels"].items():
        row["scaling"] = most["kernels"][name]["samples_per_second"] / row["samples_per_second"]
        print(f"{name:32}{row['samples_per_second'] / 1e6:12.2f}{row['share_of_floor']:10.0%}{row['scaling']:9.2f}")
    print("  ".join(f"{name} {rate / 1e9:.2f} G/s (x{most['machine'][name] / rate:.2f})" for name, rate in one["machine"].items()))
    if arguments.json:
        report = {
            "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
            "processor": processor(), "cores": len(os.sched_getaffinity(0)), "load_before": load, "load_after": os.getloadavg(),
            "python": platform.python_version(), "versions": {name: version(name) for name in ("torch", "numba", "numpy")}, "threads": found,
        }  # fmt: skip
        arguments.json.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
