"""The rasteriser's CUDA kernels against numba's and plain torch: images, gradients, and whole fits."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch

from efficientnerf.backends.numba.splats import fit as host
from efficientnerf.backends.splat_layout import GRADIENTS, HARMONICS, OPACITY, ROTATION, SCALE, SplatState
from efficientnerf.splats import merging, refit
from efficientnerf.splats.gaussians import Gaussians
from efficientnerf.splats.refit import rates_of, refitted
from efficientnerf.splats.rendering import lens_of, render, values_of
from tests.efficientnerf.device import DEVICE
from tests.efficientnerf.splats_balls import ball, error, photographs, ring
from tests.efficientnerf.splats_reference import LENSES, camera, picture_of, reference_loss, render_reference, some_gaussians, tensors

device = pytest.importorskip("efficientnerf.backends.triton.splats.fit")


def begun(gaussians: Gaussians) -> tuple[np.ndarray, np.ndarray]:
    """Values, and moments before the first step."""
    rows = values_of(gaussians)
    return rows, np.zeros((len(rows), GRADIENTS + rows.shape[1]), np.float32)


def agree(found: SplatState, wanted: SplatState) -> None:
    for name, one, other in zip(SplatState._fields, found, wanted, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-3, atol=1e-4 * max(1.0, float(np.abs(other).max())), err_msg=name)


@pytest.mark.parametrize(("model", "extra", "degree", "over_all"), [("PINHOLE", (), 2, True), (*LENSES[1], 1, False), (*LENSES[2], 0, True)])
def test_images_and_steps_are_those_of_the_host(model: str, extra: tuple[float, ...], degree: int, over_all: bool) -> None:
    """Two steps, so that running means and their corrections count."""
    gaussians, lens = some_gaussians(30, degree), lens_of(camera(model, extra))
    rows, moments = begun(gaussians)
    for one, two in zip(device.splat_image(rows, degree, lens, DEVICE), host.splat_image(rows, degree, lens), strict=True):
        np.testing.assert_allclose(one, two, atol=1e-4)
    fits = device.SplatFit(rows, moments, degree, DEVICE), host.SplatFit(rows, moments, degree)
    for number in range(2):
        for fit in fits:
            fit.step(lens, picture_of(number, over_all, 0.3, 0.2), rates_of(0.1 * number, 0.004))
    agree(fits[0].state(), fits[1].state())
    assert fits[0].state().moments[:, 0].max() == 2


def test_gradients_are_those_of_the_plain_sums() -> None:
    """Read from the moments after one step."""
    gaussians, picture = some_gaussians(31, 3), picture_of(1, True, 0.3, 0.2)
    fit = device.SplatFit(*begun(gaussians), 3, DEVICE)
    fit.step(lens_of(camera()), picture, rates_of(0.0, 0.004))
    found = fit.state().moments[:, GRADIENTS:] / (1 - refit.MOMENTUM)
    wanted = tensors(gaussians)
    reference_loss(*render_reference(*wanted, camera()), picture).backward()
    for name, part, leaf in zip(("means", "scales", "rotations", "logits", "harmonics"), np.split(found, [SCALE, ROTATION, OPACITY, HARMONICS], axis=1), wanted,
                                strict=True):  # fmt: skip
        assert leaf.grad is not None
        gradient = leaf.grad.reshape(len(part), -1).numpy()
        np.testing.assert_allclose(part, gradient, rtol=2e-3, atol=2e-4 * np.abs(gradient).max(), err_msg=name)


def test_what_cannot_be_seen_is_not_rendered_and_stays() -> None:
    view, gaussians = camera(), some_gaussians(3, 0)
    there = np.stack([view.centre - view.forward, view.centre + 30 * view.up + view.forward, view.centre]).astype(np.float32)
    rows, moments = begun(replace(gaussians, means=there, scales=np.full((3, 3), 0.1, np.float32)))
    colour, light = device.splat_image(rows, 0, lens_of(view), DEVICE)
    assert (colour == 0).all()
    assert (light == 1).all()
    fit = device.SplatFit(rows, moments, 0, DEVICE)
    fit.step(lens_of(view), picture_of(0, False), rates_of(0.0, 0.004))
    assert (fit.state().rows == rows).all()
    assert not fit.state().moments.any()


def test_gaussians_of_one_depth_are_in_the_order_of_their_numbers() -> None:
    twice = some_gaussians(20, 0).subset(np.tile(np.arange(20), 2))
    records, tiles, pairs = device.projected(device.columns_of(values_of(twice), DEVICE), lens_of(camera()), 0)
    depth, gaussian, begin = records[:, 11].tolist(), pairs.gaussian.tolist(), pairs.begin.tolist()
    assert begin[-1] == len(gaussian) == int(tiles.sum()) > 40
    for first, end in pairwise(begin):
        keys = [(depth[n], n) for n in gaussian[first:end]]
        assert keys == sorted(keys)


def test_the_loop_of_the_fit_divides_what_is_on_a_device(monkeypatch: pytest.MonkeyPatch) -> None:
    tree, cameras = ball(8, 0), ring(2, 16)
    views, gaussians = photographs(tree, cameras), merging.merged(tree, cameras, 20, 0)
    wanted = refitted(gaussians, views, 4, most=24)
    monkeypatch.setattr(refit, "splats_on", lambda name: device)
    found = refitted(gaussians, views, 4, most=24, device=DEVICE)
    assert len(found) == len(wanted) > len(gaussians)
    for name in vars(wanted):
        np.testing.assert_allclose(getattr(found, name), getattr(wanted, name), rtol=1e-2, atol=1e-3, err_msg=name)


@pytest.mark.gpu
def test_a_fit_on_a_device_ends_as_on_the_cpu() -> None:
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    tree, cameras = ball(24, 2), ring(8, 96)
    views, gaussians = photographs(tree, cameras), merging.merged(tree, cameras, 800, 2)
    ends = [refitted(gaussians, views, 120, most=1000, device=name) for name in ("cpu", "cuda")]
    assert error(ends[0], views) < 0.5 * error(gaussians, views)
    assert error(ends[1], views) == pytest.approx(error(ends[0], views), rel=0.05)
    for one, two in zip(render(ends[1], cameras[0], None, "cuda"), render(ends[1], cameras[0]), strict=True):
        np.testing.assert_allclose(one, two, atol=6e-3)  # where one of them leaves out an alpha of 1/255
