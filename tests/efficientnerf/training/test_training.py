"""Training on an analytic ball: it learns, does not collapse, repeats, and goes on where it was."""

import itertools
import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from efficientnerf.backends import transfer
from efficientnerf.backends.transfer import sent
from efficientnerf.model import Model, render_rays
from efficientnerf.sampling.occupancy import mask_cells
from efficientnerf.training.loop import Progress, Trainer, restore, state_of, train, trainer
from efficientnerf.training.optimiser import Adam, parameter_groups
from efficientnerf.training.pixels import Pixels
from efficientnerf.training.schedule import Schedule, schedule_of
from efficientnerf.training.sparse_depth import AimedRays, SparseDepthRays, aimed_rays, sparse_depth_loss
from tests.efficientnerf.balls import cameras, photograph, pixels, untrained

MLP = {"field": "mlp", "hidden_dim": 24, "num_layers": 2, "coarse_num_layers": 1, "learning_rate": 1e-2}


def run(m: Model, which: Pixels | None = None) -> list[Progress]:
    """The learning rate rises in a few steps."""
    return list(train(trainer(m, schedule=replace(schedule_of(m.settings), ramp_steps=10)), which or pixels()))


def psnr_of(steps: list[Progress]) -> float:
    return -10 * math.log10(np.mean([step.loss for step in steps]))


@pytest.mark.parametrize(("field", "rule"), [("hash", "momentum"), ("hash", "maximum"), ("mlp", "maximum")])
def test_it_learns(field: str, rule: str) -> None:
    m = untrained(occupancy_rule=rule, **(dict(MLP, iterations=40) if field == "mlp" else {}))
    steps = run(m)
    assert psnr_of(steps[-10:]) > psnr_of(steps[:5]) + (2 if field == "hash" else 1)
    assert [step.step for step in steps] == list(range(1, m.settings.iterations + 1))
    assert all(step.fine == m.settings.samples_per_pivot * step.pivotal and step.pivotal <= step.valid <= step.tried for step in steps)
    for step in steps[: m.settings.occupancy_warmup_steps]:
        assert step.valid == step.tried  # nothing is pruned in the warm-up


def test_unbounded_scenes_are_learned_too() -> None:
    made = cameras()
    photographs = Pixels(made, [photograph(camera) for camera in made], [None] * len(made), np.full(len(made), 1.0), np.full(len(made), 50.0))
    steps = run(untrained(contracted=True), photographs)
    assert psnr_of(steps[-10:]) > psnr_of(steps[:5]) + 2


@pytest.mark.parametrize("field", ["hash", "mlp"])
def test_a_thin_white_scene_does_not_collapse_to_its_background(field: str) -> None:
    """A ball of a few pixels on white: seeing nothing at all is a good guess, and the wrong one."""
    m = untrained(iterations=80, **(MLP if field == "mlp" else {}))
    thin = pixels(8, 20, 0.25)
    run(m, thin)
    origins, directions, near, far = (torch.from_numpy(a) for a in thin.bundle(np.arange(len(thin)))[:4])
    with torch.no_grad():
        opacity = render_rays(m, origins, directions, near, far, torch.full_like(near, 0.5), torch.ones(len(thin), 3)).fine_opacity.numpy()
    on_ball = thin.images[:, 3] > 200
    assert 0 < on_ball.mean() < 0.06
    if field == "hash":
        assert opacity[on_ball].mean() > opacity[~on_ball].mean() + 0.2
    else:  # a network needs longer, but is on its way
        assert opacity[on_ball].mean() > 2 * opacity[~on_ball].mean()
    assert m.voxels.occupied > 0


def test_two_runs_give_the_same_bytes_and_another_seed_others() -> None:
    states = []
    for seed in (3, 3, 4):
        t = trainer(untrained(iterations=12, occupancy_warmup_steps=4, seed=seed))
        list(train(t, pixels()))
        states.append({name: tensor.numpy().tobytes() for name, tensor in state_of(t).items()})
    assert states[0] == states[1]
    assert states[0] != states[2]


@pytest.mark.parametrize(("field", "at"), [("hash", 1), ("hash", 7), ("mlp", 4)])
def test_a_restored_trainer_goes_on_to_the_same_bytes(field: str, at: int) -> None:
    changes = dict(MLP if field == "mlp" else {}, iterations=10, occupancy_warmup_steps=5, sample_batch_size=2048)
    whole = trainer(untrained(**changes))
    kept = {}
    for done in train(whole, pixels()):
        if done.step == at:
            kept = {name: tensor.clone() for name, tensor in state_of(whole).items()}
    resumed = trainer(untrained(**changes))
    restore(resumed, kept)
    assert resumed.step == at
    rest = list(train(resumed, pixels()))
    assert len(rest) == 10 - at
    for name, tensor in state_of(whole).items():
        assert torch.equal(tensor, state_of(resumed)[name]), name


def test_voxels_that_are_closed_at_first_open_after_a_quarter_of_the_steps() -> None:
    def begun() -> Trainer:
        m = untrained(iterations=12, occupancy_warmup_steps=5, sample_batch_size=2048)
        closed = torch.zeros_like(m.voxels.values, dtype=torch.bool)
        closed[:, : m.voxels.side // 2] = True
        for_good = torch.zeros_like(closed)
        for_good[:, :, :4] = True
        mask_cells(m.voxels, for_good)
        return trainer(m, closed=closed)

    whole, masked, kept = begun(), [], {}
    half = torch.isneginf(whole.model.voxels.values)
    for done in train(whole, pixels()):
        masked.append(torch.isneginf(whole.model.voxels.values))
        kept[done.step] = {name: tensor.clone() for name, tensor in state_of(whole).items()}
    assert all(torch.equal(now, half) for now in masked[:2])
    assert half[:, : half.shape[1] // 2].all()
    for now in masked[2:]:  # those of the first row of blocks stay masked
        assert now[:, :, :4].all()
        assert not now[:, :, 4:].any()
    for at in (2, 3, 7):
        resumed = begun()
        restore(resumed, kept[at])
        list(train(resumed, pixels()))
        for name, tensor in kept[12].items():
            assert torch.equal(tensor, state_of(resumed)[name]), name


def test_transparent_pixels_teach_no_colour() -> None:
    """The colour under alpha 0 is anything; it must not be seen."""
    some = pixels()
    other = pixels()
    hidden = other.images[:, 3] == 0
    other.images[hidden, :3] = 77
    assert hidden.any()
    losses = [[step.loss for step in train(trainer(untrained(iterations=5)), p)] for p in (some, other)]
    assert losses[0] == losses[1]


def test_sparse_depth_gathers_the_weight_at_its_points() -> None:
    m = untrained(contracted=True)
    origins = np.tile(np.float32([[-3.0, 0.1, 0.05]]), (4, 1))
    directions = np.float32([[1, 0, 0], [0.995, 0.0998, 0], [0.995, 0, 0.0998], [0.995, -0.0998, 0]])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    rays = SparseDepthRays(origins, directions, np.full(4, 3.0, np.float32), np.zeros(4, bool))
    adam = Adam(parameter_groups(m))
    losses = []
    for step in range(1, 41):
        rng = np.random.default_rng(step)
        aimed = sent(aimed_rays(rays, 16, rng), m.device)
        outputs = render_rays(m, *aimed.bundle, prune=False, rng=rng)
        loss = sparse_depth_loss(outputs, aimed.distance, aimed.on_support, m.settings.samples_per_pivot, None)
        loss.backward()
        adam.step(adam.step_size(step, 3e-2))
        losses.append(float(loss.detach()))
    assert 1.5 < losses[0] <= 2
    assert losses[-1] < 1.2


def test_a_support_becomes_opaque_and_what_stands_before_it_stays() -> None:
    """Gradients in closed form: none of densities before the support or behind it, and none at all where something hides it."""
    start, extent, at = torch.arange(10) / 10, torch.full((10,), 0.1), torch.tensor([0.56])

    def gradient(before: float, on_support: bool) -> tuple[float, torch.Tensor]:
        alpha = torch.tensor([0.0, before, 0, 0, 0.2, 0.3, 0.1, 0, 0.4, 0.5], requires_grad=True)
        weight = alpha * torch.cumprod(torch.cat([torch.ones(1), 1 - alpha[:-1]]), 0)
        samples = SimpleNamespace(start=start, extent=extent, first=torch.tensor([0, 10]))
        rays = SimpleNamespace(near=torch.zeros(1), last=lambda count: SimpleNamespace(frame_distance=lambda distance: distance))
        outputs: Any = SimpleNamespace(coarse=samples, fine=samples, coarse_weight=weight, fine_weight=weight, rays=rays)
        loss = sparse_depth_loss(outputs, at, torch.tensor([on_support]), 1, None)
        return float(loss.detach()), torch.autograd.grad(loss, alpha)[0]

    loss, of_support = gradient(0.6, True)
    assert 0 < loss < 2 * 0.4
    assert of_support[[0, 1, 2, 3, 8, 9]].abs().max() < 1e-6
    assert (of_support[4:8] < 0).all()
    assert gradient(0.6, False)[1][1] > 0, "a floater before a sparse point"
    hidden, none = gradient(1.0, True)
    assert hidden == 0
    assert none.abs().max() < 1e-6


@pytest.mark.parametrize("complete", [False, True])
def test_rays_to_sparse_points_count_alone_though_others_come_first(complete: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Loss and gradient are those of a bundle of their own; also on a device, which looks at the samples of all rays."""
    m = untrained(contracted=True)
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(30, 3)).astype(np.float32)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    rays = SparseDepthRays(-3 * directions, directions, rng.uniform(2, 4, 30).astype(np.float32), np.arange(30) % 3 == 0)
    aimed, others = (sent(aimed_rays(rays, count, np.random.default_rng(count)), m.device) for count in (9, 20))
    counted = torch.tensor([True] * 20 + [complete, True, complete] * 3)

    def found(parts: list[AimedRays]) -> tuple[float, torch.Tensor]:
        outputs = render_rays(m, *(torch.cat(each) for each in zip(*(part.bundle for part in parts), strict=True)), prune=False)
        loss = sparse_depth_loss(outputs, aimed.distance, aimed.on_support, m.settings.samples_per_pivot, counted[-len(outputs.fine_opacity) :])
        (gradient,) = torch.autograd.grad(loss, m.fine.weights[-1])
        return float(loss.detach()), gradient

    alone, gradient = found([aimed])
    for on_device in (False, True):
        monkeypatch.setattr(transfer, "is_on_device", lambda values, on_device=on_device: on_device)
        behind_others, same = found([others, aimed])
        assert behind_others == pytest.approx(alone, rel=1e-5)
        torch.testing.assert_close(same, gradient, rtol=1e-3, atol=1e-6)


def test_a_schedule_whose_iterations_are_revised_goes_on_from_where_it_was() -> None:
    first = Schedule(1000, hold=100, learning_rate=1e-2)
    second = first.with_iterations(3000, 400)
    last = second.with_iterations(2000, 700)
    assert (last.aims, last.iterations, last.revised_at) == (((1000, 400), (3000, 700)), 2000, 700)
    fractions = [last.fraction(step) for step in range(2001)]
    assert all(a <= b for a, b in itertools.pairwise(fractions))
    assert max(b - a for a, b in itertools.pairwise(fractions)) < 2 / 900  # no leap
    assert fractions[:401] == [first.fraction(step) for step in range(401)]
    assert fractions[:701] == [second.fraction(step) for step in range(701)]
    assert fractions[2000] == pytest.approx(1)
    assert last.learning_rate_at(2000) == pytest.approx(5e-4)


def test_a_schedule_that_is_replaced_on_the_way_is_repeated_by_the_last_one() -> None:
    """To the byte: what a schedule says of the steps before its revision is what was done in them."""
    states = []
    for revise in (True, False):
        t = trainer(untrained(iterations=12, occupancy_warmup_steps=4))
        early, late = replace(t.schedule, iterations=100, hold=3), replace(t.schedule, iterations=100, hold=3).with_iterations(9, 5)
        t.schedule = early if revise else late
        for done in train(t, pixels()):
            if done.step == 5:
                t.schedule = late
        assert t.step == 9
        states.append({name: tensor.numpy().tobytes() for name, tensor in state_of(t).items()})
    assert states[0] == states[1]
