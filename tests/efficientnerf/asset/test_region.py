"""Regions of trees: inside nothing changes, outside is nothing, and doing it again does nothing."""

from dataclasses import replace

import numpy as np
import pytest

from efficientnerf.asset.cascades import check_cascades, voxel_cascades
from efficientnerf.asset.region import cropped, foreground, inside_distance, inside_share, voxel_centres
from efficientnerf.asset.tree import NerfTree, Region
from efficientnerf.geometry.cameras import Similarity
from efficientnerf.geometry.ndc import Ndc
from tests.efficientnerf.trees import random_cascades, random_tree

CASES = [random_tree(3), random_tree(3, lookup="nearest"), random_cascades(1), random_cascades(2, count=2, cells=4, share=0.6)]


def middle(tree: NerfTree, share: float = 0.5, **more: float) -> Region:
    """The inner part of a tree's inmost grid."""
    centre, half = (tree.bounds_min + tree.bounds_max) / 2, (tree.bounds_max - tree.bounds_min) / 2
    return Region(np.stack([centre - share * half, centre + share * half]), **more)  # type: ignore[arg-type]


def listed(tree: NerfTree) -> dict[tuple[float, ...], tuple[float, bytes]]:
    """Density and harmonics of each voxel by place and cascade."""
    places = np.column_stack([voxel_cascades(tree) if tree.outer else np.zeros(len(tree.density_values)), np.round(voxel_centres(tree), 6)])
    return {tuple(place): (float(sigma), row.tobytes()) for place, sigma, row in zip(places, tree.density_values, tree.sh, strict=True)}


@pytest.mark.parametrize("radius", [0.0, 0.1, 9.0])
def test_inside_distance_is_that_to_the_nearest_point_outside(radius: float) -> None:
    region = Region(np.array([[-1.0, -0.5, 0.0], [0.6, 0.7, 1.0]]), radius)
    rng = np.random.default_rng(0)
    points = rng.uniform([-1.2, -0.8, -0.2], [0.9, 0.9, 1.2], (300, 3))
    cloud = rng.uniform([-1.4, -1.0, -0.4], [1.0, 1.1, 1.4], (60000, 3))
    outside = cloud[inside_distance(region, cloud) <= 0]
    for point, distance in zip(points, inside_distance(region, points), strict=True):
        nearest = np.linalg.norm(outside - point, axis=1).min()
        assert nearest >= distance - 1e-9
        if distance > 0.05:
            assert nearest <= distance + 0.1


@pytest.mark.parametrize(("tree", "radius", "fade"), [(tree, *(((0.0, 0.0), (0.2, 0.1), (5.0, 0.15))[n % 3])) for n, tree in enumerate(CASES)])
def test_inside_nothing_changes_and_outside_is_nothing(tree: NerfTree, radius: float, fade: float) -> None:
    region = middle(tree, 0.8, corner_radius=radius, fade=fade)
    restricted = foreground(replace(tree, region=region))
    assert restricted.region is None
    assert restricted.environment is None
    before, after = listed(tree), listed(restricted)
    share = dict(zip(before, inside_share(region, np.array(list(before))[:, 1:]), strict=True))
    assert 0 < len(after) < len(before)
    assert set(after) == {place for place, part in share.items() if part > 0}
    for place, (sigma, colours) in after.items():
        assert colours == before[place][1]
        opacities = [1 - np.exp(-density * tree.voxel * 2 ** place[0]) for density in (sigma, before[place][0])]
        assert opacities[0] == pytest.approx(opacities[1] * share[place], rel=1e-4)
        if share[place] == 1:
            assert sigma == before[place][0]


def test_outer_cascades_that_are_empty_are_dropped_and_the_others_stay() -> None:
    tree = random_cascades(4, share=0.6)
    small = foreground(replace(tree, region=middle(tree, 0.6)))
    assert small.outer
    for number, cascade in enumerate(small.outer[:-1]):
        assert cascade.voxel == tree.outer[number].voxel
    assert (small.outer[-1].brick_index >= 0).any()
    check_cascades(small)
    # Voxels of outer cascades inside of the inmost box serve what lies beside it: where the region has none of them, neither has the tree.
    inner = voxel_cascades(tree) == 0
    alone = foreground(replace(tree, region=middle(tree, 0.01)))
    assert len(alone.density_values) < inner.sum()
    everything = foreground(replace(tree, region=Region(np.array([[-99.0] * 3, [99.0] * 3]))))
    assert len(everything.outer) == len(tree.outer)
    assert listed(everything) == listed(tree)


@pytest.mark.parametrize("tree", CASES)
def test_a_crop_keeps_what_lies_in_a_turned_box(tree: NerfTree) -> None:
    angle = 0.6
    rotation = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]])
    similarity = Similarity(0.4, rotation, np.array([0.3, -0.2, 0.1]))
    places = similarity.inverse().points(voxel_centres(tree))
    corners = np.quantile(places, [0.8, 0.3], axis=0)  # in any order
    kept = cropped(replace(tree, region=middle(tree)), corners, similarity)
    inside = ((places >= corners[1]) & (places <= corners[0])).all(axis=1)
    assert 0 < inside.sum() < len(inside)
    assert np.array_equal(kept.density_values, tree.density_values[inside])
    assert np.array_equal(kept.sh, tree.sh[inside])
    assert kept.region is None
    assert kept.environment is None
    again = cropped(kept, corners, similarity)
    assert listed(again) == listed(kept)


def test_a_crop_of_normalised_device_coordinates_is_of_the_world() -> None:
    ndc = Ndc(np.eye(4), 50.0, 60, 40, 1.0)
    tree = replace(random_tree(7, share=0.5), ndc=ndc, bounds_min=np.array([-0.6, -0.5, -0.9]))
    places = np.asarray(ndc.world(voxel_centres(tree)))
    corners = np.quantile(places, [0.2, 0.7], axis=0)
    kept = cropped(tree, corners, Similarity.identity())
    inside = ((places >= corners[0]) & (places <= corners[1])).all(axis=1)
    assert 0 < inside.sum() < len(inside)
    assert np.array_equal(kept.density_values, tree.density_values[inside])
