"""From trees to Gaussians: what is merged, and that fitting brings it nearer to the pictures."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from efficientnerf.asset.cascades import cascades_of
from efficientnerf.asset.rendering import render as render_tree
from efficientnerf.asset.tree import NerfTree, tree_from_voxels
from efficientnerf.backends.splat_layout import SplatState
from efficientnerf.geometry.cameras import Camera
from efficientnerf.geometry.ndc import Ndc
from efficientnerf.rendering import environment
from efficientnerf.rendering.halving import halved
from efficientnerf.rendering.harmonics import C0, basis_numpy
from efficientnerf.splats import build, merging, refit
from efficientnerf.splats.build import Budget, View, gaussians_of_asset
from efficientnerf.splats.gaussians import Gaussians, rotation_matrices
from efficientnerf.splats.refit import refitted
from efficientnerf.splats.rendering import gaussians_from, lens_of, render, values_of
from tests.efficientnerf.splats_balls import ball, error, photographs, ring
from tests.efficientnerf.trees import random_cascades


def test_gaussians_of_a_ball_lie_flat_on_it_in_its_colours_as_many_as_wanted() -> None:
    tree = ball()
    gaussians = merging.merged(tree, ring(6), 300, 1)
    assert 200 < len(gaussians) <= 300
    far = np.linalg.norm(gaussians.means, axis=1)
    assert (np.abs(far - 0.78) < 0.1).mean() > 0.95
    axes = rotation_matrices(gaussians.rotations)
    thinnest = axes[np.arange(len(gaussians)), :, np.argmin(gaussians.scales, axis=1)]
    along = np.abs((thinnest * gaussians.means).sum(axis=1) / far)
    assert np.median(along) > 0.95
    clear = np.abs(gaussians.means[:, 0]) > 0.15
    colours = 0.5 + C0 * gaussians.harmonics[clear, 0]
    wanted = np.where(gaussians.means[clear, :1] > 0, 1.0, -1.0) * [1, -1, 0] * 2
    np.testing.assert_allclose(colours[:, :2], 1 / (1 + np.exp(-wanted[:, :2])), atol=0.02)


def test_fitting_brings_gaussians_nearer_to_pictures_held_back() -> None:
    tree, cameras = ball(16), ring(12)
    views = photographs(tree, cameras)
    seen, held_back = views[::2], views[1::2]
    said: list[tuple[int, int, str]] = []
    merely = gaussians_of_asset(tree, seen, Budget(count=250, degree=1, steps=0))
    fitted = gaussians_of_asset(tree, seen, Budget(count=250, degree=1, steps=40), lambda done, total, text: said.append((done, total, text)))
    assert error(fitted, seen) < 0.6 * error(merely, seen)
    assert error(fitted, held_back) < 0.9 * error(merely, held_back)
    assert [done for done, _, _ in said] == [0, 1, *range(2, 42)]
    assert {total for _, total, _ in said} == {41}


def test_colours_are_those_of_the_asset_from_all_directions() -> None:
    rng, degree = np.random.default_rng(0), 2
    tree = ball(degree=degree)
    tree = replace(tree, harmonics=rng.normal(0, 0.5, tree.sh.shape).astype(np.float32))
    shown = merging.shown_voxels(tree, ring(4))
    begin = np.arange(len(shown.voxels) + 1)
    out = np.empty((len(shown.voxels), 9, 3), np.float32)
    merging._convert(tree, shown, begin, shown.pixels, out, degree)
    directions = rng.normal(size=(200, 3))
    basis = basis_numpy(directions / np.linalg.norm(directions, axis=1, keepdims=True), degree)
    wanted = 1 / (1 + np.exp(-np.einsum("dk,nkc->ndc", basis, tree.sh[shown.voxels])))
    off = 0.5 + np.einsum("dk,nkc->ndc", basis, out) - wanted
    assert np.sqrt(np.square(off).mean()) < 0.02
    assert np.abs(off).max() < 0.15


def test_cells_that_lose_little_are_merged_before_those_that_lose_much() -> None:
    tree = ball()
    shown = merging.shown_voxels(tree, ring(6))
    rng = np.random.default_rng(0)
    rough = shown.centres[:, 0] > 0
    colours = np.where(rough[:, None], rng.random((len(rough), 3)), 0.5)
    counts = [len(merging.cells_of(shown, colours, most)) - 1 for most in (50, 400, 10**6, 1, 5)]
    assert 25 < counts[0] <= 50
    assert 350 < counts[1] <= 400
    assert counts[2:4] == [len(shown.voxels), 1]
    assert 1 <= counts[4] <= 5
    begin = merging.cells_of(shown, colours, 400)
    assert (np.diff(begin) > 0).all()
    assert begin[0] == 0
    assert begin[-1] == len(rough)
    on_rough = rough[begin[:-1]]
    assert on_rough.sum() > 3 * (~on_rough).sum()


def forward_facing() -> tuple[NerfTree, Camera]:
    """A plane in front of a camera, red and black."""
    at = np.eye(4)
    ndc = Ndc(at, 30.0, 24.0, 24.0, 1.0)
    size, brick = 32, 4
    indices = np.argwhere(np.ones((size, size, 2), bool)) + np.array([0, 0, 22])
    sh = np.zeros((len(indices), 1, 3), np.float32)
    sh[:, 0, 0] = np.where((indices[:, 0] // 8 + indices[:, 1] // 8) % 2, 3, -3) / C0
    voxel = 2 / size
    tree = tree_from_voxels((size // brick,) * 3, voxel, np.full(3, -1.0), indices, np.full(len(indices), 5 / voxel, np.float32), sh, ndc=ndc)
    return tree, Camera("front", 24, 24, "SIMPLE_PINHOLE", (30.0, 12.0, 12.0), at)


def test_gaussians_of_normalised_device_coordinates_lie_in_the_world() -> None:
    tree, camera = forward_facing()
    moved = camera.world_from_camera.copy()
    moved[:2, 3] = 0.2, 0.1
    beside = replace(camera, world_from_camera=moved)
    gaussians = merging.merged(tree, [camera, beside], 1100, 0)
    depth = tree.ndc.world(np.array([[0.0, 0.0, 23 / 16 - 1]]))[0, 2]
    assert np.abs(gaussians.means[:, 2] - depth).max() < 0.1 * depth
    for view in (camera, beside):
        wanted, found = render_tree(tree, view, background=(0, 0, 0)).colour, render(gaussians, view, (0, 0, 0))
        off = np.abs(found.colour - wanted)[3:-3, 3:-3]  # neighbours of another colour mix into a pixel
        assert np.median(off[..., 0]) < 0.07
        assert off[..., 1:].max() < 0.02
        assert found.opacity[3:-3, 3:-3].min() > 0.95


def test_whole_scenes_have_their_cascades_and_a_shell_of_their_environment() -> None:
    tree = random_cascades(count=2, degree=0)
    bounds = cascades_of(tree)[0].bounds(tree.brick)
    cameras = [replace(camera, world_from_camera=camera.world_from_camera + np.pad(bounds.mean(axis=0)[:, None], ((0, 1), (3, 0)))) for camera in ring(5)]
    gaussians = merging.merged(tree, cameras, 1500, 1)
    assert len(gaussians) <= 1500
    inside = ((gaussians.means >= bounds[0]) & (gaussians.means <= bounds[1])).all(axis=1)
    away = np.linalg.norm(gaussians.means - bounds.mean(axis=0), axis=1) > 10 * np.linalg.norm(bounds[1] - bounds[0])
    assert inside.sum() > 50
    assert (~inside & ~away).sum() > 50
    assert away.sum() == 75
    outward = Camera("out", 16, 16, "SIMPLE_PINHOLE", (20.0, 8.0, 8.0), cameras[0].world_from_camera @ np.diag([-1.0, 1, -1, 1]))
    assert render(gaussians, outward).opacity.min() > 0.9


def test_gaps_that_fitting_leaves_in_the_environment_are_filled_from_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    tree, cameras = random_cascades(count=2, degree=0), ring(3)
    views = [View(camera, np.full((camera.height, camera.width, 3), 128, np.uint8)) for camera in cameras]
    monkeypatch.setattr(build, "refitted", lambda gaussians, *_args, **_options: gaussians.subset(np.arange(len(gaussians)) < 10))
    fitted = gaussians_of_asset(tree, views, Budget(count=30_000, degree=1, steps=1))
    outward = Camera("out", 64, 64, "SIMPLE_PINHOLE", (32.0, 32.0, 32.0), cameras[0].world_from_camera @ np.diag([-1.0, 1, -1, 1]))
    seen = render(fitted, outward)
    assert len(fitted) == 10 + 300
    assert seen.opacity.min() > 0.9
    assert tree.environment is not None
    wanted = environment.lookup(tree.environment, outward.world_from_camera[None, :3, 2])
    np.testing.assert_allclose(seen.colour[30:34, 30:34].mean(axis=(0, 1)), wanted[0], atol=0.1)


def test_the_same_pictures_give_the_same_bytes_and_what_cannot_be_seen_stays() -> None:
    tree, cameras = ball(16, 0), ring(3)
    views = photographs(tree, cameras)
    begun = merging.merged(tree, cameras, 150, 0)
    behind = replace(begun.subset(np.arange(1)), means=np.array([[50, 50, 50]], np.float32))
    begun = Gaussians(*(np.concatenate([getattr(begun, name), getattr(behind, name)]) for name in vars(begun)))
    one, two = refitted(begun, views, 5), refitted(begun, views, 5)
    assert one.means.tobytes() == two.means.tobytes()
    assert one.harmonics.tobytes() == two.harmonics.tobytes()
    assert (one.means[-1] == begun.means[-1]).all()
    assert np.abs(one.means[:-1] - begun.means[: len(one) - 1]).max() > 0


def test_the_refit_ends_with_its_time_and_learning_rates_and_divisions_follow_it() -> None:
    """With time for all steps, the bytes are those without a limit."""
    views = photographs(ball(16, 0), ring(3))
    begun = merging.merged(ball(16, 0), ring(3), 100, 0)

    def run(a_step: float, steps: int = 40) -> tuple[Gaussians, int]:
        clock, taken = itertools.count(), []
        found = refitted(begun, views, steps, most=150, reached=taken.append, time_used=lambda: next(clock) * a_step)
        return found, len(taken)

    (ample, all_steps), (short, some), (none, no_steps) = run(0.0), run(1 / 12), run(2.0)
    assert (all_steps, some, no_steps) == (40, 11, 0)
    assert ample.means.tobytes() == refitted(begun, views, 40, most=150).means.tobytes()
    assert len(short) > len(begun) >= len(none), "they are divided although a quarter of 40 steps is all that was taken"


@pytest.mark.parametrize(("channels", "count", "rate"), [(3, 5, 0.001), (3, 80, 0.001), (3, 160, 0.002), (3, 1000, 0.003), (4, 5, 0.004)])
def test_few_photographs_move_view_dependence_less_than_many_and_than_pictures_with_alpha(channels: int, count: int, rate: float) -> None:
    camera = Camera("view", 4, 3, "SIMPLE_PINHOLE", (4.0, 2.0, 1.5), np.eye(4))
    views = [refit.View(camera, np.zeros((3, 4, channels), np.uint8))] * count
    assert refit.harmonics_rate(views) == pytest.approx(rate)


def test_large_pictures_are_taken_in_bands_that_show_what_the_whole_shows(monkeypatch: pytest.MonkeyPatch) -> None:
    view = photographs(ball(16, 0), ring(1, 50))[0]
    view = replace(view, mask=np.arange(2500).reshape(50, 50) % 3 > 0)
    assert refit._band(view, np.random.default_rng(0)) is view
    monkeypatch.setattr(refit, "PIXELS", 50 * 16)
    gaussians, met = merging.merged(ball(16, 0), [view.camera], 200, 0), np.zeros(50, int)
    whole = render(gaussians, view.camera)
    for seed in range(40):
        band = refit._band(view, np.random.default_rng(seed))
        assert band.pixels.shape == (16, 50, 4)
        begin = round(view.camera.params[2] - band.camera.params[2])
        assert (band.pixels == view.pixels[begin : begin + 16]).all()
        assert band.mask is not None
        assert (band.mask == view.mask[begin : begin + 16]).all()
        assert (lens_of(band.camera, view.camera).limits == lens_of(view.camera).limits).all()
        np.testing.assert_allclose(render(gaussians, band.camera).colour, whole.colour[begin : begin + 16], atol=0.02)
        met[begin : begin + 16] += 1
    assert met.min() > 0


def test_large_pictures_are_taken_at_half_their_size_first(monkeypatch: pytest.MonkeyPatch) -> None:
    views, taken = photographs(ball(16, 0), ring(3)), list[Camera]()
    begun = merging.merged(ball(16, 0), ring(3), 100, 0)
    monkeypatch.setattr(refit, "halved", lambda camera, *rest: taken.append(camera) or halved(camera, *rest))
    refitted(begun, views, 20)
    assert not taken
    monkeypatch.setattr(refit, "COARSE_PIXELS", 1)
    refitted(begun, views, 20)
    assert len(taken) == 6, "of 20 steps the first are done by 0 to 5/19"


def test_gaussians_are_divided_by_error_and_faint_ones_go() -> None:
    begun = merging.merged(ball(16, 0), ring(3), 100, 0)
    count = len(begun)
    faint = np.where(np.arange(count) < 5, np.float32(0.003), begun.opacities)
    begun = replace(begun, opacities=faint)
    errors = np.zeros(count, np.float32)
    errors[[2, 20, 30]] = 9, 2, 3
    errors[40] = 1
    moments = np.ones((count, 30), np.float32)
    values, moments = refit._divided(SplatState(values_of(begun), moments, errors), count - 5 + 2)
    assert len(values) == len(moments) == count - 5 + 2
    after = gaussians_from(values)
    halves = np.flatnonzero((moments == 0).all(axis=1))
    assert halves.tolist() == [15, 16, 26, 27]
    np.testing.assert_allclose(after.means[halves].reshape(2, 2, 3).mean(axis=1), begun.means[[20, 30]], atol=1e-6)
    longest = begun.scales[[20, 30]].max(axis=1)
    np.testing.assert_allclose(np.linalg.norm(after.means[[15, 26]] - after.means[[16, 27]], axis=1), 2 * refit.SPLIT_APART * longest, rtol=1e-4)
    next_to = np.sort(begun.scales[[20, 30]], axis=1)[:, 1]
    np.testing.assert_allclose(after.scales.max(axis=1)[[15, 26]], np.maximum(refit.SPLIT_SHARE * longest, next_to), rtol=1e-4)
    kept = np.setdiff1d(np.arange(5, count), [20, 30])
    np.testing.assert_allclose(after.means[np.setdiff1d(np.arange(len(values)), halves)], begun.means[kept], atol=1e-7)


def test_the_most_transparent_give_way_to_halves_where_the_error_is() -> None:
    begun = merging.merged(ball(16, 0), ring(3), 100, 0)
    count = len(begun)
    begun = replace(begun, opacities=np.linspace(0.9, 0.1, count, dtype=np.float32))
    errors = np.zeros(count, np.float32)
    errors[:20] = errors[-1] = 1  # that of one that is left out does not count
    moments = np.ones((count, 30), np.float32)
    values, moments = refit._divided(SplatState(values_of(begun), moments, errors), count, 0.1)
    gone = int(0.1 * count)
    assert len(values) == count
    assert (moments == 0).all(axis=1).sum() == 2 * gone
    np.testing.assert_allclose(gaussians_from(values).means[2 * gone :], begun.means[gone : count - gone], atol=1e-7)
