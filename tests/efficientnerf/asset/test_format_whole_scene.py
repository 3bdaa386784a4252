"""Files of whole scenes: nested grids, an environment map and a foreground region come back as they were saved."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from efficientnerf.asset.cascades import cascades_of
from efficientnerf.asset.format import WRITERS, FormatError, describe, load, save
from efficientnerf.asset.quantisation import quantised_density
from efficientnerf.asset.tree import NerfTree, Region
from tests.efficientnerf.tree_reference import render_reference
from tests.efficientnerf.trees import LOW, random_cascades, rays_at, tensors


def region(tree: NerfTree, seed: int = 0) -> Region:
    return Region(np.stack([LOW, LOW + 1]), 0.25, 0.05, np.random.default_rng(seed).random(len(tree.voxel_index)) < 0.5)


def same(a: NerfTree, b: NerfTree) -> None:
    for name in ("shape", "brick", "voxel", "lookup", "degree", "background", "metadata"):
        assert getattr(a, name) == getattr(b, name), name
    for one, other in zip(cascades_of(a), cascades_of(b), strict=True):
        assert (one.shape, one.voxel) == (other.shape, other.voxel)
        assert np.array_equal(one.bounds_min, other.bounds_min)
        assert np.array_equal(one.brick_index, other.brick_index)
    for name in ("voxel_index", "density_values", "sh"):
        assert np.array_equal(getattr(a, name), getattr(b, name)), name
    assert (a.environment is None) == (b.environment is None)
    if a.environment is not None and b.environment is not None:
        assert a.environment.dtype == b.environment.dtype == np.float32
        assert np.array_equal(a.environment, b.environment)
    assert (a.region is None) == (b.region is None)
    if a.region is not None and b.region is not None:
        assert np.array_equal(a.region.bounds, b.region.bounds)
        assert (a.region.corner_radius, a.region.fade) == (b.region.corner_radius, b.region.fade)
        assert (a.region.bricks is None) == (b.region.bricks is None)
        assert a.region.bricks is None or np.array_equal(a.region.bricks, b.region.bricks)


@pytest.mark.parametrize(("count", "degree", "brick", "lookup"), [(1, 0, 1, "nearest"), (2, 2, 3, "trilinear"), (3, 1, 4, "nearest"), (5, 0, 2, "trilinear")])
def test_what_is_saved_is_loaded_and_saved_again_to_the_same_bytes(tmp_path: Path, count: int, degree: int, brick: int, lookup: str) -> None:
    made = random_cascades(count, count=count, degree=degree, brick=brick, lookup=lookup)
    for n, tree in enumerate(
        (made, replace(made, environment=None), replace(made, region=region(made)), replace(made, region=Region(np.stack([LOW, LOW + 1]))))
    ):
        save(tree, tmp_path / "a.nerftree")
        again = load(tmp_path / "a.nerftree")
        same(again, tree)
        save(again, tmp_path / "b.nerftree")
        assert (tmp_path / "a.nerftree").read_bytes() == (tmp_path / "b.nerftree").read_bytes()
        about = describe(tmp_path / "a.nerftree")
        nested = count > 1 or n != 1
        assert about["layout"] == ("nearest-" if lookup == "nearest" else "") + ("nested-" if nested else "") + "sparse"
        assert about["format_version"] == ("1.4" if nested else "1.3" if lookup == "nearest" else "1.0")
        assert about["voxels"] == len(tree.density_values)


@pytest.mark.parametrize("layout", WRITERS)
def test_every_layout_holds_a_whole_scene(tmp_path: Path, layout: str) -> None:
    """What a layout rounds is rounded once; places, the map and the region are exact in all of them."""
    made = random_cascades(4, degree=2)
    tree = replace(made, region=region(made))
    save(tree, tmp_path / "a.nerftree", layout)
    again = load(tmp_path / "a.nerftree")
    save(again, tmp_path / "b.nerftree", layout)
    assert (tmp_path / "a.nerftree").read_bytes() == (tmp_path / "b.nerftree").read_bytes()
    same(replace(again, voxel_index=tree.voxel_index, density_values=tree.density_values, harmonics=tree.sh), tree)
    if layout in ("sparse", "full32"):
        origins, directions = tensors(*rays_at(tree, 40))
        (colour, opacity), (expected, full) = (render_reference(t, origins, directions) for t in (again, tree))
        if layout == "sparse":
            torch.testing.assert_close(colour, expected)
        torch.testing.assert_close(opacity, full)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"environment": np.zeros((4, 4, 3), np.float32)}, r"environment: shape \(4, 4, 3\); expected \(H, 2 H, 3\)"),
        ({"environment": np.zeros((0, 0, 3), np.float32)}, "environment: shape"),
        ({"environment": np.full((1, 2, 3), np.nan, np.float32)}, "environment: holds values that are not finite"),
        ({"region": Region(np.zeros((2, 3)))}, "'bounds' are"),
        ({"region": Region(np.stack([LOW, LOW + 1]), fade=-1.0)}, "'fade' is -1"),
        ({"region": Region(np.stack([LOW, LOW + np.nan]))}, "metadata can't be written"),
        ({"voxel": 0.11}, "cascade 1 has voxels of 0.2; expected 0.22"),
        ({"bounds_min": LOW + 0.05}, "does not lie on faces"),
    ],
)
def test_trees_that_make_no_sound_file_are_not_saved(tmp_path: Path, change: dict[str, object], message: str) -> None:
    with pytest.raises(FormatError, match=message):
        save(replace(random_cascades(2), **change), tmp_path / "a.nerftree")  # type: ignore[arg-type]
    assert not list(tmp_path.iterdir())


def test_densities_of_cascades_share_a_table_and_keep_their_optical_depth() -> None:
    rng = np.random.default_rng(0)
    side = np.repeat(0.01 * 2.0 ** np.arange(6), 500)
    depth = 10 ** rng.uniform(-2.9, 1.6, len(side))
    density = (depth / side).astype(np.float32)
    found = quantised_density(density, side)
    assert len(np.unique(found)) <= 256
    np.testing.assert_allclose(found * side, depth, rtol=0.022 + 5 * 0.0014)
    assert np.array_equal(quantised_density(density, np.full(len(density), 0.01)), quantised_density(density, 0.01))
