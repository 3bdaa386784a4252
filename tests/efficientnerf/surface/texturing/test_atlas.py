"""Atlases: every face has its place, no two share one, and neighbouring charts keep their distance."""

import numpy as np
import pytest
from scipy.ndimage import binary_dilation

from efficientnerf.surface.mesh import face_areas, face_neighbours
from efficientnerf.surface.texturing.atlas import TooManyCharts, atlas_of, gap_of
from efficientnerf.surface.texturing.charts import charts_of
from efficientnerf.surface.texturing.filling import texture_from

from .shapes import ball, box


def rough(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A ball that is pitted so that many faces look away."""
    vertices, faces = ball(3)
    return vertices + 0.06 * np.random.default_rng(seed).normal(size=vertices.shape), faces


def scattered(count: int = 100) -> tuple[np.ndarray, np.ndarray]:
    """Small boxes that lie apart: of charts that need more texels for the gaps between them than for themselves."""
    vertices, faces = box()
    away = np.random.default_rng(0).uniform(0, 10, (count, 3))
    return (0.01 * vertices + away[:, None]).reshape(-1, 3), np.concatenate([faces + number * len(vertices) for number in range(count)])


SHAPES = {"ball": ball, "box": box, "rough": rough}


def area(corners: np.ndarray) -> np.ndarray:
    """(F,) signed, of (F, 3, 2)."""
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2


@pytest.mark.parametrize("name", SHAPES)
def test_faces_lie_in_the_square_with_their_sides_kept(name: str) -> None:
    vertices, faces = SHAPES[name]()
    atlas = atlas_of(vertices, faces, np.inf, 256)
    assert atlas.corners.shape == (len(faces), 3, 2)
    assert (atlas.corners > 0).all()
    assert (atlas.corners < atlas.size).all()
    flat = area(atlas.corners)
    real = face_areas(vertices, faces) * atlas.scale**2
    assert (flat <= real * (1 + 1e-9)).all()  # a projection makes nothing larger
    assert flat.sum() > 0.75 * real.sum()
    assert (flat > 0).mean() > 0.99  # none is mirrored; pixels' y runs down, as do the charts' planes seen from outside


@pytest.mark.parametrize("name", SHAPES)
def test_no_texel_belongs_to_two_faces(name: str) -> None:
    vertices, faces = SHAPES[name]()
    atlas = atlas_of(vertices, faces, np.inf, 256)
    count = np.zeros((atlas.size, atlas.size), int)
    for corners in atlas.corners:  # the slow way, strictly inside
        low, high = np.floor(corners.min(0)).astype(int), np.ceil(corners.max(0)).astype(int)
        y, x = np.mgrid[low[1] : high[1], low[0] : high[0]] + 0.5
        signs = []
        for k in range(3):
            a, b = corners[k], corners[(k + 1) % 3]
            signs.append((b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0]))
        inside = (np.array(signs) > 1e-6).all(0) | (np.array(signs) < -1e-6).all(0)
        count[low[1] : high[1], low[0] : high[0]] += inside
    assert (count > 1).sum() <= 0.002 * (count > 0).sum()
    texels = atlas.texels
    assert len(np.unique(texels.place)) == len(texels.place)
    assert np.isin(np.flatnonzero(count.ravel()), texels.place).all()


@pytest.mark.parametrize("name", SHAPES)
def test_charts_keep_their_distance(name: str) -> None:
    vertices, faces = SHAPES[name]()
    atlas = atlas_of(vertices, faces, np.inf, 256)
    label = np.full(atlas.size**2, -1)
    label[atlas.texels.place] = atlas.chart[atlas.texels.face]
    label = label.reshape(atlas.size, atlas.size)
    reach = gap_of(atlas.size) // 2
    for chart in np.unique(label[label >= 0]):
        near = binary_dilation(label == chart, np.ones((3, 3)), reach)
        assert np.isin(label[near], [-1, chart]).all()


def test_charts_are_connected_and_large_where_the_surface_is_even() -> None:
    vertices, faces = box()
    charts = charts_of(vertices, faces, 0.01)
    assert charts.count == 6
    smooth = charts_of(*ball(4), 0.01)
    assert smooth.count < 30
    beside = face_neighbours(ball(4)[1], len(ball(4)[0]))
    for chart in range(smooth.count):
        members = np.flatnonzero(smooth.chart == chart)
        reached, border = {int(members[0])}, [int(members[0])]
        while border:
            for other in beside[border.pop()]:
                if smooth.chart[other] == chart and int(other) not in reached:
                    reached.add(int(other))
                    border.append(int(other))
        assert reached == set(members.tolist())


def test_texels_know_their_place_on_the_surface() -> None:
    vertices, faces = ball(2)
    atlas = atlas_of(vertices, faces, np.inf, 128)
    texels = atlas.texels
    np.testing.assert_allclose(texels.share.sum(1), 1, atol=1e-5)
    assert texels.share.min() > -1e-4
    points = np.einsum("tc,tci->ti", texels.share, atlas.corners[texels.face])
    np.testing.assert_allclose(points, np.stack([texels.place % atlas.size, texels.place // atlas.size], 1) + 0.5, atol=2e-3)
    assert np.linalg.norm(texels.values(vertices, faces), axis=1).min() > 0.9


@pytest.mark.parametrize("case", ["one", "none", "flat", "needle", "doubled"])
def test_hostile_meshes(case: str) -> None:
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 0], [2, 0, 0], [0, 1e-12, 0]])
    faces = {
        "one": [[0, 1, 2]],
        "none": np.zeros((0, 3), int),
        "flat": [[0, 1, 2], [0, 1, 4], [0, 3, 0]],  # the others have no area
        "needle": [[0, 1, 5], [0, 4, 5]],
        "doubled": [[0, 1, 2], [0, 1, 2], [2, 1, 0], [0, 1, 2]],  # an edge of four faces
    }[case]
    atlas = atlas_of(corners, np.asarray(faces, np.int64).reshape(-1, 3), 50.0, 256)
    assert np.isfinite(atlas.corners).all()
    assert (atlas.corners >= 0).all()
    assert (atlas.corners <= atlas.size).all()
    assert texture_from(atlas, np.zeros((len(atlas.texels.place), 3), np.uint8)).shape == (atlas.size, atlas.size, 3)


def test_the_same_mesh_gives_the_same_atlas() -> None:
    a, b = atlas_of(*rough(), np.inf, 256), atlas_of(*rough(), np.inf, 256)
    np.testing.assert_array_equal(a.corners, b.corners)


def test_empty_texels_have_the_colour_of_the_nearest() -> None:
    vertices, faces = ball(2)
    atlas = atlas_of(vertices, faces, np.inf, 128)
    colours = np.random.default_rng(0).integers(0, 256, (len(atlas.texels.place), 3)).astype(np.uint8)
    texture = texture_from(atlas, colours)
    np.testing.assert_array_equal(texture.reshape(-1, 3)[atlas.texels.place], colours)
    known = np.stack([atlas.texels.place // atlas.size, atlas.texels.place % atlas.size], 1)
    rng = np.random.default_rng(1)
    for place in rng.integers(0, atlas.size, (200, 2)):
        apart = np.linalg.norm(known - place, axis=1)
        same = (colours == texture[tuple(place)]).all(1)
        assert same.any()
        assert apart[same].min() <= 1.1 * apart.min() + 0.5  # chamfer distances


def test_an_atlas_grows_where_gaps_alone_fill_it_and_an_end_comes_at_the_largest() -> None:
    vertices, faces = scattered()
    atlas = atlas_of(vertices, faces, 1.0, 4096)
    assert atlas.size == 128, "600 charts of 5 x 5 texels with their gaps; 16 x 16 were wanted"
    assert np.isfinite(atlas.corners).all()
    with pytest.raises(TooManyCharts):
        atlas_of(vertices, faces, 1.0, 32)
