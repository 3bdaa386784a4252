"""What a field shows along training rays: which voxels of nested grids it needs, where rays end, what lies beyond, and the tree that is made of it."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from efficientnerf.asset.bake import chosen_voxels, spread_pixels, voxel_values
from efficientnerf.asset.cascades import cascade_grids, nested, voxel_coordinates
from efficientnerf.asset.components import unsupported_components
from efficientnerf.asset.field_samples import (
    PAST_BORDERS,
    FieldSamples,
    cascade_visibility,
    density_as_seen,
    environment_beyond,
    field_samples,
    seen_weights,
    surface_points,
)
from efficientnerf.asset.rendering import render_rays
from efficientnerf.asset.tree import NerfTree, tree_from_voxels
from efficientnerf.geometry.cameras import project
from efficientnerf.model import Model
from efficientnerf.model import render_rays as model_rays
from efficientnerf.rendering import environment
from efficientnerf.training.pixels import Pixels
from tests.efficientnerf.surroundings import GROUND, RADIUS, WALL, around, photographs, surroundings

BOX = np.array([[-0.8] * 3, [0.8] * 3])
BRICK = 4
Made = tuple[Model, Pixels, FieldSamples]


@pytest.fixture(scope="module")
def made() -> Made:
    m, cameras = surroundings(), around()
    pixels = Pixels(cameras, photographs(m, cameras), [None] * len(cameras), np.full(len(cameras), 0.2), np.full(len(cameras), 60.0))
    return m, pixels, field_samples(m, pixels, 10**6, 1e-3, lambda done, total: None)


def boxes(count: int, voxel: float = 0.05) -> list[np.ndarray]:
    return [grid.bounds(BRICK) for grid in cascade_grids(BOX, voxel, BRICK, count)]


def test_the_samples_are_those_of_the_pixels(made: Made) -> None:
    _, pixels, samples = made
    np.testing.assert_array_equal(samples.pixel, spread_pixels(pixels, 10**6))
    ray = np.repeat(np.arange(len(samples.pixel)), np.diff(samples.first))
    total = np.bincount(ray, weights=samples.weight, minlength=len(samples.pixel))
    np.testing.assert_allclose(total, samples.opacity, atol=0.03)  # light ones are left out
    assert (samples.weight > 1e-3).all()
    assert len(samples.first) == len(samples.pixel) + 1
    some = surface_points(samples)
    hit = np.isfinite(some).all(axis=1)
    assert 0.5 < hit.mean() < 0.98
    np.testing.assert_array_equal(hit, np.bincount(ray, weights=samples.weight, minlength=len(hit)) >= 0.5)
    away = np.abs(np.linalg.norm(some[hit], axis=1) - RADIUS)
    plan = np.linalg.norm(some[hit][:, :2], axis=1)
    on_something = (away < 0.1) | (np.abs(some[hit][:, 2] - GROUND) < 0.3) | ((plan > WALL - 0.5) & (plan < WALL + 1.5))
    assert on_something.mean() > 0.97
    assert (away < 0.05).any()
    assert (plan > WALL - 0.5).any()


def test_voxels_weigh_what_passes_through_them(made: Made) -> None:
    """Against a loop over samples in plain Python."""
    _, _, every = made
    begin = 5 * 32 * 32 + 14 * 32  # of the sixth view: wall, ball and ground
    end = begin + 6 * 32
    grids = cascade_grids(BOX, 0.05, BRICK, 3)
    wanted: dict[tuple[int, ...], float] = {}
    for ray in range(begin, end):
        for n in range(every.first[ray], every.first[ray + 1]):
            for cascade, (shape, voxel, low) in enumerate(grids):
                depth = float(every.thickness[n])
                pieces = max(1, min(64, int(np.ceil(every.extent[n] / voxel))))
                for k in range(pieces):
                    share = float(every.weight[n]) / -np.expm1(-depth) * (np.exp(-depth * k / pieces) - np.exp(-depth * (k + 1) / pieces))
                    at = every.origin[every.view[ray]] + (every.start[n] + (k + 0.5) / pieces * every.extent[n]) * every.direction[ray].astype(np.float64)
                    inner = cascade and (at >= boxes(3)[cascade - 1][0]).all() and (at < boxes(3)[cascade - 1][1]).all()
                    index = np.floor((at - low) / voxel).astype(int)
                    if share <= 1e-3 or inner or (index < 0).any() or (index >= np.array(shape) * BRICK).any():
                        continue
                    key = (cascade, *index.tolist())
                    wanted[key] = max(wanted.get(key, 0.0), share)
    found = {}
    for cascade, (seen, (shape, _, _)) in enumerate(zip(cascade_visibility(every.part(begin, end), grids, BRICK, 1e-3), grids, strict=True)):
        row, local = np.nonzero(seen.greatest)
        cell = np.stack(np.unravel_index(seen.cells[row], shape), axis=-1) * BRICK + np.stack(np.unravel_index(local, (BRICK,) * 3), axis=-1)
        found |= {(cascade, *at): float(w) for at, w in zip(cell.tolist(), seen.greatest[row, local], strict=True)}
    assert {key[0] for key in wanted} == {0, 1, 2}
    assert len(set(found) ^ set(wanted)) <= 0.01 * len(wanted)  # rounding decides at faces
    both = sorted(set(found) & set(wanted))
    np.testing.assert_allclose([found[key] for key in both], [wanted[key] for key in both], rtol=0.02, atol=1e-4)


def baked(made: Made, count: int = 4, voxel: float = 0.05) -> NerfTree:
    m, _, samples = made
    grids = cascade_grids(BOX, voxel, BRICK, count)
    trees = []
    for seen, (shape, side, low) in zip(cascade_visibility(samples, grids, BRICK, 1e-3), grids, strict=True):
        indices = chosen_voxels(seen, shape, BRICK, 1e-3, 1)
        density, sh = (np.concatenate(part) for part in zip(*voxel_values(m, indices, side, low, 4, 0), strict=True))
        weights = seen_weights(seen, indices, shape, BRICK)
        assert (weights[:, 1] > 0).all()
        assert ((weights[:, 0] <= weights[:, 1]) & (weights <= 1).all(axis=1)).all()
        trees.append(tree_from_voxels(shape, side, low, indices, density_as_seen(density, weights, side), sh, brick=BRICK))
    return nested(trees, environment_beyond(samples, boxes(count, voxel), 16, np.full(3, 0.5)))


def test_the_tree_shows_the_whole_scene_without_a_crack_at_its_borders(made: Made) -> None:
    """Every ray that the field is opaque on ends, those that end at borders between boxes too, and colours are the field's."""
    _, pixels, samples = made
    tree = baked(made)
    origins, directions = samples.origin[samples.view].astype(np.float64), samples.direction.astype(np.float64)
    seen = render_rays(tree, origins, directions)
    opaque = samples.opacity > 0.95
    assert (seen.opacity[opaque] < 0.5).mean() < 0.005
    ends = surface_points(samples)
    near_border = np.zeros(len(ends), bool)
    for n, box in enumerate(boxes(3)):
        near_border |= (np.abs(np.abs(np.where(np.isfinite(ends), ends, 99.0) - box.mean(axis=0)) - (box[1] - box[0]) / 2) < 0.1 * 2**n).any(axis=1)
    assert (near_border & opaque).sum() > 100
    assert (seen.opacity[near_border & opaque] < 0.9).mean() < 0.04
    truth = pixels.images[samples.pixel] / 255.0
    assert np.sqrt(((seen.colour - truth) ** 2).mean()) < 0.12
    alone = render_rays(replace(tree, outer=(), environment=None), origins, directions)
    assert (alone.opacity[opaque] < 0.5).mean() > 0.2  # as before, without what lies around


def test_a_map_keeps_what_is_known_and_spreads_it() -> None:
    weight = np.zeros((8, 16))
    weight[3, 0] = weight[5, 8] = 1e4
    colour = np.zeros((8, 16, 3))
    colour[3, 0], colour[5, 8] = 1.0, 0.2
    found = environment.filled(colour * weight[..., None], weight, np.zeros(3))
    np.testing.assert_allclose(found[[3, 5], [0, 8]], [[1] * 3, [0.2] * 3], atol=1e-2)
    assert ((found >= 0.2 - 1e-6) & (found <= 1)).all()
    assert found[3, 15, 0] > 0.8  # columns wrap
    assert found[3, 1, 0] == pytest.approx(found[3, 15, 0], abs=1e-5)


def test_small_parts_go_unless_three_photographs_show_them(made: Made) -> None:
    """A speck in the air that nobody sees is dropped; the same where rays of three views end stays."""
    _, _, samples = made
    tree = baked(made)
    assert not unsupported_components(tree, np.ones(len(tree.density_values), bool), 1.0, samples)[: len(tree.density_values) // 10].all()
    shape, voxel, low = tree.shape, tree.voxel, tree.bounds_min
    high = np.array(tree.resolution) - 2
    alone = tree_from_voxels(shape, voxel, low, high[None], np.ones(1), np.zeros((1, 1, 3)), brick=BRICK)
    solid = tree_from_voxels(shape, voxel, low, np.argwhere(np.ones((12, 12, 12), bool)), np.ones(1728), np.zeros((1728, 1, 3)), brick=BRICK)
    at = low + (high + 0.5) * voxel

    def seen_by(views: int, of: int = 4) -> FieldSamples:
        """Rays of the first of a capture's views that end in the speck."""
        count = max(1, views)
        away = np.tile([0.0, 0.0, 1.0], (count, 1)).astype(np.float32)
        shade, ones = np.zeros((count, 3), np.uint8), np.ones(count, np.float32)
        origin = np.tile((at - away[0]).astype(np.float32), (of, 1))
        return FieldSamples(
            np.arange(count), np.arange(count, dtype=np.int32), origin, away, ones, np.zeros((count, 3), np.float16),
            np.arange(count + 1), ones * np.float32(0.99 if views else 0.2), ones * np.float32(0.02), ones, ones * np.float32(9), shade,
        )  # fmt: skip

    corner = low - np.array(tree.resolution) * voxel / 2
    far = tree_from_voxels(shape, 2 * voxel, corner, np.zeros((1, 3), int), np.ones(1), np.zeros((1, 1, 3)), brick=BRICK)
    both = tree_from_voxels(
        shape, voxel, low, np.concatenate([voxel_coordinates(solid), voxel_coordinates(alone)]), np.ones(1729), np.zeros((1729, 1, 3)), brick=BRICK
    )
    scene = nested([both, far])
    speck = (voxel_coordinates(scene) == high).all(axis=1)
    keep = np.ones(1730, bool)
    assert speck.sum() == 1
    for views, dropped in ((0, True), (2, True), (3, False)):
        assert unsupported_components(scene, keep, 0.02, seen_by(views))[speck].all() == dropped
    for views, of, dropped in ((1, 2, True), (2, 2, False), (0, 1, True), (1, 1, False)):  # all the photographs that there are
        assert unsupported_components(scene, keep, 0.02, seen_by(views, of))[speck].all() == dropped
    assert not unsupported_components(scene, keep, 0.0, seen_by(0)).any()
    assert unsupported_components(scene, keep, 0.02, seen_by(0)).sum() == 1  # the far voxel stays, though nobody's ray ends there


def test_rays_past_the_borders_of_images_come_last_and_show_what_lies_there(made: Made) -> None:
    m, pixels, samples = made
    cameras = around()
    every = field_samples(m, pixels, 10**6, 1e-3, lambda done, total: None, cameras, 3000)
    for name in vars(samples):
        np.testing.assert_array_equal(getattr(every.training, name), getattr(samples, name))
    past = every.past_borders
    assert 0.8 * 3000 < len(past.pixel) < 1.2 * 3000
    np.testing.assert_array_equal(past.pixel, -1 - past.view)
    assert set(past.view.tolist()) == set(range(len(cameras)))
    for number, camera in enumerate(cameras):
        rays = past.view == number
        place = project(camera, camera.centre + past.direction[rays].astype(np.float64))[0] / (camera.width, camera.height)
        assert ((place < 1e-4) | (place > 1 - 1e-4)).any(axis=1).all()
        assert np.abs(place - 0.5).max() < 0.5 + PAST_BORDERS + 1e-4
    bundle = (pixels.centre[past.view], past.direction, np.full(len(past.view), 0.2, np.float32), np.full(len(past.view), 60.0, np.float32))
    origins, directions, near, far = (torch.from_numpy(np.ascontiguousarray(part, np.float32)) for part in bundle)
    slant = torch.from_numpy(np.array([camera.forward for camera in cameras], np.float32)[past.view]).mul(directions).sum(dim=1)
    seen = model_rays(m, origins, directions, near / slant, far / slant, torch.full_like(near, 0.5), m.behind(directions))
    np.testing.assert_allclose(past.opacity, seen.fine_opacity.detach(), atol=1e-3)
