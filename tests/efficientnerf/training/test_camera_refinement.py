"""Corrections of cameras: their group, their derivatives, and cameras that are found again, by themselves and beside a field."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from efficientnerf.geometry.cameras import Camera, project, rays
from efficientnerf.training.alignment import EVERY, refine_cameras
from efficientnerf.training.camera_refinement import (
    Alignment,
    CameraCorrections,
    add_round,
    corrected,
    motion,
    rotation_matrix,
    rotation_vector,
    solve,
    take_similarity_out,
)
from efficientnerf.training.device_pixels import DevicePixels
from efficientnerf.training.exposure.model import exposure_of
from efficientnerf.training.loop import restore, state_of, train, trainer
from efficientnerf.training.pixels import Pixels
from efficientnerf.training.schedule import schedule_of
from tests.efficientnerf.balls import cameras, photograph, untrained

DEPTH = 3.0


def moved(camera: Camera, rng: np.random.Generator, pixels: float) -> Camera:
    """A camera turned and shifted by about so many pixels."""
    return corrected(camera, rng.normal(size=6) * pixels / camera.intrinsics["fx"], 0.0, DEPTH)


def error(found: list[Camera], true: list[Camera]) -> float:
    """Mean distance in pixels of the projections of some points near the origin."""
    points = np.random.default_rng(3).uniform(-0.6, 0.6, (40, 3))
    return float(np.mean([np.linalg.norm(project(a, points)[0] - project(b, points)[0], axis=1).mean() for a, b in zip(found, true, strict=True)]))


def test_rotation_vectors_and_matrices_are_inverse_of_each_other() -> None:
    rng = np.random.default_rng(0)
    for size in (0.0, 1e-12, 1e-7, 1e-4, 0.1, 3.0):
        vector = rng.normal(size=3)
        vector *= size / np.linalg.norm(vector)
        matrix = rotation_matrix(vector)
        np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-12)
        np.testing.assert_allclose(matrix @ vector, vector, atol=1e-12)
        np.testing.assert_allclose(rotation_vector(matrix), vector, rtol=1e-6, atol=1e-15)


def test_motion_is_the_derivative_of_the_projection() -> None:
    camera = replace(cameras(1, 64)[0], model="RADIAL", params=(80.0, 31.0, 33.0, -0.05, 0.01))
    points = np.random.default_rng(1).uniform(-0.5, 0.5, (20, 3))
    change = 1e-3 * np.random.default_rng(2).normal(size=7)
    before, after = project(camera, points)[0], project(corrected(camera, change[:6], change[6], DEPTH), points)[0]
    np.testing.assert_allclose(motion(camera, DEPTH, points) @ change, after - before, atol=2e-3 * np.abs(after - before).max())


def shade(points: np.ndarray) -> np.ndarray:
    """(N, 3) colour of the surface of a ball at points: smooth, and another one everywhere."""
    return 0.5 + 0.4 * np.sin(np.stack([5 * points[:, 0] + 3 * points[:, 2], 6 * points[:, 1], 4 * points[:, 2] - 5 * points[:, 0]], axis=1))


def hits(camera: Camera, at: np.ndarray) -> np.ndarray:
    """(N, 3) where rays through pixels hit the ball of radius 1, nan beside it."""
    origins, directions = rays(camera, at)
    b = (origins * directions).sum(axis=1)
    root = b**2 - (origins**2).sum(axis=1) + 1
    with np.errstate(invalid="ignore"):
        return origins + (-b - np.sqrt(root))[:, None] * directions


def alignment(true: Camera, found: Camera, rng: np.random.Generator) -> Alignment:
    """The photograph of the true camera against a perfect render of the found one."""
    at = rng.uniform(20, 44, (300, 2))
    point, h = hits(found, at), 0.5
    seen = shade(hits(true, at))
    gradient = np.stack([(shade(hits(true, at + h * e)) - shade(hits(true, at - h * e))) / (2 * h) for e in np.eye(2)], axis=-1)
    return Alignment(at, seen - shade(point), gradient, point)


def test_cameras_are_found_against_a_perfect_field() -> None:
    rng, true = np.random.default_rng(4), cameras(6, 64)
    # The prior holds the cameras, so that a tenth of the error may be left.
    given = [moved(camera, rng, 0.7) for camera in true]
    given = [replace(camera, params=(camera.params[0] * 1.002, *camera.params[1:])) for camera in given]
    c = CameraCorrections.none(given)
    for _ in range(12):
        add_round(c, [alignment(a, b, rng) for a, b in zip(true, c.cameras, strict=True)])
        solve(c)
    assert error(c.cameras, true) < 0.35 * error(given, true)
    assert solve(c) < 0.1


def test_what_all_photographs_agree_on_stays() -> None:
    """No residual, no motion; and a camera of which nothing was rendered stays where it is, but for the similarity."""
    rng, true = np.random.default_rng(5), cameras(4, 64)
    c = CameraCorrections.none(true)
    add_round(c, [alignment(camera, camera, rng) for camera in true])
    assert solve(c) < 1e-6
    assert error(c.cameras, true) < 1e-6
    c = CameraCorrections.none(true)
    add_round(c, [None] * 4)
    assert solve(c) == 0
    assert not c.pose.any()


def test_the_similarity_of_the_scene_stays() -> None:
    """All cameras turned, moved and scaled alike show the same photographs: nothing may be left of that."""
    c = CameraCorrections.none(cameras(5, 64))
    c.depth[:] = DEPTH
    turn, centre = rotation_matrix(np.array([0.004, -0.003, 0.002])), np.array([0.01, 0.02, -0.01])
    for n, camera in enumerate(c.given):
        own = camera.world_from_camera[:3, :3]
        c.pose[n, :3] = rotation_vector(own.T @ turn @ own)
        c.pose[n, 3:] = own.T @ (1.003 * turn @ camera.centre + centre - camera.centre) / DEPTH
    assert error(c.cameras, list(c.given)) > 0.1
    take_similarity_out(c)
    assert np.abs(c.pose).max() < 1e-9


def photographs(true: list[Camera], given: list[Camera]) -> Pixels:
    return Pixels(given, [photograph(camera) for camera in true], [None] * len(true), np.full(len(true), 1.0), np.full(len(true), 50.0))


@pytest.mark.parametrize("changes", [{}, {"sampling": "uniform", "field": "mlp"}], ids=["hash", "mlp"])
def test_pixels_of_a_device_are_refined_alike(changes: dict[str, str]) -> None:
    """Also with gains of the photographs, and with a field of which nothing is pruned."""
    made = cameras(3, 16)
    m = untrained(contracted=True, initial_density=3.0, **changes)
    exposure = exposure_of(made, np.array([[0.05, 0.0, 0.0], [0.0, 0.0, 0.05], [-0.05, 0.0, -0.05]])).detached
    found = []
    for on_device in (False, True):
        p = photographs(made, made)
        source = DevicePixels(p, "cpu") if on_device else p
        c = CameraCorrections.none(made)
        moved_by = refine_cameras(m, p, source, c, np.random.default_rng(9), exposure)
        assert 0 < moved_by <= 1
        bundle = source.bundle(np.arange(0, 768, 7))
        expected = photographs(made, c.cameras).bundle(np.arange(0, 768, 7))
        for a, b in zip(bundle, expected, strict=True):
            np.testing.assert_allclose(np.asarray(a), np.asarray(b), rtol=1e-6, atol=1e-6)
        found.append(c)
    np.testing.assert_allclose(found[0].pose, found[1].pose, rtol=1e-9, atol=1e-12)
    plain = CameraCorrections.none(made)
    p = photographs(made, made)
    refine_cameras(m, p, p, plain, np.random.default_rng(9), None)
    assert np.abs(plain.pose - found[0].pose).max() > 1e-9


@pytest.mark.slow
def test_perturbed_cameras_are_refined_beside_the_field() -> None:
    rng, true = np.random.default_rng(7), cameras(12, 32)
    given = [moved(camera, rng, 1.0) for camera in true]
    errors = {}
    for kind in ("off", "on"):
        m = untrained(contracted=True, iterations=600, camera_refinement=kind, occupancy_warmup_steps=60)
        t = trainer(m, None, replace(schedule_of(m.settings), ramp_steps=10), given)
        losses = [done.loss for done in train(t, photographs(true, given))][-50:]
        assert (t.cameras is None) == (kind == "off")
        errors[kind] = (np.mean(losses), error(given if t.cameras is None else t.cameras.cameras, true))
    assert errors["on"][0] < errors["off"][0]
    assert errors["on"][1] < 0.8 * errors["off"][1]


def test_a_resumed_run_refines_as_an_uninterrupted_one() -> None:
    rng, true = np.random.default_rng(8), cameras(6, 16)
    given = [moved(camera, rng, 0.5) for camera in true]
    states = []
    for stop in (None, EVERY + 20):
        m = untrained(contracted=True, iterations=2 * EVERY + 30, camera_refinement="on", sample_batch_size=1024)
        t = trainer(m, cameras=given)
        for done in train(t, photographs(true, given)):
            if done.step == stop:
                break
        if stop is not None:
            state = {name: tensor.clone() for name, tensor in state_of(t).items()}
            assert any(name.startswith("cameras.") for name in state)
            t = trainer(untrained(contracted=True, iterations=2 * EVERY + 30, camera_refinement="on", sample_batch_size=1024), cameras=given)
            restore(t, state)
            for _ in train(t, photographs(true, given)):
                pass
        states.append(state_of(t))
    assert np.abs(states[0]["cameras.pose"].numpy()).max() > 0
    assert all(torch.equal(states[0][name], states[1][name]) for name in states[0])
