"""Adam and the directions of training pixels against what they stand for; the kernels' other pairs are with what they replace."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from efficientnerf.geometry.cameras import Camera, rays
from efficientnerf.training.optimiser import BETA1, Adam, ParameterGroup
from efficientnerf.training.pixels import Pixels
from tests.efficientnerf.steps import RATES, gradients

ROOT = Path(__file__).resolve().parents[3]


def stepped(grads: list[torch.Tensor], *, sparse: bool = False) -> nn.Parameter:
    p = nn.Parameter(torch.ones_like(grads[0]))
    adam = Adam([ParameterGroup({"p": p}, sparse)])
    for number, (grad, rate) in enumerate(zip(grads, RATES, strict=True), 1):
        p.grad = grad.clone()
        adam.step(adam.step_size(number, rate))
        assert p.grad is None
    return p


def test_adam_is_torchs() -> None:
    theirs = nn.Parameter(torch.ones(50, 2))
    optimiser = torch.optim.Adam([theirs], betas=(BETA1, 0.99), eps=1e-15)
    for grad, rate in zip(gradients(), RATES, strict=True):
        theirs.grad = grad.clone()
        optimiser.param_groups[0]["lr"] = rate
        optimiser.step()
    torch.testing.assert_close(stepped(gradients()), theirs, rtol=2e-5, atol=1e-6)


def rotation(seed: int) -> np.ndarray:
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.sign(np.linalg.det(q))


def camera(n: int, model: str, params: tuple[float, ...], width: int = 9, height: int = 7) -> Camera:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation(n), (n, -n, 0.5)
    return Camera(f"v{n}", width, height, model, params, pose)


@pytest.mark.parametrize("model", ["OPENCV", "OPENCV_FISHEYE"])
def test_directions_between_knots_are_off_by_a_hundredth_of_a_pixel(monkeypatch: pytest.MonkeyPatch, model: str) -> None:
    monkeypatch.setattr("efficientnerf.training.pixels.EXACT", 100)
    focal = 900.0
    more = (-0.12, 0.03, 0.001, -0.002) if model == "OPENCV" else (0.02, -0.01, 0.003, 0.0)
    cameras = [camera(n, model, (focal, focal + 5, 420.0 + n, 300.0, *more), 853, 601) for n in range(2)]
    images = (np.full((601, 853, 3), 60 * n, np.uint8) for n in range(2))
    mask = np.ones((601, 853), bool)
    mask[:, 100:] = False
    pixels = Pixels(cameras, images, [None, mask], np.ones(2), np.full(2, 9.0), 3)
    assert (pixels.stride, len(pixels.lookup)) == (8, 2 * 108 * 76)
    _, directions, _, _, colour = pixels.bundle(np.arange(len(pixels)))
    expected = np.concatenate([rays(c)[1] for c in cameras])
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, atol=1e-6)
    assert np.linalg.norm(directions - expected, axis=1).max() * focal < 0.01
    assert (colour[601 * 853 :] * 255).round().max() == 60
    chosen = pixels.choose(20000, np.random.default_rng(0))
    second = chosen[pixels.view_of(chosen) == 1] - 601 * 853
    assert 0 < len(second) < 5000
    assert (second % 853 < 100).all()


def test_large_photographs_are_held_once_and_as_bytes() -> None:
    """Three of 12 megapixels, each with a lens of its own: 3 bytes a pixel, one image beside, and next to nothing for directions."""
    program = """
import resource
import numpy as np
from efficientnerf.geometry.cameras import Camera
from efficientnerf.training.pixels import Pixels
cameras = [Camera(f"v{n}", 4000, 3000, "SIMPLE_RADIAL", (3000.0 + n, 2000.0, 1500.0, -0.05), np.eye(4)) for n in range(3)]
photographs = (np.random.default_rng(n).integers(0, 256, (3000, 4000, 3), np.uint8) for n in range(3))
masks = (np.ones((3000, 4000), bool) for n in range(3))
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
pixels = Pixels(cameras, photographs, masks, np.ones(3), np.full(3, 9.0), 3)
assert len(pixels) == 36_000_000 and pixels.bundle(pixels.choose(1000, np.random.default_rng(0)))[1].shape == (1000, 3)
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024)
"""
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    assert float(done.stdout) < 103 + 3 * 34 + 80  # MiB: all pixels; an image while it is made, and its mask unpacked; the kernel's compilation
