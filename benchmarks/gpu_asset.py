"""The part *asset* of benchmarks/gpu.py on a synthetic scene: training, bake, refinement, renders; the method alone, without files.

Sizes are arguments, so that the code runs without a device too.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from gpu_kernels import BOUNDS, ball, counted_waits, decibels, orbit, synchronise

from efficientnerf.asset import bake
from efficientnerf.asset.refinement import fit
from efficientnerf.asset.refinement.state import MAX_INITIAL_THICKNESS, RefinementState, initial_state
from efficientnerf.asset.refinement.targets import Targets
from efficientnerf.asset.rendering import render
from efficientnerf.asset.tree import NerfTree, tree_from_voxels
from efficientnerf.geometry.cameras import Camera
from efficientnerf.geometry.spaces import BoundedSpace
from efficientnerf.model import Model, model
from efficientnerf.rendering.field_renderer import FieldRenderer
from efficientnerf.training.loop import train, trainer
from efficientnerf.training.pixels import Pixels
from efficientnerf.training.settings import TrainSettings

WHITE = (1.0, 1.0, 1.0)


class Clock:
    """Seconds of consecutive parts, pending work of the device included."""

    def __init__(self, device: str) -> None:
        self.device = device
        self.seconds: dict[str, float] = {}
        self.last = time.perf_counter()

    def lap(self, name: str) -> None:
        synchronise(self.device)
        now = time.perf_counter()
        self.seconds[name], self.last = round(now - self.last, 3), now


def asset_rates(
    device: str, *, steps: int, side: int, views: int, resolution: int, pixels: int, refine_steps: int, rays: int, **settings: Any
) -> dict[str, Any]:
    """Seconds of each part, refinement steps a second, the lines that waited for the device, and PSNR of a test view."""
    cameras = orbit(side, views + 1)
    test_camera, scene = cameras.pop(views // 2), ball(cameras)
    clock = Clock(device)
    m = model(BoundedSpace(BOUNDS), TrainSettings(iterations=steps, **settings), WHITE, device)
    for _ in train(trainer(m), scene):
        pass
    clock.lap("train")
    tree = baked(m, scene, resolution, pixels)
    clock.lap("bake")
    targets = Targets(scene, WHITE).to(device)
    state = initial_state(tree, MAX_INITIAL_THICKNESS)
    options: dict[str, Any] = {"rays": rays, "density_lr": 0.3, "sh_lr": 0.03, "fall": lambda step: 0.3 ** (step / refine_steps), "seed": 0}
    for _ in fit.optimise(state, targets, until=refine_steps // 4, **options):
        pass
    clock.lap("refine_first_quarter")
    for _ in fit.optimise(state, targets, until=refine_steps, **options):
        pass
    clock.lap("refine")
    steps_per_second = (refine_steps - refine_steps // 4) / clock.seconds["refine"]
    waits = waits_of(state, targets, device, {**options, "until": refine_steps + 32})
    clock.lap("waits")
    weights = fit.max_weights(state.result(), targets, pixels, 0)
    clock.lap("weights")
    errors = [fit.error(each, targets, 2**16, 0) for each in (tree, state.result())]
    clock.lap("errors")
    return {
        "seconds": clock.seconds, "voxels": len(tree.density_values), "voxels_that_show": int((weights > 1e-3).sum()),
        "refine_steps_per_second": round(steps_per_second, 1), "refine_waits_in_32_steps": waits, "refine_on": "device" if targets.on_device else "host",
        "training_psnr": {"baked": decibels(errors[0]), "refined": decibels(errors[1])},
        "test_psnr": test_view_psnr(m, [tree, state.result()], test_camera, device),
    }  # fmt: skip


def baked(m: Model, scene: Pixels, resolution: int, pixels: int) -> NerfTree:
    """The asset of the network, before refinement."""
    shape, voxel = bake.grid_of(BOUNDS, resolution, 4)
    seen = bake.visible_voxels(m, scene, shape, voxel, BOUNDS[0], 4, pixels, lambda done, total: None)
    indices = bake.chosen_voxels(seen, shape, 4, 1e-3, 1)
    parts = list(bake.voxel_values(m, indices, voxel, BOUNDS[0], 4, 0))
    density, sh = (np.concatenate(part) for part in zip(*parts, strict=True))
    return tree_from_voxels(shape, voxel, BOUNDS[0], indices, density, sh, background=WHITE)


def waits_of(state: RefinementState, targets: Targets, device: str, options: dict[str, Any]) -> dict[str, int]:
    """Lines that waited for the device in further steps; the first is left out, which waits by design."""
    running = fit.optimise(state, targets, **options)
    next(running)
    with counted_waits(device) as waits:
        for _ in running:
            pass
    return waits


def test_view_psnr(m: Model, trees: list[NerfTree], camera: Camera, device: str) -> dict[str, float]:
    rgba = ball([camera]).images.reshape(camera.height, camera.width, 4) / 255
    truth = rgba[..., :3] * rgba[..., 3:] + 1 - rgba[..., 3:]
    renders = {"network": FieldRenderer(m, 1.5, 4.5).colour(camera)}
    for name, tree in zip(("baked", "refined"), trees, strict=True):
        renders[name] = render(tree.to(device), camera, background=WHITE).colour
    return {name: decibels(float(((colour - truth) ** 2).mean())) for name, colour in renders.items()}
