"""Seconds of a training step of `paper-n4` in its steady state, and its share of the machine's matrix-product rate.

    python benchmarks/paper_step.py [--json FILE] [--steps 12] [--threads N]

The networks, the 384^3 density voxels, the batch of 1024 rays and Adam are those of the preset. The number of samples on a ray depends on how long a
scene has been trained, so it is set here: density voxels are filled so that about 6 intervals of a ray are valid, and all are pivotal, with 5 fine
samples each. Everything else of a step is included: drawing pixels, rays, both networks forward and backward, compositing, Adam, the occupancy
update.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import statistics
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any

VALID, SIDE, VIEWS = 6.1, 200, 20  # a little more than 6, for it varies from step to step


def settings() -> Any:
    """Those of the preset; samples are pivotal whatever their weight, and no ray is sampled without pruning."""
    import dataclasses

    from workflows import asset
    from workflows.cli.resolve import Settings, read_preset

    resolved = Settings({stage.name: stage.settings for stage in asset.STAGES})
    resolved.put_table(read_preset("paper-n4").table, "paper-n4")
    return dataclasses.replace(resolved.resolved()["train"], occupancy_warmup_steps=0, precrop_steps=0, pivotal_threshold=0.0, max_pivots=4096,
                               occupancy_update_ray_fraction=0.0, occupancy_beta=0.0)  # fmt: skip


def views() -> Any:
    """Pixels of cameras round the box, with random colours."""
    import numpy as np

    from efficientnerf.geometry.cameras import Camera
    from efficientnerf.training.pixels import Pixels

    rng = np.random.default_rng(0)
    cameras, images = [], []
    for n in range(VIEWS):
        a, e = 2.4 * n, 0.6 * np.sin(1.7 * n)
        back = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
        right = np.array([-np.sin(a), np.cos(a), 0.0])
        pose = np.eye(4)
        pose[:3, :4] = np.stack([right, -np.cross(back, right), -back, 4.0 * back], axis=1)
        cameras.append(Camera(f"{n}.png", SIDE, SIDE, "SIMPLE_PINHOLE", (1.39 * SIDE, SIDE / 2, SIDE / 2), pose))
        images.append(rng.integers(0, 256, (SIDE, SIDE, 3), dtype=np.uint8))
    return Pixels(cameras, images, [None] * VIEWS, np.full(VIEWS, 2.0), np.full(VIEWS, 6.0))


def trainer_of(pixels: Any) -> Any:
    """A trainer whose density voxels hold a shell, thick enough for VALID valid samples a ray."""
    import numpy as np
    import torch

    from efficientnerf.geometry.spaces import BoundedSpace
    from efficientnerf.model import model
    from efficientnerf.training.loop import train, trainer

    m = model(BoundedSpace(np.array([[-1.0] * 3, [1.0] * 3])), settings(), (1.0, 1.0, 1.0), "cpu", (2.0, 6.0))
    axis = (torch.arange(m.voxels.side) + 0.5) / m.voxels.side * 2 - 1
    distance = (axis[:, None, None] ** 2 + axis[None, :, None] ** 2 + axis[None, None, :] ** 2).sqrt()
    low, high = 0.0, 0.7
    shell = torch.empty_like(m.voxels.values)
    for _ in range(9):
        middle = (low + high) / 2
        shell.copy_(torch.where((distance < 0.8) & (distance > 0.8 - middle), 1.0, -1.0))
        m.voxels.values.copy_(shell)
        done = next(iter(train(trainer(m), pixels)))
        low, high = (middle, high) if done.valid / done.rays < VALID else (low, middle)
    m.voxels.values.copy_(torch.where((distance < 0.8) & (distance > 0.8 - high), 1.0, -1.0))
    return trainer(m)


def rate(kind: str, size: int = 256, rows: int = 32768) -> float:
    """GFLOP/s of products (rows x size) (size x size), the shape of the networks' layers; the best of several."""
    import torch

    from efficientnerf.backends.torch.linear_chain import product

    a, b = (torch.randn(n, size, generator=torch.Generator().manual_seed(n)).to(getattr(torch, kind)) for n in (rows, size))
    seconds = []
    for _ in range(12):
        begun = time.perf_counter()
        for part in range(0, rows, 4096):
            product(a[part : part + 4096], b, None, False)
        seconds.append(time.perf_counter() - begun)
    return 2 * rows * size * size / min(seconds) / 1e9


def products(field: Any) -> int:
    """Multiplications of one evaluation, forward."""
    return sum(p.numel() for name, p in field.named_parameters() if "weights" in name)


def measure(steps: int) -> dict[str, Any]:
    import torch

    from efficientnerf.backends.torch.linear_chain import precision_of
    from efficientnerf.training.loop import train

    pixels = views()
    t = trainer_of(pixels)
    m = t.model
    running = train(t, pixels)
    for _ in range(2):
        next(running)
    seconds, cpu, valid, fine = [], [], [], []
    for _ in range(steps):
        begun, used = time.perf_counter(), time.process_time()
        done = next(running)
        seconds.append(time.perf_counter() - begun)
        cpu.append(time.process_time() - used)
        valid.append(done.valid)
        fine.append(done.fine)
    rays = m.settings.max_rays_per_batch
    # Forward, and backward for weights and for inputs; the first layer has no gradient for its input.
    flop = sum(2 * n * (3 * products(field) - field.weights[0].numel()) for n, field in ((statistics.mean(valid), m.coarse), (statistics.mean(fine), m.fine)))
    median = statistics.median(seconds)
    return {
        "seconds_per_step": {"median": round(median, 4), "fastest": round(min(seconds), 4), "slowest": round(max(seconds), 4), "steps": steps},
        "cpu_seconds_per_step": round(statistics.median(cpu), 4),
        "rays": rays,
        "samples_per_ray": {"valid": round(statistics.mean(valid) / rays, 2), "fine": round(statistics.mean(fine) / rays, 2)},
        "voxels": m.voxels.side,
        "precision": str(precision_of(m.settings.precision, "cpu")).removeprefix("torch."),
        "gflop_per_step": round(flop / 1e9, 1),
        "gflop_per_second": round(flop / median / 1e9),
        "matrix_products_gflop_per_second": {kind: round(rate(kind)) for kind in ("bfloat16", "float32")},
        "threads": torch.get_num_threads(),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, help="where to write the figures")
    parser.add_argument("--steps", type=int, default=12)
    parser.add_argument("--threads", type=int, default=len(os.sched_getaffinity(0)))
    arguments = parser.parse_args()
    for variable in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS"):
        os.environ[variable] = str(arguments.threads)
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

    import torch

    from workflows.paper.document import hardware

    torch.set_num_threads(arguments.threads)
    figures = measure(arguments.steps)
    figures |= {"date": datetime.date.today().isoformat(), "hardware": hardware("cpu"), "versions": {name: version(name) for name in ("torch", "numba")}}
    print(json.dumps(figures, indent=1))
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
