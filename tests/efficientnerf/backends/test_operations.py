"""Every operation on every backend against the slow loops of `tests/reference.py`: values, and gradients by differences of the loops.

Triton's kernels run on the device where there is one, else on the CPU through its interpreter. A case is as small as crosses every boundary: of a ray, of a
program's lanes, of a chunk of samples, between dense and hashed levels, in and out of the box.
"""

import itertools
import math
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from torch import Tensor

from efficientnerf.backends.dispatch import OPERATIONS, Backend, backend_of, implementation
from efficientnerf.backends.layout import PixelTables
from efficientnerf.backends.torch.hash_grid import HashLevels
from efficientnerf.fields.gradient_buffer import GradientBuffer
from efficientnerf.geometry.spaces import space_from
from efficientnerf.sampling.occupancy import cell_of
from efficientnerf.sampling.samples import Samples
from tests import reference
from tests.efficientnerf.bundles import bundle, in_float32
from tests.efficientnerf.coarse_rays import BOUNDS, STEP, Rays, coarse_samples_of, make_rays, voxels_of
from tests.efficientnerf.steps import RATES, gradients
from tests.efficientnerf.trees import random_tree, rays_at

DEVICE = "cpu"
if find_spec("triton"):
    from tests.efficientnerf.device import DEVICE

Operation = Callable[..., Any]
DIRECTIONS = 4  # along which gradients are compared
STEP_OF_DIFFERENCES = 1e-5


class Case(NamedTuple):
    """call      runs an implementation on tensors: results, differentiable in the inputs that are named
    loop         the same by the loops, from float64 arrays: results
    inputs       float32, of which `differentiable` carry gradients
    atol, rtol   of values; ten times as much of gradients
    """

    call: Callable[..., list[Tensor]]
    loop: Callable[..., list[np.ndarray]]
    inputs: dict[str, Tensor]
    differentiable: tuple[str, ...] = ()
    atol: float = 3e-6
    rtol: float = 1e-4


def placed(case: Case, device: str) -> dict[str, Tensor]:
    """The inputs on a device, as leaves."""
    return {name: t.detach().clone().to(device).requires_grad_(name in case.differentiable) for name, t in case.inputs.items()}


def exact(case: Case) -> dict[str, np.ndarray]:
    return {name: t.numpy().astype(np.float64) if t.is_floating_point() else t.numpy() for name, t in case.inputs.items()}


def mixed(results: list[np.ndarray], towards: list[np.ndarray]) -> float:
    return sum(float((a * b).sum()) for a, b in zip(results, towards, strict=True))


def check(case: Case, operation: Operation, device: str) -> None:
    BUFFERS.clear()  # of earlier tensors, whose places these may have
    inputs = placed(case, device)
    found = case.call(operation, **inputs)
    wanted = case.loop(**exact(case))
    for ours, theirs in zip(found, wanted, strict=True):
        np.testing.assert_allclose(ours.detach().cpu().double().numpy(), theirs, atol=case.atol, rtol=case.rtol)
    if not case.differentiable:
        return
    rng = np.random.default_rng(1)
    towards = [rng.normal(size=w.shape) for w in wanted]
    torch.autograd.backward([t for t in found if t.requires_grad], [torch.from_numpy(w).to(t) for t, w in zip(found, towards, strict=True) if t.requires_grad])
    slopes = [np.zeros_like(w) if not t.requires_grad else w for t, w in zip(found, towards, strict=True)]
    for _ in range(DIRECTIONS):
        along = {name: rng.normal(size=tuple(case.inputs[name].shape)) for name in case.differentiable}
        ends = []
        for sign in (1, -1):
            moved = exact(case)
            for name, direction in along.items():
                moved[name] = moved[name] + sign * STEP_OF_DIFFERENCES * direction
            ends.append(mixed(case.loop(**moved), slopes))
        slope = (ends[0] - ends[1]) / (2 * STEP_OF_DIFFERENCES)
        gradient = {name: gradient_of(inputs[name]).cpu().double().numpy() for name in case.differentiable}
        size = sum(float((gradient[name] ** 2).sum()) for name in along) ** 0.5
        assert mixed([gradient[name] for name in along], list(along.values())) == pytest.approx(slope, rel=10 * case.rtol, abs=10 * case.rtol * size)
        assert size > 0


BUFFERS: dict[int, GradientBuffer] = {}


def gradient_of(t: Tensor) -> Tensor:
    """What autograd has, or the buffer that the operation was given."""
    buffer = BUFFERS.get(t.data_ptr())
    if buffer is not None and buffer.filled:
        assert buffer.values is not None
        return buffer.values
    assert t.grad is not None
    return t.grad


def buffer_for(table: Tensor) -> GradientBuffer:
    BUFFERS[table.data_ptr()] = GradientBuffer()
    return BUFFERS[table.data_ptr()]


def visible_samples_case(activation: str) -> Case:
    """Rays of no sample, of one, and of some that are hidden and none that is; densities depend on the point."""
    counts, least = [0, 1, 9, 40, 0, 6], 1e-2
    draw = np.random.default_rng(7)
    columns = {name: torch.from_numpy(draw.random(size).astype(np.float32)) for name, size in (("start", 56), ("extent", 56), ("point", (56, 3)))}
    inputs = {"first": torch.tensor([0, *np.cumsum(counts)]), "length": torch.from_numpy(draw.uniform(0.1, 0.3, 56).astype(np.float32)), **columns}

    def call(visible_samples: Operation, **columns: Tensor) -> list[Tensor]:
        return list(visible_samples(Samples(**columns, tried=0), lambda points: 6 * points[:, 0] - 3, activation, least)[:5])  # type: ignore[arg-type]

    def loop(first: np.ndarray, **columns: np.ndarray) -> list[np.ndarray]:
        kept, ends = [], [0]
        for begin, end in itertools.pairwise(first):
            left = 1.0
            for n in range(begin, end):
                if left > least:
                    kept.append(n)
                left *= math.exp(-reference.activate(6 * columns["point"][n, 0] - 3, activation) * columns["length"][n])
            ends.append(len(kept))
        return [np.array(ends), *(columns[name][kept] for name in ("start", "extent", "length", "point"))]

    return Case(call, loop, inputs)


def composite_case(activation: str, degree: int) -> Case:
    """Rays of no sample, of one, and of some more than a chunk; one begins with an opaque sample."""
    b = in_float32(bundle(degree, (5, 1, 0, 33, 9, 3)))
    k = (degree + 1) ** 2

    def loop(raw: np.ndarray, length: np.ndarray, first: np.ndarray, harmonics: np.ndarray, background: np.ndarray) -> list[np.ndarray]:
        rays, rgbs = [], np.zeros((len(raw), 3))
        for r in range(len(first) - 1):
            own = slice(first[r], first[r + 1])
            density = [reference.activate(x, activation) for x in raw[own, 0]]
            rgb = [[reference.sigmoid(row[1 + c * k : 1 + (c + 1) * k] @ harmonics[r]) for c in range(3)] for row in raw[own]]
            pixel = reference.composite(density, length[own].tolist(), rgb, background[r].tolist())
            rgbs[own] = np.array(rgb).reshape(-1, 3)
            rays.append((pixel.colour, pixel.opacity, reference.distortion(pixel.weights, length[own].tolist()), pixel.weights))
        return [*(np.array([ray[n] for ray in rays]) for n in range(3)), np.concatenate([ray[3] for ray in rays]), rgbs]

    def call(composite: Operation, **inputs: Tensor) -> list[Tensor]:
        out = composite(**inputs, activation=activation)
        return [*out[:4], out[4].detach()]  # kernels give the samples' colours no gradient

    return Case(call, loop, b._asdict(), ("raw", "background"))


LEVELS = HashLevels(np.array([4, 5, 16]), np.array([True, True, False]), np.array([0, 64, 189]), np.uint32(255))


def hash_network_case(layers: int) -> Case:
    """Points in the cube, on its faces and corners, more than a vector's lanes and no multiple of them. Weights that are the field's shapes; a ReLU may change
    sides where its argument is next to nothing, so gradients are compared less closely."""
    generator, rng = torch.Generator().manual_seed(1), np.random.default_rng(3)
    points = torch.rand(37, 3, generator=generator)
    points[::7] = points[::7].round()
    inputs = {"points": points, "table": torch.randn(189 + 256, 2, generator=generator)}
    levels = (LEVELS.sides.tolist(), LEVELS.dense.tolist(), LEVELS.starts.tolist(), 256)
    shapes = [(16, 6), *[(16, 16)] * (layers - 1), (13, 16)]
    weights = {f"weight{n}": torch.from_numpy((rng.normal(size=shape) * np.sqrt(2 / shape[1])).astype(np.float32)) for n, shape in enumerate(shapes)}

    def call(hash_network: Operation, points: Tensor, table: Tensor, **weights: Tensor) -> list[Tensor]:
        return [hash_network(points, table, LEVELS, list(weights.values()), 0.7, torch.float32, buffer_for(table))]

    def loop(points: np.ndarray, table: np.ndarray, **weights: np.ndarray) -> list[np.ndarray]:
        features = (reference.encode(p, table, *levels) for p in points.tolist())
        return [np.array([reference.relu_network(f, list(weights.values()), 0.7) for f in features])]

    return Case(call, loop, {**inputs, **weights}, ("table", *weights), atol=1e-4, rtol=1e-3)


def adam_case(skip_zeros: bool) -> Case:
    """More entries than a program has, some of them without a gradient after the first step."""
    shape = (650, 2)
    grads = gradients(shape)
    for grad in grads[1:]:
        grad[300:400:2] = 0

    def call(adam: Operation, value: Tensor, **steps: Tensor) -> list[Tensor]:
        first, second = torch.zeros_like(value), torch.zeros_like(value)
        for number, (grad, rate) in enumerate(zip(steps.values(), RATES, strict=True), 1):
            adam(value, grad.clone(), first, second, rate, 0.9, 0.99, 1 - 0.9**number, 1 - 0.99**number, 1e-15, skip_zeros=skip_zeros)
        return [value]

    def loop(value: np.ndarray, **steps: np.ndarray) -> list[np.ndarray]:
        of_entry = np.stack([step.ravel() for step in steps.values()], axis=1).tolist()
        moved = [reference.adam(v, g, RATES, 0.9, 0.99, 1e-15, skip_zeros=skip_zeros) for v, g in zip(value.ravel().tolist(), of_entry, strict=True)]
        return [np.reshape(moved, shape)]

    return Case(call, loop, {"value": torch.linspace(-1, 1, 1300).reshape(shape), **{f"grad{n}": g for n, g in enumerate(grads)}}, atol=2e-6)


def every_kind(count: int = 12) -> Rays:
    """Rays from outside, from inside, past the box, and along the axes."""
    kinds = [make_rays(kind, count) for kind in ("outside", "inside", "missing", "parallel")]
    return Rays(*(torch.cat(columns) for columns in zip(*kinds, strict=True)))


def marched(contracted: bool, threshold: float, rays: dict[str, np.ndarray], voxels: np.ndarray) -> list[reference.March]:
    columns = [rays[name] for name in ("origins", "directions", "near", "far", "offset")]
    return [reference.march(BOUNDS, contracted, *ray, STEP, 60, voxels, threshold) for ray in zip(*columns, strict=True)]


def packed(rays: list[list[tuple]]) -> list[np.ndarray]:
    """first, start, extent, length and point of samples ray by ray."""
    samples = [sample for ray in rays for sample in ray]
    columns = [np.array([sample[n] for sample in samples]) for n in range(4)]
    return [np.cumsum([0, *(len(ray) for ray in rays)]), *columns[:3], columns[3].reshape(-1, 3)]


def valid_samples_case(contracted: bool, threshold: float) -> Case:
    """Without rays of which a decision is so close that rounding may turn it."""
    rays, voxels = every_kind(), voxels_of()
    firm = [m.margin > 1e-4 for m in marched(contracted, threshold, {k: t.double().numpy() for k, t in rays._asdict().items()}, voxels.numpy())]
    assert sum(firm) > 40
    inputs = {name: t[torch.tensor(firm)] for name, t in rays._asdict().items()}

    def call(valid_samples: Operation, voxels: Tensor, **rays: Tensor) -> list[Tensor]:
        found = valid_samples(space_from(BOUNDS, contracted=contracted), *rays.values(), STEP, 60, voxels, threshold)
        return [*found[:5], torch.as_tensor(found.tried)]

    def loop(voxels: np.ndarray, **rays: np.ndarray) -> list[np.ndarray]:
        wanted = marched(contracted, threshold, rays, voxels)
        return [*packed([m.samples for m in wanted]), np.array(sum(m.tried for m in wanted))]

    return Case(call, loop, {"voxels": voxels, **inputs}, atol=2e-5)


def select_pivots_case(most: int) -> Case:
    """Many equal weights; rays of no sample, of as many as are chosen, and of more than a warp has lanes."""
    counts = [0, 4, 12, 1, 7, 0, 37, 0]
    weight = torch.from_numpy(np.round(np.random.default_rng(3).random(sum(counts)), 1).astype(np.float32))
    threshold = float(np.float32(0.3))

    def loop(weight: np.ndarray, first: np.ndarray) -> list[np.ndarray]:
        rays = [weight[a:b].tolist() for a, b in itertools.pairwise(first)]
        return [np.concatenate([reference.select_pivots(ray, threshold, most) for ray in rays]).astype(float)]

    inputs = {"weight": weight, "first": torch.tensor([0, *np.cumsum(counts)])}
    return Case(lambda select, weight, first: [select(weight, first, threshold, most).float()], loop, inputs)


def pivotal_samples_case(contracted: bool, per_pivot: int) -> Case:
    rays = make_rays("inside", 12)
    _, coarse, pivotal = coarse_samples_of(rays, contracted)
    samples = dict(zip(Samples._fields[:5], coarse[:5], strict=True))

    def call(pivotal_samples: Operation, origins: Tensor, directions: Tensor, offset: Tensor, pivotal: Tensor, **samples: Tensor) -> list[Tensor]:
        space = space_from(BOUNDS, contracted=contracted)
        return list(pivotal_samples(space, origins, directions, offset, Samples(**samples, tried=0), pivotal, per_pivot)[:5])  # type: ignore[arg-type]

    def loop(origins: np.ndarray, directions: np.ndarray, offset: np.ndarray, pivotal: np.ndarray, **samples: np.ndarray) -> list[np.ndarray]:
        found, first = [], samples["first"]
        for r, (o, d, shift) in enumerate(zip(origins, directions, offset, strict=True)):
            own = np.arange(first[r], first[r + 1])
            columns = [samples[name][own[pivotal[own]]] for name in ("start", "extent", "length")]
            found.append(reference.pivotal_samples(BOUNDS, contracted, o, d, shift, list(zip(*columns, strict=True)), per_pivot))
        return packed(found)

    inputs = {"origins": rays.origins, "directions": rays.directions, "offset": rays.offset, "pivotal": pivotal, **samples}
    return Case(call, loop, inputs, atol=2e-5)


def update_occupancy_case(activation: str, *, known: bool = False) -> Case:
    """Points beyond the faces, too, and masked voxels; `known`: with the samples' voxels, their points anywhere."""
    rng, side = np.random.default_rng(0), 5
    values = torch.full((side, side, side), 0.4)
    values.view(-1)[::5] = -math.inf
    inputs = {"values": values, "point": torch.from_numpy(rng.uniform(-0.05, 1.05, (1300, 3)).astype(np.float32))}
    inputs["raw"] = torch.from_numpy(rng.normal(size=1300).astype(np.float32) * 3)

    def call(update: Operation, values: Tensor, point: Tensor, raw: Tensor) -> list[Tensor]:
        raised = values.clone()
        cell = cell_of(point, side)
        update(raised, *((point.flip(0), raw, activation, cell) if known else (point, raw, activation)))
        return [raised]

    def loop(values: np.ndarray, point: np.ndarray, raw: np.ndarray) -> list[np.ndarray]:
        i, j, k = np.clip(np.floor(point * side), 0, side - 1).astype(int).T
        wanted = reference.maximum(values.ravel().tolist(), ((i * side + j) * side + k).tolist(), [reference.activate(x, activation) for x in raw])
        return [np.reshape(wanted, values.shape)]

    return Case(call, loop, inputs)


def random_cells_case(valid: int) -> Case:
    """So many valid voxels, some of them drawn twice. Each backend has random numbers of its own; that each cell lies in its part is the same."""
    rng, side, count, threshold = np.random.default_rng(0), 5, 41, 0.5
    values = np.full(side**3, 0.25, np.float32)
    values[rng.permutation(side**3)[:valid]] = 1.0
    half = count - count // 2

    def call(draw: Operation, values: Tensor) -> list[Tensor]:
        cells = draw(values, threshold, count, 7).cpu().long()
        flat = values.view(-1).cpu()
        assert cells.tolist() != draw(values, threshold, count, 8).tolist()
        if not valid:  # a device, whose host does not know their number, draws the second half among all
            assert ((cells >= 0) & (cells < side**3)).all()
            cells = cells[:half]
        rank = torch.cumsum(flat > threshold, dim=0)[cells[half:]] - 1  # among the valid
        return [outside(cells[:half], side**3), flat[cells[half:]] > threshold, outside(rank, valid)]

    def outside(drawn: Tensor, size: int) -> Tensor:
        """How far each of those drawn lies outside of its part of `size`."""
        bounds = torch.arange(len(drawn) + 1) * size
        return drawn - drawn.clamp(bounds[:-1] // max(len(drawn), 1), -(-bounds[1:] // max(len(drawn), 1)) - 1)

    def loop(values: np.ndarray) -> list[np.ndarray]:
        seconds = count - half if valid else 0
        return [np.zeros(half), np.ones(seconds), np.zeros(seconds)]

    return Case(call, loop, {"values": torch.from_numpy(values.reshape(side, side, side))}, atol=0, rtol=0)


def points_in_cells_case() -> Case:
    """Points of all cells lie in them, and are spread evenly over them."""
    side = 7

    def call(draw: Operation, cell: Tensor) -> list[Tensor]:
        points = draw(cell.long(), side, 3)
        assert not torch.equal(points, draw(cell.long(), side, 4))
        within = points.double().cpu() * side % 1
        deciles = torch.stack([torch.histc(within[:, axis], 10, 0, 1) for axis in range(3)]) / len(cell)
        return [cell_of(points.cpu(), side), (deciles - 0.1).abs() > 0.01]

    def loop(cell: np.ndarray) -> list[np.ndarray]:
        return [cell, np.zeros((3, 10))]

    return Case(call, loop, {"cell": torch.arange(side**3).repeat(20).float()}, atol=0, rtol=0)


def scaled_by_distance_case() -> Case:
    """Rays without samples, with samples nearer than the subject, at it and beyond; more rays than a block of the kernel."""
    rng = np.random.default_rng(0)
    counts = rng.integers(0, 4, 70)
    first, samples = np.concatenate([[0], np.cumsum(counts)]), int(counts.sum())
    inputs = {
        "values": torch.from_numpy(rng.normal(size=(samples, 5)).astype(np.float32)), "start": torch.from_numpy(rng.uniform(0, 3, samples).astype(np.float32)),
        "first": torch.from_numpy(first), "subject": torch.from_numpy(rng.choice([1e-12, 0.5, 1.5], 70).astype(np.float32)),
    }  # fmt: skip

    def loop(values: np.ndarray, start: np.ndarray, first: np.ndarray, subject: np.ndarray) -> list[np.ndarray]:
        rays = [r for r in range(len(subject)) for _ in range(first[r], first[r + 1])]
        return [np.array([row * min(at / subject[r], 1) ** 2 for row, at, r in zip(values, start, rays, strict=True)])]

    return Case(lambda operation, **given: [operation(**given)], loop, inputs)


def basis_case(degree: int) -> Case:
    """More directions than a block of the kernel, those along the axes among them."""
    directions = np.random.default_rng(0).normal(size=(700, 3))
    directions[:6] = np.concatenate([np.eye(3), -np.eye(3)])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)

    def loop(directions: np.ndarray) -> list[np.ndarray]:
        return [np.array([reference.harmonics(direction.tolist(), degree) for direction in directions])]

    return Case(lambda basis, directions: [basis(directions, degree)], loop, {"directions": torch.from_numpy(directions.astype(np.float32))}, atol=2e-6)


def sparse_depth_errors_case() -> Case:
    """More aimed rays than a block of the kernel, half of them to a support, some without samples, some whose support is hidden; other rays before them."""
    rng = np.random.default_rng(0)
    counts = rng.integers(0, 9, 150)
    first, samples = np.concatenate([[0], np.cumsum(counts)]), int(counts.sum())
    rays = np.repeat(np.arange(150), counts)
    weight = rng.random(samples) * (0.9 / counts[rays]) * np.where(rays % 5 == 0, 1.1, rng.random(samples))
    inputs = {
        "weight": torch.from_numpy(weight.astype(np.float32)), "start": torch.from_numpy(rng.uniform(0, 3, samples).astype(np.float32)),
        "extent": torch.from_numpy(rng.uniform(0.05, 0.4, samples).astype(np.float32)), "first": torch.from_numpy(first),
        "distance": torch.from_numpy(rng.uniform(0.5, 3.5, 100).astype(np.float32)), "on_support": torch.from_numpy(np.arange(100) >= 50),
    }  # fmt: skip

    def loop(weight: np.ndarray, start: np.ndarray, extent: np.ndarray, first: np.ndarray, distance: np.ndarray, on_support: np.ndarray) -> list[np.ndarray]:
        found = []
        for a, (at, support) in enumerate(zip(distance, on_support, strict=True)):
            own = range(first[50 + a], first[51 + a])
            past = {n: (start[n] + extent[n] / 2 - at) / (2 * extent[n]) for n in own}
            if not support:
                found.append(1 - sum(weight[n] * max(0, 1 - abs(past[n])) for n in own))
                continue
            light = 1 - sum(weight[n] for n in own if past[n] <= -1)
            fixed = 1 - sum(float(inputs["weight"][n]) for n in own if past[n] <= -1)  # the light before it has no gradient
            found.append(max(0, fixed) * (1 - sum(weight[n] for n in own if abs(past[n]) < 1) / max(light, 0.05)))
        return [np.array(found)]

    return Case(lambda operation, **given: [operation(**given, width=2.0)], loop, inputs, ("weight",))


def pixel_rays_case(stride: int) -> Case:
    """Two views of different sizes, every pixel; some rays run so far off the axis that the planes are as of 1e-3."""
    rng = np.random.default_rng(0)
    width, height = np.array([9, 12]), np.array([7, 5])
    knots, rows = -(-(width - 1) // stride) + 1, -(-(height - 1) // stride) + 1
    lookup = rng.normal(size=(int((knots * rows).sum()), 3)) * 0.1 + [0, 0, 1]
    lookup[:9] = rng.normal(size=(9, 3)) * [1, 1, 1e-4]
    tables = {
        "lookup": torch.from_numpy((lookup / np.linalg.norm(lookup, axis=1, keepdims=True)).astype(np.float32)),
        "lens": torch.tensor([0, int(knots[0] * rows[0])]), "knots": torch.from_numpy(knots), "offsets": torch.tensor([0, 63, 123]),
        "width": torch.from_numpy(width),
        "rotation": torch.from_numpy(np.stack([np.linalg.qr(rng.normal(size=(3, 3)))[0] for _ in range(2)]).astype(np.float32)),
        "centre": torch.from_numpy(rng.normal(size=(2, 3)).astype(np.float32)), "near": torch.tensor([0.5, 0.7]), "far": torch.tensor([2.0, 3.0]),
    }  # fmt: skip

    def loop(index: np.ndarray, **tables: np.ndarray) -> list[np.ndarray]:
        found, t = [], PixelTables(**tables)
        for p, v in zip(index, np.searchsorted(t.offsets, index, side="right") - 1, strict=True):
            pixel = int(p - t.offsets[v])
            along = reference.pixel_direction(t.lookup, t.lens[v], t.knots[v], stride, pixel, int(t.width[v]), t.rotation[v])
            along = along if stride == 1 else along / np.linalg.norm(along)
            slant = max(float(along @ t.rotation[v][:, 2]), 1e-3)
            found.append((t.centre[v], along, t.near[v] / slant, t.far[v] / slant))
        return [np.array(column) for column in zip(*found, strict=True)]

    def call(operation: Operation, index: Tensor, **tables: Tensor) -> list[Tensor]:
        return list(operation(PixelTables(**tables), stride, index))

    return Case(call, loop, {**tables, "index": torch.arange(123)})


def tree_rays_case(lookup: str) -> Case:
    """Colour, opacity, and the depth where the opacity is surely above or below a half; rays stop at a transmittance of 1e-3."""
    tree = random_tree(3, brick=3, degree=1, lookup=lookup)
    origins, directions = (torch.from_numpy(a)[torch.arange(40) % 4 != 2] for a in rays_at(tree, 40))  # none along the faces of voxels
    rays = [reference.tree_ray(tree, o, d) for o, d in zip(origins.numpy(), directions.numpy(), strict=True)]
    firm = np.array([abs(opacity - 0.5) > 2e-3 for _, opacity, _ in rays])

    def call(tree_rays: Operation, origins: Tensor, directions: Tensor) -> list[Tensor]:
        tree_ = random_tree(3, brick=3, degree=1, lookup=lookup)
        tree_ = tree_.to(str(origins.device)) if origins.is_cuda else tree_
        colour, opacity, depth, _ = tree_rays(tree_, origins.cpu().numpy(), directions.cpu().numpy(), None, None, None)
        return [torch.from_numpy(part) for part in (colour, opacity, np.nan_to_num(depth[firm], posinf=9.0))]

    def loop(origins: np.ndarray, directions: np.ndarray) -> list[np.ndarray]:
        colour, opacity, depth = (np.array(column) for column in zip(*rays, strict=True))
        return [colour, opacity, np.nan_to_num(depth[firm], posinf=9.0)]

    return Case(call, loop, {"origins": origins, "directions": directions}, atol=2.5e-3)


CASES: dict[str, dict[str, Callable[[], Case]]] = {
    "valid_samples": {
        f"{'contracted' if c else 'box'}-{'valid' if t > 0 else 'all'}": lambda c=c, t=t: valid_samples_case(c, t)  # type: ignore[misc]
        for c in (False, True)
        for t in (0.4, -math.inf)
    },
    "select_pivots": {f"{most}": lambda most=most: select_pivots_case(most) for most in (1, 4, 100)},  # type: ignore[misc]
    "pivotal_samples": {f"{'contracted' if c else 'box'}": lambda c=c: pivotal_samples_case(c, 3) for c in (False, True)},  # type: ignore[misc]
    "visible_samples": {a: lambda a=a: visible_samples_case(a) for a in ("exp", "softplus")},  # type: ignore[misc]
    "composite": {f"{a}-{d}": lambda a=a, d=d: composite_case(a, d) for a, d in (("exp", 0), ("softplus", 1), ("exp", 2))},  # type: ignore[misc]
    "scaled_by_distance": {"": scaled_by_distance_case},
    "basis": {f"{degree}": lambda degree=degree: basis_case(degree) for degree in range(5)},  # type: ignore[misc]
    "sparse_depth_errors": {"": sparse_depth_errors_case},
    "hash_network": {f"{n}": lambda n=n: hash_network_case(n) for n in (1, 2)},  # type: ignore[misc]
    "update_occupancy_maximum": {a: lambda a=a: update_occupancy_case(a) for a in ("exp", "softplus")}  # type: ignore[misc]
    | {"known": lambda: update_occupancy_case("exp", known=True)},
    "random_cells": {f"{valid}": lambda valid=valid: random_cells_case(valid) for valid in (0, 1, 60)},  # type: ignore[misc]
    "points_in_cells": {"": points_in_cells_case},
    "adam": {"dense": lambda: adam_case(False), "sparse": lambda: adam_case(True)},
    "pixel_rays": {"each": lambda: pixel_rays_case(1), "knots": lambda: pixel_rays_case(4)},
    "tree_rays": {lookup: lambda lookup=lookup: tree_rays_case(lookup) for lookup in ("trilinear", "nearest")},  # type: ignore[misc]
}
ALL = [
    pytest.param(name, backend, kind, id=f"{name}-{backend}-{kind}".strip("-"))
    for name, backends in OPERATIONS.items()
    for backend in backends
    for kind in CASES[name]
]


@pytest.mark.parametrize(("name", "backend", "kind"), ALL)
def test_an_operation_is_that_of_the_loops(name: str, backend: Backend, kind: str) -> None:
    if backend == "triton":
        pytest.importorskip("triton", reason="Triton is not installed: pip install triton (Linux, x86-64)")
    check(CASES[name][kind](), implementation(name, backend), DEVICE if backend == "triton" else "cpu")


@pytest.mark.gpu
@pytest.mark.parametrize("name", [name for name, backends in OPERATIONS.items() if "triton" not in backends])
def test_an_operation_without_a_kernel_is_torchs_on_a_device(name: str) -> None:
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    for case in CASES[name].values():
        check(case(), implementation(name, "triton"), "cuda")


def test_the_backend_is_chosen_by_device_and_type() -> None:
    single, double = torch.zeros(2), torch.zeros(2, dtype=torch.float64)
    assert backend_of(single, single) == "numba"
    assert backend_of(single, double) == "torch"
    assert backend_of(torch.zeros(2, device="meta")) == "torch"
    assert implementation("update_occupancy_maximum", "triton") is implementation("update_occupancy_maximum", "torch")


@pytest.mark.parametrize(("name", "differentiable"), [("sparse_depth_errors", "weight"), ("basis", "")])
def test_a_kernel_gives_the_references_bytes(name: str, differentiable: str) -> None:
    for case in CASES[name].values():
        found = []
        for backend in ("torch", "numba"):
            inputs = placed(case(), "cpu")
            values = case().call(implementation(name, backend), **inputs)
            if differentiable:
                sum((value * torch.linspace(-1, 2, value.numel()).reshape(value.shape)).sum() for value in values).backward()  # type: ignore[union-attr]
                values = [*values, gradient_of(inputs[differentiable])]
            found.append(values)
        assert all(torch.equal(a, b) for a, b in zip(*found, strict=True))
