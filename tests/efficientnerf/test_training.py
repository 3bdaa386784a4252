"""Training on an analytic ball: it learns, does not collapse, repeats, and goes on where it was."""

from __future__ import annotations

import dataclasses
import itertools
import math

import numpy as np
import pytest
import torch

from efficientnerf.model import Model, render_rays
from efficientnerf.training import loop
from efficientnerf.training.loop import (
    Adam,
    Progress,
    SparseDepthRays,
    anchor_loss,
    fine_samples_at,
    learning_rate,
    restore,
    share_of_fall,
    state_of,
    train,
    trainer,
)
from efficientnerf.training.pixels import Pixels
from efficientnerf.training.settings import TrainSettings
from tests.efficientnerf.balls import cameras, photograph, pixels, settings, untrained

MLP = {"field": "mlp", "hidden_dim": 24, "num_layers": 2, "coarse_num_layers": 1, "learning_rate": 1e-2}


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """The rate rises in a few steps."""
    monkeypatch.setattr(loop, "RATE_WARM_UP", 10)


def run(m: Model, which: Pixels | None = None) -> list[Progress]:
    return list(train(trainer(m), which or pixels()))


def psnr_of(steps: list[Progress]) -> float:
    return -10 * math.log10(np.mean([step.loss for step in steps]))


@pytest.mark.parametrize("rule", ["momentum", "maximum"])
@pytest.mark.parametrize("field", ["hash", "mlp"])
def test_it_learns(field: str, rule: str) -> None:
    m = untrained(occupancy_rule=rule, **(dict(MLP, iterations=40) if field == "mlp" else {}))
    steps = run(m)
    assert psnr_of(steps[-10:]) > psnr_of(steps[:5]) + (2 if field == "hash" else 1)
    assert [step.step for step in steps] == list(range(1, m.settings.iterations + 1))
    assert all(step.fine == m.settings.samples_per_pivot * step.pivotal and step.pivotal <= step.valid <= step.tried for step in steps)
    for step in steps[: m.settings.occupancy_warmup_steps]:
        assert step.valid == step.tried  # nothing is pruned in the warm-up


def test_intervals_are_sampled_more_finely_in_the_second_half_of_the_schedule() -> None:
    steps = run(untrained(iterations=40, samples_per_pivot=5, early_samples_per_pivot=2))
    assert [step.fine for step in steps] == [(2 if step.step < 20 else 5) * step.pivotal for step in steps]
    constant = run(untrained(iterations=40, samples_per_pivot=5, early_samples_per_pivot="off"))
    assert all(step.fine == 5 * step.pivotal > 0 for step in constant)
    # A schedule that was settled anew counts by its own share, not by steps over all steps: of 40 steps to step 10, then of 20.
    settled = TrainSettings(samples_per_pivot=5, early_samples_per_pivot=2, iterations=20, rate_aims=(40, 10))
    found = [fine_samples_at(settled, share_of_fall(n, settled.iterations, settled.rate_hold, settled.rate_aims)) for n in range(1, 21)]
    assert found == [2] * 13 + [5] * 7  # a quarter by step 10, and the rest in ten steps


def test_surroundings_are_learned_too() -> None:
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


@pytest.mark.parametrize("field", ["hash", "mlp"])
@pytest.mark.parametrize("at", [1, 4, 7])
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


def test_a_finished_run_has_nothing_left_to_do() -> None:
    t = trainer(untrained(iterations=2))
    assert len(list(train(t, pixels()))) == 2
    assert list(train(t, pixels())) == []


def test_the_number_of_rays_follows_the_samples_they_need() -> None:
    steps = run(untrained(iterations=30, occupancy_warmup_steps=5, sample_batch_size=8192))
    used = [step.valid + step.fine for step in steps[-10:]]
    assert 0.7 * 8192 < np.mean(used) < 1.3 * 8192
    assert steps[-1].rays > steps[0].rays  # at first, all intervals were expected to be sampled
    assert run(untrained(iterations=1, max_rays_per_batch=70))[0].rays <= 70


def test_the_rate_rises_and_falls() -> None:
    rates = [learning_rate(step, 1e-2, 0.05, 2000) for step in range(1, 2001)]
    assert rates[0] < rates[4] < rates[9]
    assert all(a >= b for a, b in itertools.pairwise(rates[9:]))
    assert rates[-1] == pytest.approx(5e-4)


def test_a_held_rate_does_not_depend_on_the_end() -> None:
    short, long = ([learning_rate(step, 1e-2, 0.05, n, hold=300) for step in range(1, n + 1)] for n in (500, 5000))
    assert short[:300] == long[:300]
    assert short[299] == 1e-2
    assert short[-1] == pytest.approx(5e-4)
    assert long[-1] == pytest.approx(5e-4)


def test_transparent_pixels_teach_no_colour() -> None:
    """The colour under alpha 0 is anything; it must not be seen."""
    some = pixels()
    other = pixels()
    hidden = other.images[:, 3] == 0
    other.images[hidden, :3] = 77
    assert hidden.any()
    losses = [[step.loss for step in train(trainer(untrained(iterations=5)), p)] for p in (some, other)]
    assert losses[0] == losses[1]


def test_anchors_pull_the_light_to_their_points() -> None:
    m = untrained(contracted=True)
    origins = np.tile(np.float32([[-3.0, 0.1, 0.05]]), (4, 1))
    directions = np.float32([[1, 0, 0], [0.995, 0.0998, 0], [0.995, 0, 0.0998], [0.995, -0.0998, 0]])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    anchors = SparseDepthRays(origins, directions, np.full(4, 3.0, np.float32))
    adam = Adam(m.parameters())
    losses = []
    for step in range(1, 41):
        loss = anchor_loss(m, anchors, 16, np.random.default_rng(step), prune=False)
        loss.backward()
        adam.step(step, 3e-2)
        losses.append(float(loss.detach()))
    assert 1.5 < losses[0] <= 2
    assert losses[-1] < 1.2


def test_settings_say_what_they_mean() -> None:
    for f in dataclasses.fields(settings()):
        assert f.metadata["doc"], f.name


def test_thin_scenes_survive_a_white_background_the_papers_way() -> None:
    """No random colours behind the object, momentum voxels with threshold 0, no refresh but whole rays.

    The middle of the pictures comes first, and pruning waits until the coarse network knows where matter is: without the first, or pruned after 80
    steps, the ball fades away (opacity below 0.15 after as many steps).
    """
    paper = {
        "background_color": "scene", "occupancy_rule": "momentum", "occupancy_update_fraction": 0.0,
        "occupancy_update_ray_fraction": 0.05, "exploration_fraction": 0.0, "sample_batch_size": "off", "max_rays_per_batch": 256,
    }  # fmt: skip
    m = untrained(**paper, **MLP, iterations=300, occupancy_warmup_steps=220, precrop_steps=60)
    thin = pixels(8, 20, 0.25)
    steps = run(m, thin)
    assert steps[-1].valid < 0.2 * steps[200].valid  # most is pruned
    origins, directions, near, far = (torch.from_numpy(a) for a in thin.bundle(np.arange(len(thin)))[:4])
    with torch.no_grad():
        opacity = render_rays(m, origins, directions, near, far, torch.full_like(near, 0.5), torch.ones(len(thin), 3)).fine_opacity.numpy()
    on_ball = thin.images[:, 3] > 200
    assert opacity[on_ball].mean() > 0.35
    assert opacity[~on_ball].mean() < 0.02


def test_the_middle_of_the_pictures_comes_first() -> None:
    some = pixels(4, 16)
    rng = np.random.default_rng(0)
    chosen = some.choose(2000, rng, middle=True)
    y, x = np.divmod(chosen % 256, 16)
    assert x.min() == y.min() == 4
    assert x.max() == y.max() == 11
    assert len(np.unique(chosen)) > 0.99 * 4 * 64 * (1 - math.exp(-2000 / 256))
    usable = np.arange(len(some)) < y.min() * 16
    some.usable = np.packbits(usable)  # the first rows only, none of them in the middle
    assert some.choose(50, rng, middle=True).max() < 64


@pytest.mark.parametrize("strategy", ["uniform", "hierarchical", "valid"])
@pytest.mark.parametrize("field", ["mlp", "nerf"])
def test_other_samplings_learn_too_and_only_those_that_prune_touch_the_voxels(field: str, strategy: str) -> None:
    m = untrained(**dict(MLP, field=field), iterations=40, sampling=strategy, num_importance_samples=16, sample_batch_size="off", max_rays_per_batch=128)
    steps = run(m)
    assert psnr_of(steps[-10:]) > psnr_of(steps[:5]) + 1
    assert {step.rays for step in steps} == {128}  # a fixed batch
    assert bool((m.voxels.values == m.voxels.start).all()) == (strategy != "valid")


def test_the_rate_can_fall_by_a_tenth_in_so_many_steps() -> None:
    assert learning_rate(500_000, 5e-4, 0.1, 1_000_000, 500_000) == pytest.approx(5e-5)
    assert learning_rate(1_000_000, 5e-4, 0.1, 1_000_000, 500_000) == pytest.approx(5e-6)


@pytest.mark.parametrize("contracted", [False, True])
def test_voxels_alone_can_choose_the_pivots(contracted: bool) -> None:
    m = untrained(contracted=contracted, coarse="voxels", iterations=120)
    made = cameras()
    photographs = Pixels(made, [photograph(camera) for camera in made], [None] * len(made), np.full(len(made), 1.0), np.full(len(made), 50.0))
    steps = run(m, photographs if contracted else None)
    assert not any(name.startswith("coarse") for name, _ in m.parameters())
    assert psnr_of(steps[-10:]) > psnr_of(steps[:5]) + 2
    for step in steps[: m.settings.occupancy_warmup_steps]:
        assert step.tried == step.valid == step.pivotal == step.fine  # everything, once
    for step in steps[m.settings.occupancy_warmup_steps :]:
        assert step.fine == m.settings.samples_per_pivot * step.pivotal
    assert all(step.valid < step.tried for step in steps[-10:])  # what is empty is found


def test_a_schedule_that_was_settled_anew_goes_on_from_where_it_stood() -> None:
    aims = (1000, 400, 3000, 700)
    shares = [loop.share_of_fall(step, 2000, 100, aims) for step in range(2001)]
    assert all(a <= b for a, b in itertools.pairwise(shares))
    assert max(b - a for a, b in itertools.pairwise(shares)) < 2 / 900  # no leap
    assert shares[:401] == [loop.share_of_fall(step, 1000, 100) for step in range(401)]
    assert shares[:701] == [loop.share_of_fall(step, 3000, 100, aims[:2]) for step in range(701)]
    assert shares[2000] == pytest.approx(1)
    assert learning_rate(2000, 1e-2, 0.05, 2000, 0, 100, aims) == pytest.approx(5e-4)
