"""The parts *kernels*, *renders* and *training* of benchmarks/gpu.py. Sizes are arguments, so that the code runs without a device too."""

from __future__ import annotations

import contextlib
import math
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

from efficientnerf.asset.rendering import render
from efficientnerf.asset.tree import NerfTree, tree_from_voxels
from efficientnerf.geometry.cameras import Camera, rays
from efficientnerf.geometry.spaces import BoundedSpace
from efficientnerf.model import model
from efficientnerf.training.pixels import Pixels
from efficientnerf.training.settings import TrainSettings
from tests.poses import looking_at

BOUNDS = np.array([[-1.0] * 3, [1.0] * 3])


def milliseconds(run: Callable[[], Any], device: str, repeats: int) -> float:
    """Median time of a call on the device, after three calls that build and warm up."""
    for _ in range(3):
        run()
    taken = []
    for _ in range(repeats):
        if device == "cuda":
            begin, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
            begin.record()
            run()
            end.record()
            end.synchronize()
            taken.append(begin.elapsed_time(end))
        else:
            started = time.perf_counter()
            run()
            taken.append(1e3 * (time.perf_counter() - started))
    return float(np.median(taken))


def synchronise(device: str) -> None:
    """Wait until the device has done all that it was given."""
    if device == "cuda":
        torch.cuda.synchronize()


@contextlib.contextmanager
def counted_waits(device: str) -> Iterator[dict[str, int]]:
    """File and line -> how often the host waited there for the device; filled in at the end."""
    found: dict[str, int] = {}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        if device == "cuda":
            torch.cuda.set_sync_debug_mode("warn")
        yield found
        if device == "cuda":
            torch.cuda.set_sync_debug_mode("default")
    found.update(Counter(f"{Path(w.filename).name}:{w.lineno}" for w in caught if "called a synchronizing" in str(w.message)))


def copy_rate(device: str, mebibytes: int, repeats: int) -> float:
    """GB/s read and written by a copy within the device's memory."""
    source = torch.zeros(mebibytes * 2**18, device=device)
    target = torch.empty_like(source)
    return 2 * source.numel() * 4 / 1e6 / milliseconds(lambda: target.copy_(source), device, repeats)


def kernel_rates(device: str, rays_: int, log2_table: int, repeats: int) -> dict[str, dict[str, float]]:
    """Each kernel of a step at the sizes of a bundle of `rays_` rays: milliseconds, samples a second, and bytes moved at least over that time."""
    from efficientnerf.backends.triton import adam, compositing, hash_grid, sampling
    from efficientnerf.rendering.harmonics import basis

    generator = torch.Generator().manual_seed(0)
    m = model(BoundedSpace(BOUNDS), TrainSettings(num_levels=16, log2_hashmap_size=log2_table, finest_resolution=2048), (1.0, 1.0, 1.0), device)
    side = m.voxels.side
    centre = (torch.stack(torch.meshgrid(*[torch.arange(side)] * 3, indexing="ij"), -1) + 0.5) / side * 2 - 1
    voxels = ((centre.norm(dim=-1) - 0.7).abs() < 0.08).float().to(device)  # a shell
    outward = torch.nn.functional.normalize(torch.randn(rays_, 3, generator=generator), dim=-1)
    target = torch.rand(rays_, 3, generator=generator) * 1.6 - 0.8
    directions = torch.nn.functional.normalize(target - 3 * outward, dim=-1).to(device)
    origins = (3 * outward).to(device)
    near, far, offset = (torch.full((rays_,), x, device=device) for x in (1.0, 6.0, 0.5))
    march = (m.space, origins, directions, near, far, offset, m.step, m.max_intervals, voxels, 0.5)
    coarse = sampling.valid_samples(*march)
    count = len(coarse.start)
    weight = torch.rand(count, generator=generator).to(device)
    pivotal = sampling.select_pivots(weight, coarse.first, 1e-4, 8)
    fine = sampling.pivotal_samples(m.space, origins, directions, offset, coarse, pivotal, 2)
    samples = len(fine.start)
    field: Any = m.fine
    table, levels = field.table, len(field.hash_levels.sides)
    encode = lambda: hash_grid.encode(fine.point, table, field.hash_levels)  # noqa: E731
    features = encode()
    grad_features = torch.randn(features.shape, generator=generator).to(device)
    raw = torch.randn(samples, 28, generator=generator).to(device).requires_grad_()
    harmonics, background = basis(directions, 2), torch.ones(rays_, 3, device=device)
    composite = lambda: compositing.composite(raw, fine.length, fine.first, harmonics, background, "exp")  # noqa: E731
    colour = composite().colour
    grad, first, second = (torch.randn(table.shape, generator=generator).to(device) for _ in range(3))
    grad[torch.rand(len(table), generator=generator).to(device) < 0.5] = 0
    second = second.abs()
    value = table.detach().clone()
    corner = 8 * levels * 8.0  # bytes of the table that a sample reads, two features of 4 bytes at 8 corners of each level
    capacity = math.ceil(1.3 * count / 4096) * 4096
    jobs: list[tuple[str, Callable[[], Any], int, float]] = [
        ("march", lambda: sampling.valid_samples(*march, capacity=capacity), count, 32.0),
        ("pivots", lambda: sampling.select_pivots(weight, coarse.first, 1e-4, 8), count, 5.0),
        ("pivotal_samples", lambda: sampling.pivotal_samples(m.space, origins, directions, offset, coarse, pivotal, 2, 2 * capacity), samples, 32.0),
        ("encode", encode, samples, 12 + corner + 8 * levels),
        ("encode_backward", lambda: torch.autograd.grad(features, table, grad_features, retain_graph=True), samples, 12 + 2 * corner + 8 * levels),
        ("composite", composite, samples, 28 * 4 + 4 + 16.0),
        ("composite_backward", lambda: torch.autograd.grad(colour.sum(), raw, retain_graph=True), samples, 2 * 28 * 4 + 4 + 16.0),
        ("adam", lambda: adam.adam(value, grad, first, second, 0.01, 0.9, 0.99, 0.5, 0.5, 1e-15, skip_zeros=True), table.numel(), 4 + 24 / 2.0),
    ]
    out = {}
    for name, run, items, each in jobs:
        took = milliseconds(run, device, repeats)
        out[name] = {"ms": round(took, 4), "items": items, "items_per_second": items / took * 1e3, "gb_per_second": round(items * each / took / 1e6, 1)}
    return out


def shell(resolution: int, degree: int = 2) -> NerfTree:
    """A bumpy shell with soft edges, with about as many voxels as an object of that size."""
    side = resolution // 4 * 4
    kept = []
    for x in range(side):
        y, z = np.meshgrid(np.arange(side), np.arange(side), indexing="ij")
        p = (np.stack([np.full_like(y, x), y, z], -1) + 0.5) / side * 2 - 1
        radius = np.linalg.norm(p, axis=-1)
        off = np.abs(radius - 0.7 - 0.05 * np.sin(9 * p).prod(-1)) * side / 2
        at = np.argwhere(off < 2.5)
        kept.append(np.concatenate([np.full((len(at), 1), x), at, off[tuple(at.T)][:, None]], axis=1))
    found = np.concatenate(kept)
    density = (60.0 * np.exp(-(found[:, 3] ** 2) / 2)).astype(np.float32)
    sh = np.random.default_rng(0).normal(size=(len(found), (degree + 1) ** 2, 3)).astype(np.float32)
    return tree_from_voxels((side // 4,) * 3, 2.0 / side, np.full(3, -1.0), found[:, :3].astype(np.int64), density, sh)


def orbit(side: int, frames: int) -> list[Camera]:
    out = []
    for n in range(frames):
        azimuth, elevation = 2 * math.pi * n / frames, 0.4
        back = np.array([math.cos(elevation) * math.cos(azimuth), math.cos(elevation) * math.sin(azimuth), math.sin(elevation)])
        out.append(Camera(f"v{n:03}", side, side, "SIMPLE_PINHOLE", (1.4 * side, side / 2, side / 2), looking_at(3 * back)))
    return out


def frame_rates(device: str, tree: NerfTree, side: int, repeats: int) -> dict[str, Any]:
    """Milliseconds of a render of side x side pixels, mean over an orbit; and its difference from the CPU's."""
    from efficientnerf.backends.triton import tree as cuda_tree

    on_device = cuda_tree.device_tree(tree, device)
    cameras = orbit(side, 8)
    took = milliseconds(lambda: [cuda_tree.render_image(on_device, c, background=(1.0, 1.0, 1.0)) for c in cameras], device, repeats) / len(cameras)
    ours = cuda_tree.render_image(on_device, cameras[0]).colour.cpu().numpy()
    off = np.abs(ours - render(tree, cameras[0]).colour).max(axis=-1)
    return {
        "pixels": [side, side], "voxels": len(tree.density_values), "bytes_on_device": on_device.bytes, "ms": round(took, 4),
        "frames_per_second": round(1e3 / took, 1),
        "difference_from_cpu": {"mean": float(off.mean()), "share_above_1e-3": float((off > 1e-3).mean()), "largest": float(off.max())},
    }  # fmt: skip


def splat_rates(device: str, count: int, side: int, repeats: int) -> dict[str, float]:
    """Milliseconds of an image of `count` Gaussians on a sphere, and of a step of their fit; of a step on the CPU too."""
    from efficientnerf.backends.numba.splats.fit import SplatFit as HostFit
    from efficientnerf.backends.splat_layout import GRADIENTS, Picture
    from efficientnerf.backends.triton.splats.fit import SplatFit, splat_image
    from efficientnerf.splats.refit import HUBER_DELTA, STRUCTURE, rates_of
    from efficientnerf.splats.rendering import lens_of

    rng = np.random.default_rng(0)
    rows = rng.normal(0, 0.2, (count, 11 + 27)).astype(np.float32)
    rows[:, :3] *= 0.7 / np.linalg.norm(rows[:, :3], axis=1, keepdims=True)
    rows[:, 3:6] += np.log(1.5 / count**0.5)
    pixels, limits = rng.integers(0, 256, (side, side, 4), np.uint8), map(np.float32, (STRUCTURE, HUBER_DELTA))
    picture = Picture(pixels, np.ones((side, side), np.uint8), True, np.zeros(3, np.float32), *limits)
    lens, moments = lens_of(orbit(side, 1)[0]), np.zeros((count, GRADIENTS + rows.shape[1]), np.float32)
    fits = SplatFit(rows, moments, 2, device), HostFit(rows, moments, 2)
    took = {"image": milliseconds(lambda: splat_image(rows, 2, lens, device), device, repeats)}
    for name, fit in zip(("step", "step_on_cpu"), fits, strict=True):
        took[name] = milliseconds(lambda fit=fit: fit.step(lens, picture, rates_of(0.5, 0.004)), device, repeats)  # type: ignore[misc]
    return {name: round(each, 2) for name, each in took.items()}


def ball(cameras: list[Camera]) -> Pixels:
    """Images of a chequered ball with alpha."""
    images = []
    for camera in cameras:
        origins, directions = rays(camera)
        middle = -(origins * directions).sum(-1)
        chord = np.sqrt(np.maximum(0.49 - (origins**2).sum(-1) + middle**2, 0))
        hit = origins + (middle - chord)[:, None] * directions
        chequer = ((np.floor(hit * 8).sum(-1) % 2) * 0.4 + 0.3)[:, None] + 0.3 * hit
        rgba = np.concatenate([np.clip(chequer, 0, 1), (chord > 0)[:, None]], axis=1)
        images.append(np.round(255 * rgba).astype(np.uint8).reshape(camera.height, camera.width, 4))
    count = len(cameras)
    return Pixels(cameras, images, [None] * count, np.full(count, 1.5), np.full(count, 4.5))


def decibels(error: float) -> float:
    return round(-10 * math.log10(max(error, 1e-10)), 2)


def training_rates(device: str, steps: int, side: int, views: int, **settings: Any) -> dict[str, Any]:
    """Steps and samples a second on the ball, the second half of the steps timed; and which lines waited for the device in 32 further steps."""
    from efficientnerf.training.loop import train, trainer

    s = TrainSettings(**{**settings, "iterations": steps + 32})
    pixels = ball(orbit(side, views))
    t = trainer(model(BoundedSpace(BOUNDS), s, (1.0, 1.0, 1.0), device, (float(pixels.near[0]), float(pixels.far[0]))))
    running = train(t, pixels)
    samples, started, done = 0, 0.0, None
    for number in range(steps):
        done = next(running)
        if number == steps // 2:
            synchronise(device)
            started, samples = time.perf_counter(), 0
        samples += done.fine + done.valid
    synchronise(device)
    took = time.perf_counter() - started
    with counted_waits(device) as waits:
        left_out = sum(next(running).left_out for _ in range(32))
    timed = steps - steps // 2 - 1
    assert done is not None
    return {
        "steps_per_second": round(timed / took, 1), "samples_per_second": round(samples / took),
        "psnr": decibels(done.loss), "rays": done.rays, "waits_in_32_steps": waits, "rays_left_out_in_32_steps": left_out,
    }  # fmt: skip
