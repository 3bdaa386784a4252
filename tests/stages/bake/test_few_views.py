"""In forward-facing scenes what few photographs show is baked and kept where it is faint, and what many show where it is not."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from efficientnerf.asset.bake import Visibility, chosen_voxels, grid_of
from efficientnerf.asset.cascades import voxel_coordinates
from efficientnerf.asset.refinement.state import initial_state
from efficientnerf.asset.tree import NerfTree, tree_from_voxels
from efficientnerf.geometry.ndc import Ndc
from efficientnerf.geometry.spaces import NdcSpace
from efficientnerf.model import model
from pipeline.stage import Job
from stages.bake import pruning
from stages.bake.plan import bake_plan
from stages.bake.settings import BakeSettings
from stages.bake.voxels import FEW_VIEWS_RATIO, WELL_SEEN_VIEWS, by_views, seen_by_few
from stages.framing.scene_bounds import in_view, shows
from stages.framing.view_coverage import count_views
from stages.io.field_file import space_of
from stages.io.scene import Scene
from tests.efficientnerf.balls import settings
from tests.stages.balls import job
from tests.stages.forward_facing import forward_facing

THRESHOLD = 1e-3  # 2 and 20 times this are between it and what voxels that many see have to weigh; 40 times is above
BRICK = 4


@pytest.fixture(scope="module")
def capture() -> tuple[Scene, NdcSpace, tuple[int, int, int], float]:
    """Nine cameras, and a grid of voxels deeper than wide before them."""
    s = forward_facing(100)
    space = space_of(s)
    assert isinstance(space, NdcSpace)
    deep = space.with_voxel_depth(2.0)
    return s, deep, *grid_of(deep.bounds, 48, BRICK)


def few_by_projection(s: Scene, ndc: Ndc, points: np.ndarray) -> np.ndarray:
    found: np.ndarray = in_view(ndc.world(points), [view.camera for view in s.views]).sum(axis=0) < WELL_SEEN_VIEWS
    return found


def made(folder: Path) -> Job:
    return job(folder, BakeSettings(), poses=folder)


def test_views_are_counted_as_they_show_points() -> None:
    s = forward_facing(64)
    rng = np.random.default_rng(0)
    points = rng.uniform([-6, 1, -5], [6, 30, 5], (400, 3))
    cameras = [view.camera for view in s.views]
    count = count_views(points, cameras)
    np.testing.assert_array_equal(count, in_view(points, cameras).sum(axis=0))
    assert set(range(len(cameras) + 1)) == set(count.tolist())
    masks = [None if n % 3 else rng.random((24, 32)) < 0.5 for n in range(len(cameras))]
    seen = count_views(points, cameras, masks)
    np.testing.assert_array_equal(seen, sum(shows(points, camera, mask).astype(int) for camera, mask in zip(cameras, masks, strict=True)))
    assert (seen <= count).all()
    assert seen.sum() < count.sum()


def test_weights_count_by_the_views_of_their_cells(capture: tuple[Scene, NdcSpace, tuple[int, int, int], float], tmp_path: Path) -> None:
    s, space, shape, voxel = capture
    rng = np.random.default_rng(1)
    cells = np.flatnonzero(rng.random(int(np.prod(shape))) < 0.7)
    given = Visibility(cells, rng.choice([0.5, 2.0, 20.0, 40.0], (len(cells), BRICK**3)).astype(np.float32) * np.float32(THRESHOLD))
    found = by_views(made(tmp_path), s, given, shape, voxel, space)
    centre = (np.stack(np.unravel_index(cells, shape), -1) + 0.5) * (BRICK * voxel) + space.bounds[0]
    few = few_by_projection(s, space.ndc, centre)
    assert 0.05 < few.mean() < 0.95
    np.testing.assert_array_equal(found.cells, cells)
    np.testing.assert_array_equal(found.greatest[few], given.greatest[few])
    # So a voxel that many see is chosen where it weighs so many times the threshold, and no other way.
    chosen = chosen_voxels(found, shape, BRICK, THRESHOLD, 0)
    wanted = given.greatest > np.where(few, 1, FEW_VIEWS_RATIO)[:, None] * THRESHOLD
    assert len(chosen) == wanted.sum()
    assert {tuple(cell) for cell in chosen // BRICK} == {tuple(cell) for cell in np.stack(np.unravel_index(cells[wanted.any(1)], shape), -1)}


def tree_of(capture: tuple[Scene, NdcSpace, tuple[int, int, int], float]) -> NerfTree:
    _, space, shape, voxel = capture
    rng = np.random.default_rng(2)
    indices = np.argwhere(rng.random(tuple(side * BRICK for side in shape)) < 0.1)
    density, sh = rng.random(len(indices), np.float32), rng.random((len(indices), 1, 3), np.float32)
    return tree_from_voxels(shape, voxel, space.bounds[0], indices, density, sh, brick=BRICK, ndc=space.ndc)


@pytest.mark.parametrize("most", [10**6, 500])
def test_what_few_views_show_is_dropped_last(
    capture: tuple[Scene, NdcSpace, tuple[int, int, int], float], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, most: int
) -> None:
    s, _, _, voxel = capture
    s, tree = replace(s, background=(0.0, 0.0, 0.0)), replace(tree_of(capture), background=(0.0, 0.0, 0.0))
    assert tree.ndc is not None
    coordinates = voxel_coordinates(tree)
    few = few_by_projection(s, tree.ndc, (coordinates // BRICK + 0.5) * (BRICK * voxel) + tree.bounds_min)
    np.testing.assert_array_equal(np.sort(pruning.of_few_views(made(tmp_path), s, tree)), np.flatnonzero(few))
    np.testing.assert_array_equal(few, seen_by_few(made(tmp_path), s, tree.ndc, (coordinates // BRICK + 0.5) * (BRICK * voxel) + tree.bounds_min))
    weights = np.random.default_rng(3).uniform(0, 2 * THRESHOLD, len(few)).astype(np.float32)
    monkeypatch.setattr(pruning, "greatest_weights", lambda *_: weights.copy())
    plan = bake_plan(BakeSettings(), model(space_of(s), settings(), None), s, "cpu", 2)
    state, _, kept = pruning.prune(made(tmp_path), s, plan, initial_state(tree), None, most)  # type: ignore[arg-type]
    counted = np.where(few, FEW_VIEWS_RATIO, 1) * weights
    keep = counted > THRESHOLD
    if keep.sum() > most:
        keep &= counted >= np.sort(counted)[-most]
    assert (keep & few).any()
    np.testing.assert_array_equal(kept, keep)
    assert {tuple(at) for at in voxel_coordinates(state.tree)} == {tuple(at) for at in coordinates[keep]}
