"""Training that does not wait for the device: on the CPU, through Triton's interpreter where it is there, else the bookkeeping alone."""

import traceback
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

import efficientnerf
from efficientnerf.backends import Notice, dispatch, transfer
from efficientnerf.geometry.spaces import space_from
from efficientnerf.model import Model, model
from efficientnerf.rendering import compositing
from efficientnerf.sampling.samples import SampleCapacity, Samples, complete_rays
from efficientnerf.training import loop, readback, step_graphs
from efficientnerf.training.exposure.model import exposure_of
from efficientnerf.training.losses import mean_over
from efficientnerf.training.readback import AsyncReadback
from efficientnerf.training.sparse_depth import SparseDepthRays
from tests.efficientnerf.balls import BOUNDS, cameras, pixels, settings
from tests.efficientnerf.device import DEVICE

PACKAGE = str(Path(efficientnerf.__file__).parent)


def samples(counts: list[int], tried: int = 50, capacity: int | None = None) -> Samples:
    """Of rays with so many samples; with a capacity, those that do not fit are lost."""
    first = torch.tensor([0, *counts]).cumsum(0)
    empty = torch.zeros(int(first[-1]) if capacity is None else capacity)
    complete = None if capacity is None else first[1:] <= capacity
    return Samples(first.clamp(max=len(empty)), empty, empty, empty, torch.zeros(len(empty), 3), tried, complete)


def recorded(kept: AsyncReadback, rays: int, loss: float, coarse: Samples, fine: Samples) -> readback.StepCounts:
    outputs: Any = SimpleNamespace(coarse=coarse, fine=fine, pivotal=torch.ones(len(coarse.start), dtype=torch.bool), fine_opacity=torch.zeros(rays))
    return kept.record(readback.counts_of(torch.tensor(loss), outputs))


def test_counts_arrive_late_once_the_averages_are_known() -> None:
    kept = AsyncReadback(lag=2, exact_steps=3)
    arrived, capacities = [], []
    for step in range(1, 9):
        capacities.append(kept.capacity(4))
        counted = recorded(kept, 4, float(step), samples([step, 0, 0, 0]), samples([2 * step, 0, 0, 0]))
        arrived.append((counted.loss, counted.valid, counted.fine))
    assert [loss for loss, _, _ in arrived] == [1, 2, 2, 2, 3, 4, 5, 6]
    assert all(fine == 2 * valid for _, valid, fine in arrived)
    assert capacities[:3] == [None] * 3
    assert capacities[3] == SampleCapacity(readback.GRANULARITY, readback.GRANULARITY)
    assert kept.fine_per_ray == pytest.approx(2 * kept.valid_per_ray)
    big = kept.capacity(10**6)
    assert big.fine >= readback.MARGIN * kept.fine_per_ray * 10**6 > big.fine - readback.GRANULARITY - 1
    assert kept.capacity(1_050_000) == kept.capacity(900_000) == big  # steps have few different ones
    assert kept.capacity(1_150_000).fine > big.fine > kept.capacity(10**5).fine


def test_rays_whose_samples_do_not_fit_are_left_out() -> None:
    whole = complete_rays(samples([2, 3, 4, 0], capacity=6), samples([1, 1, 1, 0], capacity=10))
    assert whole.tolist() == [True, True, False, False]
    assert complete_rays(samples([2, 4]), samples([2, 4])) is None  # counted, not padded
    one = complete_rays(samples([2, 4]), samples([2, 4], capacity=6))
    assert one.all()  # it is full, and nothing was lost
    values = torch.tensor([[1.0, 3.0], [5.0, 5.0], [float("nan"), 1.0], [1e9, 0.0]], requires_grad=True)
    mean = mean_over(values, whole)
    assert float(mean.detach()) == pytest.approx(3.5)
    mean.backward()
    assert not values.grad[2:].any()
    assert float(mean_over(values.detach()[:2], None)) == 3.5
    assert float(mean_over(values.detach(), torch.zeros(4, dtype=torch.bool))) == 0


def test_rays_that_were_left_out_are_counted_and_the_capacity_grows() -> None:
    """All of a sudden rays have ten times as many samples: what is lost is not known, but how many those have whose samples fit is."""
    kept, left_out = AsyncReadback(lag=0, exact_steps=2, granularity=10), []
    for step in range(40):
        each = 3 if step < 4 else 30
        capacity = kept.capacity(100) or SampleCapacity(3000, 3000)
        found = samples([each] * 100, capacity=capacity.coarse), samples([each] * 100, capacity=capacity.fine)
        left_out.append(recorded(kept, 100, 0.0, *found).left_out)
    assert left_out[:4] == [0] * 4
    assert left_out[4] == 100 - int(1.3 * 300) // 30
    assert left_out[-1] == 0
    assert kept.valid_per_ray == pytest.approx(30, rel=0.2)


PAPER = {
    "field": "mlp", "hidden_dim": 16, "num_layers": 2, "coarse_num_layers": 1, "learning_rate": 3e-3, "occupancy_rule": "momentum",
    "occupancy_initial_density": 0.3, "occupancy_beta": 0.5,
    "occupancy_update_fraction": 0.0, "occupancy_update_ray_fraction": 0.2, "num_importance_samples": 5, "num_coarse_samples": 8,
}  # fmt: skip
# As tables 4 to 6 of the paper have them, and what else there is.
STRATEGIES: dict[str, dict[str, Any]] = {
    "efficient": PAPER,
    "hierarchical": {**PAPER, "sampling": "hierarchical"},
    "uniform": {**PAPER, "sampling": "uniform", "field": "nerf", "near_plane": 1.0, "far_plane": 5.0},
    "hash": {},
    "contracted": {"occupancy_update_ray_fraction": 0.2},
}


EMPTY = -1.0  # what half of the voxels begin with


def model_of(strategy: str, **changes: Any) -> Model:
    """On a device where there is one."""

    wanted = {
        **STRATEGIES[strategy], "sample_batch_size": "off", "max_rays_per_batch": 6, "occupancy_warmup_steps": 1, "occupancy_update_interval": 3,
        "exploration_fraction": 0.0, **changes,
    }  # fmt: skip
    contracted = strategy == "contracted"
    background, span = (None, None) if contracted else ((1.0, 1.0, 1.0), (1.0, 5.0))
    m = model(space_from(BOUNDS, contracted=contracted), settings(**wanted), background, DEVICE, span)
    m.voxels.values[(torch.rand(m.voxels.values.shape, generator=torch.Generator().manual_seed(1)) < 0.5).to(DEVICE)] = EMPTY
    return m


def quick_readback(exact_steps: int = 2) -> AsyncReadback:
    """Steps are padded from the fourth on, two after pruning began."""
    return AsyncReadback(lag=1, exact_steps=exact_steps, granularity=64)


@pytest.fixture
def interpreted(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> None:
    """The path of a device on the CPU: Triton's kernels interpreted."""
    monkeypatch.setattr(dispatch, "triton_usable", lambda: True)
    if DEVICE == "cpu":
        monkeypatch.setattr(dispatch, "backend_of", lambda *tensors: "triton" if all(t.dtype == torch.float32 for t in tensors) else "torch")
        monkeypatch.setitem(dispatch.OPERATIONS["adam"], "triton", "backends.numba.operations")  # its own takes the interpreter long
        monkeypatch.setattr(transfer, "is_on_device", lambda values: True)
        if "contracted" not in request.node.name:  # a program a ray takes the interpreter long; once is enough
            monkeypatch.setattr(dispatch, "composite", compositing.composite)


@pytest.mark.parametrize("strategy", ["efficient", "hash", "contracted"])
def test_padded_steps_learn_what_counted_ones_do_and_no_line_of_them_waits(strategy: str, interpreted: None) -> None:
    """The whole step by the CUDA kernels, interpreted: padded from the fourth step on, and counted exactly. Losses, counts and voxels are the same."""
    steps, voxels, waits = {}, {}, {}
    for exact in (2, 1000):
        m = model_of(strategy, iterations=6)
        steps[exact], waits[exact] = watched(loop.train(loop.trainer(m), pixels(3, 8), readback=quick_readback(exact)))
        voxels[exact] = m.voxels.values
    assert waits[2] == []
    # From the third step on what arrives is the step before.
    for ours, theirs in zip(steps[2], [*steps[1000][:2], *steps[1000][1:-1]], strict=True):
        assert ours.loss == pytest.approx(theirs.loss, rel=1e-3)
        assert (ours.rays, ours.tried, ours.valid, ours.pivotal, ours.fine) == (theirs.rays, theirs.tried, theirs.valid, theirs.pivotal, theirs.fine)
        assert ours.left_out == 0  # all fit
    torch.testing.assert_close(voxels[2], voxels[1000], rtol=1e-3, atol=1e-3)
    whole = STRATEGIES[strategy].get("occupancy_update_ray_fraction", 0) > 0
    if m.prunes:
        assert all(0.3 < step.valid / step.tried < 0.9 for step in steps[2][1:])
        # Only unpruned rays and updates at random cells query pruned voxels.
        assert (voxels[2] != EMPTY).float().mean() > (0.502 if whole else 0.5)


@pytest.mark.parametrize("with_exposure", [False, True])
def test_replayed_steps_are_those_that_are_launched_one_by_one(with_exposure: bool, interpreted: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Inputs and numbers of a step reach one that was recorded; on the CPU a recording is the step itself, on tensors that are filled anew."""
    monkeypatch.setitem(dispatch.OPERATIONS["adam"], "triton", "backends.triton.adam")
    monkeypatch.setattr(dispatch, "composite", compositing.composite)
    ends, replayed = [], []

    def record(run: Callable[[], torch.Tensor], pool: Any) -> Callable[[], torch.Tensor]:
        return lambda: (replayed.append(None), run())[1]

    for graphs in (False, True):
        monkeypatch.setattr(step_graphs, "can_record", lambda device, graphs=graphs: graphs)
        if DEVICE == "cpu":
            monkeypatch.setattr(step_graphs, "record", record)
        m = model_of("contracted" if with_exposure else "hash", iterations=9, exploration_fraction=0.1)
        exposure = exposure_of(cameras(3, 8), device=DEVICE) if with_exposure else None
        losses = [step.loss for step in loop.train(loop.trainer(m, exposure), pixels(3, 8), readback=quick_readback())]
        ends.append((losses, dict(m.parameters()), m.voxels.values))
    assert len(replayed) >= 3 or DEVICE != "cpu"
    np.testing.assert_allclose(ends[1][0], ends[0][0], rtol=1e-5)
    for name, p in ends[0][1].items():
        torch.testing.assert_close(ends[1][1][name], p, rtol=1e-3, atol=1e-4, msg=name)
    torch.testing.assert_close(ends[1][2], ends[0][2], rtol=1e-3, atol=1e-3)


def test_steps_go_on_where_they_cannot_be_recorded(interpreted: None, monkeypatch: pytest.MonkeyPatch) -> None:
    def record(run: Callable[[], torch.Tensor], pool: Any) -> Callable[[], torch.Tensor]:
        raise RuntimeError("no memory for it\nand more")

    monkeypatch.setattr(step_graphs, "can_record", lambda device: True)
    monkeypatch.setattr(step_graphs, "record", record)
    with pytest.warns(Notice, match="no memory for it"):
        done = list(loop.train(loop.trainer(model_of("hash", iterations=8)), pixels(3, 8), readback=quick_readback()))
    assert len(done) == 8


class Waits(TorchDispatchMode):
    """Lines of ours that need a number that a device alone has."""

    ALWAYS = ("_local_scalar_dense", "nonzero", "masked_select", "_unique", "_unique2", "unique_dim", "unique_consecutive", "equal", "bincount")

    def __init__(self) -> None:
        super().__init__()
        self.lines: list[str] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name, kwargs = func._schema.name.removeprefix("aten::"), kwargs or {}
        chosen_by = args[1] if name in ("index", "index_put", "index_put_", "_index_put_impl_") else []
        masked = any(index is not None and index.dtype in (torch.bool, torch.uint8) for index in chosen_by)
        if name in self.ALWAYS or masked or (name == "repeat_interleave" and kwargs.get("output_size") is None):
            ours = [frame for frame in traceback.extract_stack() if frame.filename.startswith(PACKAGE)]
            self.lines.append(f"{name}: {ours[-1].filename.rpartition('/')[2]}:{ours[-1].lineno}")
        return func(*args, **kwargs)


def watched(running: Iterator[loop.Progress]) -> tuple[list[loop.Progress], list[str]]:
    """All steps, and the lines that wait in two of them after the first four."""
    done = [next(running) for _ in range(4)]
    with Waits() as waits:
        done += [next(running) for _ in range(2)]
    return done + list(running), waits.lines


def test_no_line_of_a_step_on_photographs_waits(interpreted: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """With exposures, sparse depth and exploration."""
    monkeypatch.setattr(dispatch, "composite", compositing.composite)
    m = model_of("contracted", iterations=6, exploration_fraction=0.1)
    origins, directions = np.tile(np.float32([[-3.0, 0.1, 0.05]]), (8, 1)), np.tile(np.float32([[1.0, 0, 0]]), (8, 1))
    sparse_depth = SparseDepthRays(origins, directions, np.full(8, 3.0, np.float32), np.zeros(8, bool))
    running = loop.train(loop.trainer(m, exposure_of(cameras(3, 8), device=DEVICE)), pixels(3, 8), sparse_depth, readback=quick_readback())
    assert watched(running)[1] == []


@pytest.mark.gpu
@pytest.mark.parametrize("strategy", STRATEGIES)
def test_no_step_waits_for_the_device(strategy: str) -> None:
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    running = loop.train(loop.trainer(model_of(strategy, iterations=readback.EXACT_STEPS + 20, max_rays_per_batch=64, exploration_fraction=0.1)), pixels(3, 8))
    for _ in range(readback.EXACT_STEPS + 4):
        next(running)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        torch.cuda.set_sync_debug_mode("warn")
        try:
            for _ in range(12):
                next(running)
        finally:
            torch.cuda.set_sync_debug_mode("default")
    assert [f"{w.filename}:{w.lineno}" for w in caught if "called a synchronizing" in str(w.message)] == []
