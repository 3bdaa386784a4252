"""Surfaces of analytic densities: areas and volumes in closed form, seams, closed boundaries, what is left out, even sampling."""

from collections.abc import Iterator

import numpy as np
import pytest
import trimesh

from efficientnerf.asset.tree import tree_from_voxels
from efficientnerf.surface.extraction import surface
from efficientnerf.surface.isosurface import automatic_threshold, enclosed_cells, isosurface
from efficientnerf.surface.mesh import Mesh, Texture, decimate, face_areas, face_vectors, face_volumes, sampled, separate, topology
from efficientnerf.surface.smoothing import smooth, smooth_normals, smoothed_face_normals
from efficientnerf.surface.volume import Volume

LEVEL = 40.0
NOBODY = np.zeros((0, 3))


class Balls(Volume):
    """A volume whose density passes LEVEL on spheres: LEVEL * 2^(-distance / softness), capped. Colour: position / 2 + 1/2."""

    def __init__(self, *balls: tuple[tuple[float, float, float], float], cells: int = 16, softness: float = 0.03, hollow: float = 0.0) -> None:
        nothing = np.zeros((0, 3), int), np.zeros(0), np.zeros((0, 1, 3))
        super().__init__(tree_from_voxels((cells, cells, cells), 2 / (4 * cells), np.full(3, -1.0), *nothing, brick=4))
        self.balls, self.softness, self.hollow = balls, softness, hollow

    def density(self, at: np.ndarray) -> np.ndarray:
        distance = np.min([np.linalg.norm(at - np.array(centre), axis=-1) - radius for centre, radius in self.balls], 0)
        if self.hollow:
            distance = np.maximum(distance, -self.hollow - distance)
        return np.minimum(LEVEL * np.exp2(np.clip(-distance / self.softness, -100, 10)), 2000).astype(np.float32)

    def density_block(self, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        index = np.stack(np.meshgrid(*(np.arange(a, b) for a, b in zip(low, high)), indexing="ij"), -1)
        inside = ((index >= 0) & (index < self.tree.resolution)).all(-1)
        return np.where(inside, self.density(self.tree.bounds_min + (index + 0.5) * self.tree.voxel), 0).astype(np.float32)

    def dense_voxels(self, threshold: float) -> Iterator[np.ndarray]:
        yield np.argwhere(self.density_block(np.zeros(3, int), np.array(self.tree.resolution)) >= threshold)

    def filled_parts(self, axis: int, low: np.ndarray, high: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        yield low, high

    def filled_blocks(self, counts: list[int], block: int) -> np.ndarray:
        return np.argwhere(np.ones(counts, bool))

    def colour(self, at: np.ndarray, directions: np.ndarray | None = None) -> np.ndarray:
        return (at / 2 + 0.5).astype(np.float32)


class Noise(Balls):
    """Saturated densities at random: every case of marching cubes, the ambiguous ones above all."""

    def __init__(self) -> None:
        super().__init__(((0, 0, 0), 1), cells=8)
        self.values = np.where(np.random.default_rng(3).random((32, 32, 32)) < 0.35, 1e6, 0).astype(np.float32)

    def density_block(self, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        padded = np.pad(self.values, 40)
        return padded[tuple(slice(a + 40, b + 40) for a, b in zip(low, high))]


def test_a_ball_has_the_area_and_volume_of_a_ball() -> None:
    mesh = surface(Balls(((0.1, 0, -0.05), 0.6)), LEVEL)
    assert topology(mesh.vertices, mesh.faces).watertight
    assert face_areas(mesh.vertices, mesh.faces).sum() == pytest.approx(4 * np.pi * 0.6**2, rel=0.01)
    assert face_volumes(mesh.vertices, mesh.faces).sum() == pytest.approx(4 / 3 * np.pi * 0.6**3, rel=0.01)
    outward = (mesh.vertices - [0.1, 0, -0.05]) / np.linalg.norm(mesh.vertices - [0.1, 0, -0.05], axis=1, keepdims=True)
    assert (mesh.normals * outward).sum(1).min() > 0.97
    assert np.abs(mesh.colours - (mesh.vertices / 2 + 0.5)).max() < 0.02


@pytest.mark.parametrize("block", [7, 64])
def test_blocks_leave_no_seams(block: int) -> None:
    ball = Balls(((0, 0, 0), 0.7))
    vertices, faces = isosurface(ball, LEVEL, block=block)
    whole, _ = isosurface(ball, LEVEL, block=1000)
    assert topology(vertices, faces).watertight
    assert len(vertices) == len(whole)
    np.testing.assert_allclose(np.sort(vertices, 0), np.sort(whole, 0), atol=1e-6)


def test_saturated_noise_is_closed() -> None:
    vertices, faces = isosurface(Noise(), 1.0, block=5)
    assert topology(vertices, faces).watertight


def test_small_pieces_go_and_large_ones_stay() -> None:
    balls = Balls(((-0.4, 0, 0), 0.4), ((0.6, 0.6, 0.6), 0.06), ((0.6, -0.5, 0), 0.25))
    for least, count in ((0.05, 2), (0.0, 3)):
        mesh = surface(balls, LEVEL, min_component=least)
        assert topology(mesh.vertices, mesh.faces).components == count


def test_hollows_are_filled_unless_somebody_stands_in_them() -> None:
    shell = Balls(((0, 0, 0), 0.7), hollow=0.25)
    assert enclosed_cells(shell, LEVEL, NOBODY).sum() > 100
    filled = surface(shell, LEVEL)
    assert face_volumes(filled.vertices, filled.faces).sum() == pytest.approx(4 / 3 * np.pi * 0.7**3, rel=0.01)
    room = surface(shell, LEVEL, viewpoints=np.zeros((1, 3)))
    assert face_volumes(room.vertices, room.faces).sum() == pytest.approx(4 / 3 * np.pi * (0.7**3 - 0.45**3), rel=0.02)
    assert topology(room.vertices, room.faces).components == 2


def test_decimation_keeps_the_budget_and_the_surface() -> None:
    mesh = surface(Balls(((0, 0, 0), 0.7)), LEVEL, faces=1500)
    assert len(mesh.faces) <= 1500
    assert topology(mesh.vertices, mesh.faces).watertight
    assert face_volumes(mesh.vertices, mesh.faces).sum() == pytest.approx(4 / 3 * np.pi * 0.7**3, rel=0.02)
    assert (face_areas(mesh.vertices, mesh.faces) > 0).all()


def test_decimation_makes_no_spikes() -> None:
    vertices, faces = isosurface(Noise(), 1.0)
    fewer, _ = decimate(vertices, faces, len(faces) // 8)
    distance = [np.linalg.norm(vertices - vertex, axis=1).min() for vertex in fewer[::20]]
    assert max(distance) < 2 / 32  # one voxel


def test_touching_sheets_are_separated() -> None:
    first = np.array([[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]])  # tetrahedron; a second one shares the edge 0-1
    second = np.array([[0, 1, 4], [0, 5, 1], [1, 5, 4], [4, 5, 0]])
    vertices = np.array([[0, 0, 0], [0, 0, 1], [1, 0, 0], [1, 1, 0], [-1, 0, 0], [-1, -1, 0]], float)
    faces = np.concatenate([first, second])
    assert topology(vertices, faces).non_manifold_edges == 1
    apart = topology(*separate(vertices, faces))
    assert apart.watertight
    assert apart.components in (1, 2)  # one end of the edge is enough


def test_smoothing_keeps_the_volume() -> None:
    vertices, faces = isosurface(Balls(((0, 0, 0), 0.5), softness=1e-4), LEVEL)
    smoothed = smooth(vertices, faces, 10)
    assert face_volumes(smoothed, faces).sum() == pytest.approx(face_volumes(vertices, faces).sum(), rel=0.01)
    assert face_areas(smoothed, faces).sum() < 0.98 * face_areas(vertices, faces).sum()  # the terraces are gone


@pytest.mark.parametrize("softness", [0.005, 0.2])
def test_the_automatic_threshold_draws_what_is_opaque(softness: float) -> None:
    ball = Balls(((0, 0, 0), 0.5), softness=softness, cells=12)
    level = automatic_threshold(ball)
    assert 0 < level <= np.log(2) / ball.tree.voxel + 1e-9
    radius = 0.5 - softness * np.log2(level / LEVEL)
    if radius < 0.95:
        vertices, _ = isosurface(ball, level)
        assert np.median(np.linalg.norm(vertices, axis=1)) == pytest.approx(radius, abs=ball.tree.voxel)


def test_points_are_spread_evenly_over_a_mesh_and_repeatably() -> None:
    """However large the faces are: those of one half are a quarter as large."""
    ball = trimesh.creation.icosphere(4, radius=0.6)
    fine = ball.subdivide(face_index=np.flatnonzero(ball.triangles_center[:, 0] > 0))
    fine.vertices *= 0.6 / np.linalg.norm(fine.vertices, axis=1, keepdims=True)
    vertices, faces = np.asarray(fine.vertices), np.asarray(fine.faces)
    mesh = Mesh(vertices, faces, vertices / 0.6, (vertices / 1.2 + 0.5).astype(np.float32))
    cloud, again, other = sampled(mesh, 20_000, 0), sampled(mesh, 20_000, 0), sampled(mesh, 20_000, 1)
    for name in ("positions", "normals", "colours"):
        np.testing.assert_array_equal(getattr(cloud, name), getattr(again, name))
    assert (cloud.positions != other.positions).any(axis=1).all()
    np.testing.assert_allclose(np.linalg.norm(cloud.positions, axis=1), 0.6, atol=0.002)
    np.testing.assert_allclose(np.linalg.norm(cloud.normals, axis=1), 1, atol=1e-9)
    assert ((cloud.normals * cloud.positions).sum(axis=1) > 0.599).mean() > 0.99
    np.testing.assert_allclose(cloud.colours, cloud.positions / 1.2 + 0.5, atol=1e-6)  # of vertices: linear over a face
    # Archimedes: on a sphere every coordinate is uniform.
    for axis in range(3):
        share = np.histogram(cloud.positions[:, axis], 10, (-0.6, 0.6))[0] / 20_000
        assert np.abs(share - 0.1).max() < 0.008


def test_points_are_as_many_as_stated_sizes_say() -> None:
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 5, 0], [9, 5, 0], [5, 9, 0]])
    mesh = Mesh(corners, np.arange(6).reshape(2, 3), np.tile([0.0, 0, 1], (6, 1)), np.zeros((6, 3), np.float32))
    for sizes, near in ((None, 1 / 17), (np.array([3.0, 1.0]), 3 / 4), (np.array([0.0, 0.0]), 0)):
        assert (sampled(mesh, 3400, 0, sizes).positions[:, 0] < 2).mean() == pytest.approx(near, abs=1 / 3400)


def test_points_have_the_colours_of_the_texture() -> None:
    """Which runs from black on the left to red on the right."""
    picture = np.zeros((4, 256, 3), np.uint8)
    picture[..., 0] = np.arange(256)
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    mesh = Mesh(corners, np.array([[0, 1, 2]]), np.tile([0.0, 0, 1], (3, 1)), np.ones((3, 3), np.float32), texture=Texture(corners[None, :, :2], picture))
    cloud = sampled(mesh, 500, 0)
    np.testing.assert_allclose(cloud.colours, cloud.positions * [1, 0, 0], atol=0.005)


def test_points_have_unit_normals_where_those_of_the_corners_cancel() -> None:
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    mesh = Mesh(corners, np.array([[0, 1, 2]]), np.array([[0.0, 0, 1], [0, 0, -1], [0, 0, 1]]), np.zeros((3, 3), np.float32))
    assert (np.linalg.norm(sampled(mesh, 500, 0).normals, axis=1) == 1).all()


def normal_errors(vertices: np.ndarray, faces: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Degrees between the normals of faces and the true ones."""
    vectors = face_vectors(vertices, faces)
    return np.degrees(np.arccos(np.clip((vectors * truth).sum(1) / np.linalg.norm(vectors, axis=1), -1, 1)))


@pytest.mark.parametrize(("rounds", "sharpness"), [(6, 0.6), (80, 0.2)])
def test_smoothed_normals_lose_noise_and_keep_edges(rounds: int, sharpness: float) -> None:
    box = trimesh.creation.box((1.0, 1.0, 1.0))
    for _ in range(4):
        box = box.subdivide()
    vertices, faces, truth = np.asarray(box.vertices), np.asarray(box.faces), np.asarray(box.face_normals)
    noisy = vertices + np.random.default_rng(0).normal(scale=0.006, size=vertices.shape)
    smoothed = smooth_normals(noisy, faces, rounds, sharpness)
    before, after = normal_errors(noisy, faces, truth), normal_errors(smoothed, faces, truth)
    assert after.mean() < 0.4 * before.mean()
    at_edge = (np.abs(vertices[faces]).max(1) > 0.499).sum(1) > 1  # faces that reach an edge of the box
    assert after[at_edge].mean() < 0.5 * before[at_edge].mean()
    assert np.abs(smoothed - vertices).max() < 0.03
    rounded = smooth(noisy, faces, 6)
    assert after[at_edge].mean() < 0.7 * normal_errors(rounded, faces, truth)[at_edge].mean()


@pytest.mark.parametrize(("rounds", "sharpness"), [(6, 0.6), (80, 0.2)])
def test_smoothing_normals_keeps_thin_parts_as_thick(rounds: int, sharpness: float) -> None:
    wire = trimesh.creation.cylinder(0.02, 1.0, sections=5)
    for _ in range(3):
        wire = wire.subdivide()
    vertices, faces = np.asarray(wire.vertices), np.asarray(wire.faces)
    noisy = vertices + np.random.default_rng(0).normal(scale=0.005, size=vertices.shape)
    assert face_volumes(smooth_normals(noisy, faces, rounds, sharpness), faces).sum() == pytest.approx(face_volumes(noisy, faces).sum(), rel=0.015)


def test_smoothed_normals_are_those_of_the_loops() -> None:
    """Against a loop over faces and edges; the surface is open, and a face has no neighbour."""
    rng = np.random.default_rng(0)
    ball = trimesh.creation.icosphere(2)
    vertices = np.concatenate([np.asarray(ball.vertices) * (1 + 0.05 * rng.standard_normal((len(ball.vertices), 1))), rng.standard_normal((3, 3))])
    faces = np.concatenate([np.asarray(ball.faces)[7:], [[len(vertices) - 3, len(vertices) - 2, len(vertices) - 1]]])
    normals, vectors = smoothed_face_normals(vertices, faces, 3, 0.3), face_vectors(vertices, faces)
    area = np.linalg.norm(vectors, axis=1)
    expected = vectors / area[:, None]
    edges = [{frozenset(edge) for edge in ((a, b), (b, c), (c, a))} for a, b, c in faces.tolist()]
    beside = [[other for other in range(len(faces)) if other != face and edges[face] & edges[other]] for face in range(len(faces))]
    assert {len(row) for row in beside} >= {0, 2, 3}
    for _ in range(3):
        weight = [np.array([area[n] * np.exp(-((expected[n] - expected[face]) ** 2).sum() / (2 * 0.3**2)) for n in row]) for face, row in enumerate(beside)]
        sums = np.array([area[face] * expected[face] + weight[face] @ expected[row] if row else expected[face] for face, row in enumerate(beside)])
        expected = sums / np.linalg.norm(sums, axis=1, keepdims=True)
    np.testing.assert_allclose(normals, expected, atol=1e-9)
