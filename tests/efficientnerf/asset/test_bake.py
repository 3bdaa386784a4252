"""From a field to a tree: which voxels are kept, and what is written into them."""

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from efficientnerf.asset.bake import Visibility, chosen_voxels, grid_of, visible_voxels, voxel_values
from efficientnerf.asset.queries import density_at
from efficientnerf.asset.tree import tree_from_voxels
from efficientnerf.fields.field import BakeableField
from efficientnerf.model import Model, render_rays
from efficientnerf.rendering.compositing import activate
from tests.efficientnerf.balls import BOUNDS, pixels, untrained


class Ball(BakeableField):
    """log density 5 in a ball of radius 0.5 round the world's origin, -12 outside; harmonics linear in the position. Grid coordinates of the box."""

    activation = "exp"
    degree = 1

    def forward(self, points: Tensor) -> Tensor:
        world = points * 2 - 1
        raw = torch.where(world.norm(dim=1) < 0.5, 5.0, -12.0)
        return torch.cat([raw[:, None], world.repeat(1, 4)], dim=1)


def model_of_a_ball(**changes: Any) -> Model:
    m = untrained(num_coarse_samples=64, **changes)
    m.coarse, m.fine = Ball(), Ball()
    return m


def greatest(count: int = 10**6, resolution: int = 16, **changes: Any) -> np.ndarray:
    shape, voxel = grid_of(BOUNDS, resolution, 4)
    return dense(visible_voxels(model_of_a_ball(**changes), pixels(8, 24), shape, voxel, BOUNDS[0], 4, count, lambda done, total: None), shape, 4)


def dense(seen: Visibility, shape: tuple[int, int, int], brick: int) -> np.ndarray:
    """The greatest weights as a plain grid."""
    out = np.zeros((*shape, brick, brick, brick), np.float32)
    out.reshape(-1, brick**3)[seen.cells] = seen.greatest
    return out.transpose(0, 3, 1, 4, 2, 5).reshape([n * brick for n in shape])


def sparse(weight: np.ndarray, brick: int) -> Visibility:
    """The inverse of `dense`, cells without any weight left out."""
    x, y, z = (n // brick for n in weight.shape)
    rows = weight.reshape(x, brick, y, brick, z, brick).transpose(0, 2, 4, 1, 3, 5).reshape(-1, brick**3)
    cells = np.flatnonzero(rows.any(axis=1))
    return Visibility(cells, rows[cells])


@pytest.mark.parametrize(("extent", "resolution", "brick"), [((0.7, 2, 1.1), 33, 5), ((1e-3, 1, 1), 8, 16)])
def test_cells_cover_the_box_and_no_more(extent: tuple[float, float, float], resolution: int, brick: int) -> None:
    bounds = np.array([[1.0, 2.0, 3.0], np.add(extent, (1, 2, 3))])
    shape, voxel = grid_of(bounds, resolution, brick)
    assert voxel == pytest.approx(max(extent) / resolution)
    covered = np.array(shape) * brick * voxel
    assert (covered >= np.array(extent) - 1e-6 * voxel).all()
    assert (covered - brick * voxel < np.array(extent)).all()


def test_visible_voxels_are_the_balls_skin() -> None:
    weight = greatest()
    centre = np.stack(np.meshgrid(*[np.arange(16) / 8 - 1 + 1 / 16] * 3, indexing="ij"), -1)
    away = np.linalg.norm(centre, axis=-1)
    assert weight.max() <= 1 + 1e-5
    assert not weight[away > 0.5 + 0.5 * 3**0.5 / 8 + 1e-6].any()
    skin = (away > 0.42) & (away < 0.5)
    assert (weight[skin] > 1e-3).mean() > 0.9
    assert weight[away < 0.2].max() < 1e-3  # nobody sees the inside


def test_masked_pixels_are_not_looked_at_and_progress_ends_at_its_total() -> None:
    some = pixels(8, 24)
    some.usable = np.packbits(np.arange(len(some)) < 7)
    shape, voxel = grid_of(BOUNDS, 16, 4)
    calls: list[tuple[int, int]] = []
    weight = visible_voxels(model_of_a_ball(), some, shape, voxel, BOUNDS[0], 4, 10**6, lambda done, total: calls.append((done, total)))
    assert not weight.greatest.any()  # a corner of one picture
    assert calls[-1] == (7, 7)


def test_chosen_voxels_are_those_above_the_threshold_and_their_neighbours() -> None:
    weight = np.zeros((8, 4, 4), np.float32)
    weight[5, 1, 2], weight[0, 0, 0], weight[3, 3, 3] = 0.5, 1e-3, 2e-3
    seen = sparse(weight, 4)
    plain = chosen_voxels(seen, (2, 1, 1), 4, 1e-3, 0)
    assert plain.tolist() == [[3, 3, 3], [5, 1, 2]]  # in the order of the grid; at the threshold is not above it
    grown = chosen_voxels(seen, (2, 1, 1), 4, 1e-3, 1)
    distance = np.abs(grown[:, None] - plain).max(2).min(1)
    assert distance.max() == 1
    assert len(np.unique(grown, axis=0)) == len(grown) == 27 + 12 - 2  # cut by the border, and two voxels belong to both
    assert not len(chosen_voxels(sparse(np.zeros((8, 4, 4), np.float32), 4), (2, 1, 1), 4, 1e-3, 2))


@pytest.mark.parametrize("dilate", [0, 2])
def test_growing_is_that_of_a_plain_grid(dilate: int) -> None:
    from scipy.ndimage import binary_dilation

    weight = np.random.default_rng(3).random((12, 9, 6)).astype(np.float32)
    kept = weight > 0.97
    wanted = np.argwhere(binary_dilation(kept, np.ones((3, 3, 3), bool), iterations=dilate) if dilate else kept)
    np.testing.assert_array_equal(chosen_voxels(sparse(weight, 3), (4, 3, 2), 3, 0.97, dilate), wanted)


def test_values_are_means_over_the_voxel() -> None:
    m = model_of_a_ball()
    indices = np.array([[8, 8, 8], [0, 0, 0], [11, 8, 8], [12, 9, 8]], np.int32)
    ((density, sh),) = voxel_values(m, indices, 1 / 8, BOUNDS[0], 256, 0)
    assert density.dtype == sh.dtype == np.float32
    assert sh.shape == (4, 4, 3)
    assert density[0] == pytest.approx(np.exp(5), rel=1e-5)
    assert density[1] == 0  # the coarse field says that there is nothing
    assert 0.5 * np.exp(5) < density[2] < np.exp(5)  # the surface passes through it
    # Coefficient k of channel c is raw[1 + 4c + k]; the network gives (x, y, z) over and over.
    centre = BOUNDS[0] + (indices[0] + 0.5) / 8
    expected = np.tile(centre, 4).reshape(3, 4).T
    np.testing.assert_allclose(sh[0], expected, atol=0.01)
    # Where half of a voxel is empty, its colour is that of the other half.
    assert sh[2, 0, 0] < BOUNDS[0][0] + 11.5 / 8 + 0.01


def test_nothing_is_baked_that_the_coarse_field_hides() -> None:
    m = model_of_a_ball()
    indices = np.array([[8, 8, 8], [7, 7, 7]], np.int32)
    ((before, _),) = voxel_values(m, indices, 1 / 8, BOUNDS[0], 4, 0)
    assert (before > 1).all()
    field = m.coarse
    m.coarse = type("Half", (BakeableField,), {"activation": "exp", "forward": lambda self, p: field(p) - 20.0 * (p[:, :1] > 0.5)})()
    ((after, _),) = voxel_values(m, indices, 1 / 8, BOUNDS[0], 4, 0)
    assert after.tolist() == [0, before[1]]


def test_nothing_is_baked_where_the_voxels_are_empty() -> None:
    m = untrained()
    indices = np.argwhere(np.ones((8, 8, 8), bool)).astype(np.int32)
    ((before, _),) = voxel_values(m, indices, 2 / 8, BOUNDS[0], 4, 0)
    half = m.voxels.side // 2
    m.voxels.values[:half] = m.voxels.threshold - 1
    ((after, _),) = voxel_values(m, indices, 2 / 8, BOUNDS[0], 4, 0)
    empty = indices[:, 0] < 4
    assert (before > 0).all()
    assert (after[empty] == 0).all()
    np.testing.assert_array_equal(after[~empty], before[~empty])


@pytest.mark.parametrize("field", ["hash", "mlp"])
def test_what_was_trained_on_voxel_centres_is_baked_as_it_is(field: str) -> None:
    """The nearest voxel's density is what the network said of the sample, whichever of the voxel's points that was."""
    side = 24
    m = untrained(field=field, discretise=side, occupancy_rule="momentum", pivotal_threshold=0.0)
    for parameter in m.fine.parameters():  # so that it differs from place to place
        torch.nn.init.normal_(parameter, std=0.5, generator=torch.Generator().manual_seed(1))
    bundle = pixels(2, 24).bundle(np.arange(2 * 24 * 24))
    origins, directions, near, far = (torch.from_numpy(np.ascontiguousarray(a)) for a in bundle[:4])
    with torch.no_grad():
        seen = render_rays(m, origins, directions, near, far, torch.full_like(near, 0.3), m.behind(directions))
    said = activate(seen.fine_raw[:, 0], m.fine.activation).numpy()
    shape, voxel = grid_of(BOUNDS, side, 4)
    indices = np.argwhere(np.ones([n * 4 for n in shape], bool)).astype(np.int32)
    density, sh = (np.concatenate(part) for part in zip(*voxel_values(m, indices, voxel, BOUNDS[0], 0, 0), strict=True))
    tree = tree_from_voxels(shape, voxel, BOUNDS[0], indices, density, sh, lookup="nearest")
    at = m.space.world(seen.fine.point).numpy().astype(np.float64)
    local = (at - BOUNDS[0]) / voxel
    sure = (np.abs(local - np.round(local)) > 1e-4).all(axis=1)  # at a face rounding decides
    assert sure.sum() > 1000
    assert sure.mean() > 0.99
    assert said.std() > 0.1 * said.mean() > 0
    np.testing.assert_allclose(density_at(tree, at[sure]), said[sure], rtol=1e-4, atol=1e-6)
    # Several points of a voxel would say nothing else.
    (few, _), *_ = voxel_values(m, indices[:300], voxel, BOUNDS[0], 5, 0)
    np.testing.assert_allclose(few, density[:300], rtol=1e-4, atol=1e-6)
    # The network that is asked for the samples themselves would.
    with torch.no_grad():
        free = activate(m.fine(seen.fine.point)[:, 0], m.fine.activation).numpy()
    assert np.abs(free - said)[sure].max() > 0.1 * said.mean()
