"""Exposure: against loops over plain numbers, its inverse, gradients, and photographs exposed differently from which the same scene is learned."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from efficientnerf.rendering.colour import linear_from_srgb, srgb_from_linear
from efficientnerf.training.exposure import model as module
from efficientnerf.training.exposure.fit import fit_exposure
from efficientnerf.training.exposure.held_out import predicted_gains
from efficientnerf.training.exposure.model import (
    OFFSET_SCALE,
    SCALE,
    Exposure,
    averaged,
    averaged_image,
    exposed,
    exposure_loss,
    exposure_of,
    squared_radius,
)
from efficientnerf.training.loop import restore, state_of, train, trainer
from efficientnerf.training.pixels import Pixels
from efficientnerf.training.schedule import schedule_of
from tests.efficientnerf.balls import cameras, photograph, untrained


def random(*shape: int, seed: int = 1) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def some(count: int = 4, lenses: int = 2, strength: float = 2.0) -> Exposure:
    return Exposure(strength * random(count, 3, seed=2), strength * random(lenses, 4, seed=3), torch.arange(count) % lenses)


def shown_by_loop(colour: float, log_gain: float, radius: float, own: list[float], average: list[float]) -> float:
    """One channel of one pixel; own and average: a, b, shoulder and offset."""

    def shoulder(x: float, s: float) -> float:
        return x * math.exp(s) / (1 + (math.exp(s) - 1) * x) if x <= 1 else 1 + (x - 1) * math.exp(-s)

    light = shoulder((float(linear_from_srgb(np.float64(colour))) - average[3]) / (1 - average[3]), -average[2])
    light *= math.exp(log_gain + own[0] * (radius - 1 / 3) + own[1] * (radius**2 - 1 / 9))
    return float(srgb_from_linear(np.float64(own[3] + (1 - own[3]) * shoulder(light, own[2]))))


def test_photographs_show_the_scene_as_the_equations_say() -> None:
    e, colour, view = some(), torch.rand(40, 3, generator=torch.Generator().manual_seed(4), dtype=torch.float64), torch.arange(40) % 4
    radius = torch.linspace(0, 1, 40, dtype=torch.float64)
    scale = [SCALE, SCALE, SCALE, OFFSET_SCALE]
    lenses = [[value * unit for value, unit in zip(row, scale, strict=True)] for row in e.cameras.tolist()]
    average = [sum(column) / len(lenses) for column in zip(*lenses, strict=True)]
    mean = [sum(column) / 4 for column in zip(*e.photographs.tolist(), strict=True)]
    expected = [
        [
            shown_by_loop(float(colour[n, k]), SCALE * (float(e.photographs[n % 4, k]) - mean[k]), float(radius[n]), lenses[n % 4 % 2], average)
            for k in range(3)
        ]
        for n in range(40)
    ]
    torch.testing.assert_close(exposed(colour, view, radius, e), torch.tensor(expected, dtype=torch.float64), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("strength", [0.5, 3.0, 8.0])
def test_averaged_undoes_exposed_beyond_white_too(strength: float) -> None:
    e, colour, view = some(strength=strength), torch.linspace(0, 1.3, 60, dtype=torch.float64)[:, None].expand(60, 3), torch.arange(60) % 4
    radius = torch.linspace(1, 0, 60, dtype=torch.float64)
    torch.testing.assert_close(averaged(exposed(colour, view, radius, e), view, radius, e), colour, rtol=1e-9, atol=1e-9)


def test_gradients() -> None:
    view, radius, camera_of = torch.tensor([0, 1, 1, 3, 3, 3]), torch.rand(6, dtype=torch.float64), torch.tensor([0, 0, 1, 1])

    def both(colour: torch.Tensor, photographs: torch.Tensor, of_cameras: torch.Tensor) -> tuple[torch.Tensor, ...]:
        e = Exposure(photographs, of_cameras, camera_of)
        return exposed(colour, view, radius, e), averaged(colour, view, radius, e), exposure_loss(e)

    colour = torch.rand(6, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(5)) * 0.9 + 0.05
    assert torch.autograd.gradcheck(both, (colour.requires_grad_(), random(4, 3).requires_grad_(), random(2, 4).requires_grad_()))


def test_a_photograph_as_if_exposed_like_the_others() -> None:
    """Alpha stays, nothing is brighter than white, and what was clipped by more light is left out."""
    e = Exposure(torch.tensor([[np.log(2.0)] * 3, [-np.log(2.0)] * 3], dtype=torch.float32) / SCALE, torch.zeros(1, 4), torch.zeros(2, dtype=torch.int64))
    image = np.array([[[100, 200, 10, 7], [255, 255, 255, 255]]], np.uint8)
    bright, used = averaged_image(image, None, 0, e)
    dark, all_used = averaged_image(image, np.array([[True, False]]), 1, e)
    half = np.rint(255 * srgb_from_linear(linear_from_srgb(image[0, :, :3] / 255.0) / 2))
    assert np.abs(bright[0, :, :3] - half).max() <= 1
    assert used.tolist() == [[True, False]]
    assert dark[0, 1].tolist() == [255] * 4
    assert all_used.tolist() == [[True, False]]
    assert (bright[..., 3].tolist(), image[0, 0].tolist()) == ([[7, 255]], [100, 200, 10, 7])


@pytest.mark.parametrize("strength", [0.0, 1.0, 8.0])
def test_a_photograph_has_the_bytes_of_averaged(strength: float) -> None:
    """Of any response, offset and vignetting: tables are exact."""
    draw = torch.Generator().manual_seed(7)
    e = Exposure(strength * torch.randn(3, 3, generator=draw), strength * torch.randn(2, 4, generator=draw), torch.tensor([0, 1, 0]))
    image = np.random.default_rng(1).integers(0, 256, (40, 50, 3), np.uint8)
    y, x = np.divmod(np.arange(2000), 50)
    radius = torch.from_numpy(squared_radius(x, y, 50, 40))
    for number in range(3):
        colour = torch.from_numpy(image.reshape(-1, 3).astype(np.float32) / np.float32(255))
        expected = torch.round(255 * averaged(colour, torch.full((2000,), number), radius, e).clamp(0, 1)).to(torch.uint8)
        assert np.array_equal(averaged_image(image, None, number, e)[0].reshape(-1, 3), expected.numpy())


def test_the_exposure_of_a_held_back_photograph() -> None:
    """Foretold by its neighbours where it changes slowly around the ring; the mean where each photograph has its own."""
    ring = sorted(cameras(48), key=lambda camera: math.atan2(*camera.centre[:2]))
    angle = np.array([math.atan2(*camera.centre[:2]) for camera in ring])
    held, used = slice(3, None, 8), np.arange(48) % 8 != 3
    some = [camera for camera, one in zip(ring, used, strict=True) if one]
    slow = np.stack([0.3 * np.sin(angle), -0.2 * np.cos(angle), 0 * angle], axis=1)
    slow -= slow[used].mean(axis=0)
    found = predicted_gains(slow[used], some, ring[held])
    assert np.abs(found - slow[held]).max() < 0.3 * np.abs(slow).max()
    wild = np.random.default_rng(0).normal(0, 0.3, (48, 3))
    wild -= wild[used].mean(axis=0)
    assert ((predicted_gains(wild[used], some, ring[held]) - wild[held]) ** 2).mean() < 1.1 * (wild[held] ** 2).mean()
    assert not predicted_gains(slow[:2], ring[:2], ring[2:]).any()  # too few


def photographs(gains: np.ndarray) -> Pixels:
    """Of the ball, with factors (C, 3) of linear light."""
    made = cameras(len(gains))
    lights = [linear_from_srgb(photograph(camera) / 255.0) * gain for camera, gain in zip(made, gains, strict=True)]
    images = [np.rint(255 * srgb_from_linear(light.clip(0, 1))).astype(np.uint8) for light in lights]
    return Pixels(made, images, [None] * len(made), np.full(len(made), 1.0), np.full(len(made), 50.0))


def test_differences_between_photographs_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """From a beginning that is not quite right."""
    monkeypatch.setattr(module, "BEGIN", 0.0)
    logs = 0.4 * np.array([1.0, -1, 1, -1, 1, -1, 1, -1])[:, None] * np.array([1.0, 1.0, 0.8])
    losses = {}
    for learned in (True, False):
        m = untrained(contracted=True, iterations=200)
        t = trainer(m, exposure_of(cameras(8), 0.8 * logs) if learned else None, replace(schedule_of(m.settings), ramp_steps=10))
        losses[learned] = np.mean([done.loss for done in train(t, photographs(np.exp(logs)))][-20:])
        if t.exposure is not None:
            found = t.exposure.log_gains().detach().numpy()
            assert np.corrcoef(found.ravel(), logs.ravel())[0, 1] > 0.9
            again = trainer(untrained(contracted=True, iterations=200), exposure_of(cameras(8)))
            restore(again, state_of(t))
            assert torch.equal(again.exposure.photographs, t.exposure.photographs)
            assert torch.equal(again.exposure.cameras, t.exposure.cameras)
    assert losses[True] < 0.95 * losses[False]


@pytest.mark.parametrize("seed", [0, 1])
def test_what_points_show_gives_gains_and_vignetting_despite_outliers(seed: int) -> None:
    rng = np.random.default_rng(seed)
    views, points, lenses = 9, 300, np.arange(9) % 2
    gains, falloff = rng.normal(0, 0.4, (views, 3)), np.array([[-0.5, -0.1], [0.0, 0.0]])
    gains -= gains.mean(axis=0)
    point, view = np.repeat(np.arange(points), 4), np.concatenate([rng.permutation(views)[:4] for _ in range(points)])
    radius = rng.uniform(0, 1, len(view))
    vignetting = (np.stack([radius - 1 / 3, radius**2 - 1 / 9], axis=1) * falloff[lenses[view]]).sum(axis=1)
    light = rng.normal(-1, 0.7, (points, 3))[point] + gains[view] + vignetting[:, None] + rng.normal(0, 0.03, (len(view), 3))
    wrong = rng.random(len(view)) < 0.1
    light[wrong] += rng.normal(0, 2, (int(wrong.sum()), 3))
    found = fit_exposure(light, point, view, radius, lenses)
    assert np.abs(found.gains - gains).max() < 0.03
    r = np.linspace(0, 1, 9)
    assert np.abs((found.vignetting - falloff) @ np.stack([r - 1 / 3, r**2 - 1 / 9])).max() < 0.04
    assert found.explained > 0.9
    nothing = fit_exposure(light - gains[view] - vignetting[:, None], point, view, radius, lenses)
    assert nothing.explained < 0.1
    assert np.abs(nothing.gains).max() < 0.03
