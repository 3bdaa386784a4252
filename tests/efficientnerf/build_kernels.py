"""Calls every function of the CUDA kernels with small tensors, and where it would launch a kernel builds it for devices that need not be there.

    python -m tests.efficientnerf.build_kernels

The first variant of a kernel is built for each generation, others for the last. A line for each: name, constants, registers a thread, bytes of stack
(what does not fit the registers).
"""

import re
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource
from triton.runtime.jit import JITFunction

GENERATIONS = (80, 90)  # compute capability: A100 and RTX 30 run code for 8.0, H100 and H200 that for 9.0
DEGREES = (0, 2, 4)  # of harmonics: none, the usual, the most
TYPES = {
    torch.float32: "*fp32", torch.float16: "*fp16", torch.int64: "*i64", torch.int32: "*i32", torch.int8: "*i8", torch.uint8: "*u8", torch.bool: "*i1",
}  # fmt: skip
DUMP = Path(triton.__file__).parent / "backends" / "nvidia" / "bin" / "cuobjdump"
seen: set[str] = set()
names: set[str] = set()


def resources(cubin: bytes) -> tuple[int, int]:
    """Registers a thread and bytes of stack."""
    with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
        file.write(cubin)
        file.flush()
        said = subprocess.run([DUMP, "-res-usage", file.name], capture_output=True, text=True, check=True).stdout
    found = re.search(r"REG:(\d+) STACK:(\d+)", said)
    assert found is not None, said
    return int(found[1]), int(found[2])


def build(self: JITFunction, *args: Any, grid: Any, warmup: bool, num_warps: int = 4, **kwargs: Any) -> None:
    """Stands for `JITFunction.run`."""
    given = dict(zip(self.arg_names, args, strict=False)) | kwargs
    constants = {p.name: given[p.name] for p in self.params if p.is_constexpr}
    attributes: dict[tuple[int, ...], Any] = {}

    def kind(value: Any, *place: int) -> Any:
        if isinstance(value, tuple):
            kinds = [kind(part, *place, n) for n, part in enumerate(value)]
            return type(value)(*kinds) if hasattr(value, "_fields") else tuple(kinds)
        if isinstance(value, torch.Tensor):
            attributes[place] = [["tt.divisibility", 16]]  # as the allocator gives them
            return TYPES[value.dtype]
        return "fp32" if isinstance(value, float) else "i32"

    signature = {name: "constexpr" if name in constants else kind(given[name], place) for place, name in enumerate(self.arg_names)}
    key = f"{self.__name__} {constants} {signature}"
    if key in seen:
        return
    seen.add(key)
    generations = GENERATIONS[-1:] if self.__name__ in names else GENERATIONS
    names.add(self.__name__)
    for generation in generations:
        source = ASTSource(fn=self, signature=signature, constexprs=constants, attrs=attributes)
        made = triton.compile(source, target=GPUTarget("cuda", generation, 32), options={"num_warps": num_warps})
        registers, stack = resources(made.asm["cubin"])
        print(f"{self.__name__} {constants} sm_{generation}: registers {registers}, spilled {stack}", flush=True)


def training_step() -> None:
    from efficientnerf.backends.torch.hash_grid import HashLevels
    from efficientnerf.backends.triton import adam, compositing, hash_grid, sampling
    from efficientnerf.geometry.spaces import space_from

    levels = HashLevels(np.array([4, 64]), np.array([True, False]), np.array([0, 64]), np.uint32(255))
    table = torch.zeros(1000, 2, requires_grad=True)
    hash_grid.encode(torch.zeros(8, 3), table, levels).sum().backward()
    for skip_zeros in (False, True):
        adam.adam(*(torch.zeros(64) for _ in range(4)), 0.1, 0.9, 0.99, 1.0, 1.0, 1e-15, skip_zeros=skip_zeros)
    for contracted in (False, True):
        space = space_from(np.array([[-1.0] * 3, [1.0] * 3]), contracted=contracted)
        rays = (torch.zeros(8, 3), torch.ones(8, 3), torch.zeros(8), torch.ones(8), torch.zeros(8))
        found = sampling.valid_samples(space, *rays, 0.1, 4, torch.ones(4, 4, 4), 0.0, capacity=32)
        pivotal = sampling.select_pivots(found.start, found.first, 0.1, 4)
        sampling.pivotal_samples(space, rays[0], rays[1], rays[4], found, pivotal, 2, capacity=64)
    for terms in (1, 9, 25):
        for activation in ("exp", "softplus"):
            raw, background = torch.zeros(32, 1 + 3 * terms, requires_grad=True), torch.ones(8, 3)
            out = compositing.composite(raw, torch.ones(32), torch.zeros(9, dtype=torch.int64), torch.ones(8, terms), background, activation)
            out.colour.sum().backward()


def images() -> None:
    from efficientnerf.backends.triton import tree as cuda_tree
    from efficientnerf.geometry.cameras import Camera
    from tests.efficientnerf.trees import random_cascades, random_tree

    camera = Camera("view", 8, 8, "SIMPLE_PINHOLE", (8.0, 4.0, 4.0), np.eye(4))
    for degree in DEGREES:
        tree = cuda_tree.device_tree(random_tree(0, degree=degree, brick=4), "cpu")
        cuda_tree.render_image(tree, camera, background=(1.0, 1.0, 1.0))
        if degree == 2:
            cuda_tree.render_image(cuda_tree.device_tree(random_tree(0, degree=degree, brick=4, lookup="nearest"), "cpu"), camera)
            cuda_tree.render_rays(tree, torch.zeros(8, 3), torch.ones(8, 3))
            cuda_tree.render_image(cuda_tree.device_tree(random_cascades(0, degree=degree, brick=4), "cpu"), camera)


def fit() -> None:
    from efficientnerf.backends.layout import Hyperparameters, Moments
    from efficientnerf.backends.triton import tree_gradients, tree_steps
    from tests.efficientnerf.trees import random_cascades, random_tree

    rays = tree_gradients.Rays(torch.zeros(8, 3), torch.ones(8, 3), torch.ones(8, 3))
    trees = [random_tree(0, degree=degree, brick=4) for degree in DEGREES]
    for tree in [*trees, random_tree(0, degree=2, brick=4, lookup="nearest"), random_cascades(0, degree=2, brick=4)]:
        g, count, width = tree_gradients.device_grid(tree, "cpu"), len(tree.density_values), 3 * tree.harmonics_count
        values, squares = (torch.zeros(count), torch.zeros(count, width)), (torch.zeros(count), torch.zeros(count))
        sums = torch.zeros(count, dtype=torch.int64), torch.zeros(count, width, dtype=torch.int64)
        visits, stamp = torch.zeros(count, dtype=torch.int32), torch.zeros(count, dtype=torch.int32)
        outputs = tree_gradients.forward(g, rays, *values)
        tree_gradients.backward(g, rays, *values, outputs, (outputs[0], outputs[1]), sums, stamp, 7)
        tree_gradients.max_contributions(g, rays, values[0], outputs[1], squares[0])
        for total_variation in (0.0, 0.1):
            rule = Hyperparameters(0.1, 0.1, 0.5, 0.9, 1e-10, total_variation=total_variation)
            neighbours = tree_steps.Neighbours(torch.zeros(count), torch.zeros(count, 6, dtype=torch.int32))
            tree_steps.step(g, values, sums, Moments(*squares, visits), stamp, rule, neighbours, number=7, rays=8)


def splats() -> None:
    from efficientnerf.backends.splat_layout import GRADIENTS
    from efficientnerf.backends.triton.splats import fit as cuda_splats
    from efficientnerf.splats.refit import rates_of
    from efficientnerf.splats.rendering import lens_of, values_of
    from tests.efficientnerf.splats_reference import LENSES, camera, picture_of, some_gaussians

    for degree, over_all, (model, extra) in ((2, True, LENSES[0]), (0, False, LENSES[0]), (3, True, LENSES[2])):
        rows, lens = values_of(some_gaussians(8, degree)), lens_of(camera(model, extra))
        cuda_splats.splat_image(rows, degree, lens, "cpu")
        fit = cuda_splats.SplatFit(rows, np.zeros((8, GRADIENTS + rows.shape[1]), np.float32), degree, "cpu")
        fit.step(lens, picture_of(0, over_all), rates_of(0.0, 0.1))


if __name__ == "__main__":
    JITFunction.run = build
    splats()
    fit()
    training_step()
    images()
