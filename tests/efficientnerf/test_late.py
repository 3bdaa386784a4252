"""Training that does not wait for the device: on the CPU, through Triton's interpreter where it is there, else the bookkeeping alone."""

from __future__ import annotations

import pytest
import torch

from efficientnerf import late, training
from efficientnerf.kernels import dispatch
from efficientnerf.late import Late, Room, mean_over, whole_rays
from efficientnerf.sampling import Samples
from tests.efficientnerf.balls import pixels, untrained


def samples(counts: list[int], tried: int = 50) -> Samples:
    first = torch.tensor([0, *counts]).cumsum(0)
    empty = torch.zeros(int(first[-1]))
    return Samples(first, empty, empty, empty, torch.zeros(len(empty), 3), tried)


def test_counts_arrive_late_once_they_have_settled(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(late, "SETTLED", 3)
    monkeypatch.setattr(late, "LAG", 2)
    kept = Late()
    arrived, rooms = [], []
    for step in range(1, 9):
        rooms.append(kept.room(4))
        counted = kept.note(4, torch.tensor(float(step)), samples([step, 0, 0, 0]), torch.ones(step, dtype=torch.bool), samples([2 * step, 0, 0, 0]))
        arrived.append((counted.loss, counted.valid, counted.fine))
    assert [loss for loss, _, _ in arrived] == [1, 2, 2, 2, 3, 4, 5, 6]
    assert all(fine == 2 * valid for _, valid, fine in arrived)
    assert rooms[:3] == [None] * 3
    assert rooms[3] == Room(late.GRAIN, late.GRAIN)
    assert kept.fine_per_ray == pytest.approx(2 * kept.valid_per_ray)
    big = kept.room(10**6)
    assert big is not None
    assert big.fine >= late.MARGIN * kept.fine_per_ray * 10**6 > big.fine - late.GRAIN - 1


def test_rays_without_room_are_left_out() -> None:
    whole = whole_rays(samples([2, 3, 4, 0]), samples([1, 1, 1, 0]), Room(6, 10))
    assert whole.tolist() == [True, True, False, False]
    values = torch.tensor([[1.0, 3.0], [5.0, 5.0], [float("nan"), 1.0], [1e9, 0.0]], requires_grad=True)
    mean = mean_over(values, whole)
    assert float(mean.detach()) == pytest.approx(3.5)
    mean.backward()
    assert values.grad is not None
    assert not values.grad[2:].any()
    assert float(mean_over(values.detach()[:2], None)) == 3.5
    assert float(mean_over(values.detach(), torch.zeros(4, dtype=torch.bool))) == 0


@pytest.mark.parametrize("contracted", [False, True])
def test_padded_steps_learn_what_counted_ones_do(contracted: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """The whole step by the CUDA kernels, interpreted: with room from the fourth step on, and counted exactly."""
    from tests.efficientnerf.device import DEVICE

    losses = {}
    for settled in (3, 1000):
        with monkeypatch.context() as patch:
            patch.setattr(training, "FEWEST_RAYS", 12)
            patch.setattr(late, "SETTLED", settled)
            patch.setattr(late, "LAG", 1)
            patch.setattr(late, "GRAIN", 64)
            patch.setattr(dispatch, "triton_usable", lambda: True)
            if DEVICE == "cpu":
                patch.setattr(dispatch, "on_device", lambda *tensors: all(t.dtype == torch.float32 for t in tensors))
            m = untrained(contracted=contracted, samples=64, iterations=7, warm_up=4, refresh_every=3, explored=0.0, distortion=0.0)
            losses[settled] = [done.loss for done in training.train(training.trainer(m), pixels(3, 8))]
    assert losses[3][:2] == pytest.approx(losses[1000][:2], rel=1e-4)
    # From the third step on what arrives is the step before; no ray lacks room, so the steps themselves are alike.
    assert losses[3][2:] == pytest.approx(losses[1000][1:-1], rel=1e-3)
