"""Triangle meshes: measuring, cleaning, decimating and sampling them. Arrays in, arrays out.

V vertices, F faces (counter-clockwise seen from outside), C connected components.
"""

from dataclasses import dataclass, field, replace

import fast_simplification
import numpy as np
import trimesh
from scipy.spatial import cKDTree


@dataclass(frozen=True, eq=False)
class Texture:
    """A picture on the faces of a mesh."""

    coordinates: np.ndarray  # (F, 3, 2) float64 of each face's corners, 0-1: u to the right, v up from the lower edge, as OBJ and USD count
    colours: np.ndarray  # (S, S, 3) uint8 sRGB, the top row first


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh with colours.

    vertices (V, 3) float64, in the caller's frame
    faces    (F, 3) int64, counter-clockwise seen from outside
    normals  (V, 3) float64 unit, outward
    colours  (V, 3) float32 sRGB, 0-1
    facts    how it was made (threshold, what was removed), for reports
    texture  pictures on its faces, or None: its colours are those of the vertices
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    colours: np.ndarray
    facts: dict[str, object] = field(default_factory=dict)
    texture: Texture | None = None


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points on a surface: positions (N, 3) float64, normals (N, 3) float64 unit, colours (N, 3) float32 sRGB, 0-1."""

    positions: np.ndarray
    normals: np.ndarray
    colours: np.ndarray


@dataclass(frozen=True)
class Topology:
    """How the faces are connected."""

    watertight: bool  # each edge belongs to exactly two faces that run along it in opposite directions
    open_edges: int  # edges with one face
    non_manifold_edges: int  # edges with more than two faces
    components: int  # connected by vertices


def moved(mesh: Mesh, scale: float, rotation: np.ndarray, translation: np.ndarray) -> Mesh:
    """The mesh after x -> scale * rotation @ x + translation; normals are rotated. `rotation` (3, 3) must be proper, scale > 0."""
    return replace(mesh, vertices=scale * (mesh.vertices @ rotation.T) + translation, normals=mesh.normals @ rotation.T)


def face_vectors(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(F, 3) outward vectors as long as twice the area of each face."""
    a, b, c = vertices[faces[:, 0]], vertices[faces[:, 1]], vertices[faces[:, 2]]
    return np.cross(b - a, c - a)


def face_areas(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(F,) areas."""
    return np.asarray(trimesh.triangles.area(vertices[faces]))


def face_volumes(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(F,) signed volumes of the tetrahedra from the middle of the vertices to each face; over a closed mesh they sum to its volume."""
    origin = vertices.mean(0) if len(vertices) else np.zeros(3)
    return np.einsum("fi,fi->f", vertices[faces[:, 0]] - origin, face_vectors(vertices, faces)) / 6


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(V, 3) unit normals: the mean over the faces around each vertex, weighted by area; +z where the faces cancel."""
    vectors = face_vectors(vertices, faces)
    sums = np.stack([np.bincount(faces.ravel(), np.repeat(vectors[:, axis], 3), minlength=len(vertices)) for axis in range(3)], 1)
    length = np.linalg.norm(sums, axis=1, keepdims=True)
    return np.where(length > 0, sums / np.where(length > 0, length, 1), [0.0, 0.0, 1.0])


def compact(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same mesh without vertices that no face uses; the order is kept."""
    used = np.zeros(len(vertices), bool)
    used[faces.ravel()] = True
    return vertices[used], (np.cumsum(used) - 1)[faces]


def face_neighbours(faces: np.ndarray, count: int) -> np.ndarray:
    """(F, 3) the face across each edge (from a corner to the next), -1 where there is none or more than one; `count` is the number of vertices."""
    tail, head = faces.ravel(), faces[:, [1, 2, 0]].ravel()
    key = np.minimum(tail, head) * count + np.maximum(tail, head)
    order = np.argsort(key, kind="stable")
    ordered = key[order]
    same = ordered[1:] == ordered[:-1]
    alone = np.ones(len(key) + 1, bool)  # whether a run of equal edges begins here
    alone[1:-1] = ~same
    pair = np.flatnonzero(alone[:-2] & same & alone[2:]) if len(key) > 1 else np.zeros(0, np.int64)
    out = np.full(len(key), -1, np.int64)
    out[order[pair]], out[order[pair + 1]] = order[pair + 1] // 3, order[pair] // 3
    return out.reshape(-1, 3)


def face_components(faces: np.ndarray, count: int) -> np.ndarray:
    """(F,) the connected component, 0..C-1, of each face; `count` is the number of vertices. Components are numbered by their first vertex."""
    if not len(faces):
        return np.zeros(0, np.int64)
    label = trimesh.graph.connected_component_labels(trimesh.geometry.faces_to_edges(faces), node_count=count)
    _, label = np.unique(label[faces[:, 0]], return_inverse=True)  # only components that have faces
    return label.astype(np.int64)


def topology(vertices: np.ndarray, faces: np.ndarray) -> Topology:
    """Whether the mesh is closed, and its components."""
    if not len(faces):
        return Topology(False, 0, 0, 0)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    uses = np.bincount(mesh.edges_unique_inverse)
    watertight = bool(mesh.is_watertight and mesh.is_winding_consistent)
    return Topology(watertight, int((uses == 1).sum()), int((uses > 2).sum()), int(face_components(faces, len(vertices)).max()) + 1)


def tidy(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The mesh without degenerate faces; one that was closed stays closed.

    A face of no area is removed by joining the ends of its shortest edge, which takes the face on the other side of that edge with it; just
    to leave it out would open the surface. Two faces on the same corners with opposite normals go together.
    """
    for _ in range(8):
        distinct = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
        faces = faces[distinct & ~_folded(faces)]
        corners = vertices[faces]  # (F, 3, 3)
        length = np.linalg.norm(np.roll(corners, -1, 1) - corners, axis=2)  # (F, 3) of the edge from each corner to the next
        flat = np.linalg.norm(face_vectors(vertices, faces), axis=1) <= 1e-10 * length.max(1) ** 2
        if not flat.any():
            break
        shortest = length[flat].argmin(1)
        rows = faces[flat]
        ends = np.stack([rows[np.arange(len(rows)), shortest], rows[np.arange(len(rows)), (shortest + 1) % 3]], 1)
        # Joining along a chain of edges would pull far vertices together: one join per vertex and round.
        first = np.full(len(vertices), len(ends))
        np.minimum.at(first, ends.ravel(), np.repeat(np.arange(len(ends)), 2))
        ends = ends[(first[ends] == np.arange(len(ends))[:, None]).all(1)]
        target = np.arange(len(vertices))
        target[ends.max(1)] = ends.min(1)
        faces = target[faces]
    return compact(vertices, faces)


def _folded(faces: np.ndarray) -> np.ndarray:
    """(F,) faces that cancel with another face on the same three vertices, in pairs."""
    ordered, count = np.sort(faces, 1), int(faces.max(initial=0)) + 1
    _, edge = np.unique(ordered[:, 0] * count + ordered[:, 1], return_inverse=True)
    _, group = np.unique(edge * count + ordered[:, 2], return_inverse=True)
    if len(group) == 0 or group.max() + 1 == len(faces):
        return np.zeros(len(faces), bool)
    place = faces.argmin(1)
    turned = np.take_along_axis(faces, (place[:, None] + np.arange(3)) % 3, 1)
    positive = turned[:, 1] < turned[:, 2]
    ahead = np.bincount(group, positive)
    behind = np.bincount(group, ~positive)
    pairs = np.minimum(ahead, behind)
    folded = np.zeros(len(faces), bool)
    for side in (positive, ~positive):
        index = np.flatnonzero(side)
        index = index[np.argsort(group[index], kind="stable")]
        own = group[index]
        start = np.searchsorted(own, own)  # position of the first face of the same group
        folded[index] = np.arange(len(own)) - start < pairs[own]
    return folded


def separate(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Split vertices of non-manifold edges, so that each edge has two faces; the surface must be closed.

    Around a vertex, the opposite sides of its faces form directed circuits, as many in as out of each neighbour. A circuit that passes a
    neighbour twice is cut there into simple ones, and each gets a copy of the vertex, moved a hundredth of the way to its own neighbours:
    readers that merge equal positions would join the sheets again. Edge collapse leaves such edges where a surface is thin.
    """
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), 1)
    key, uses = np.unique(edges[:, 0] * len(vertices) + edges[:, 1], return_counts=True)
    on_edges = np.unique(np.divmod(key[uses > 2], len(vertices)))
    if not len(on_edges):
        return vertices, faces
    faces, count = faces.copy(), len(vertices)
    added: list[np.ndarray] = []
    moves: dict[int, np.ndarray] = {}
    around: dict[int, list[int]] = {int(vertex): [] for vertex in on_edges}
    touched = np.isin(faces, on_edges)
    for row, column in zip(*np.nonzero(touched)):
        around[int(faces[row, column])].append(int(row))
    for vertex, rows in around.items():
        circuits = _simple_circuits(vertex, rows, faces)
        for number, circuit in enumerate(circuits if len(circuits) > 1 else []):
            ring = np.unique(faces[circuit])
            ring = ring[ring != vertex]
            places = np.array([vertices[v] if v < len(vertices) else added[v - len(vertices)] for v in ring])
            moved_to = 0.99 * vertices[vertex] + 0.01 * places.mean(0)
            if number == 0:
                moves[vertex] = moved_to
                continue
            corner = faces[circuit]
            faces[circuit] = np.where(corner == vertex, count, corner)
            added.append(moved_to)
            count += 1
    vertices = vertices.copy()
    for vertex, place in moves.items():
        vertices[vertex] = place
    return (np.concatenate([vertices, np.array(added)]) if added else vertices), faces


def _simple_circuits(vertex: int, rows: list[int], faces: np.ndarray) -> list[list[int]]:
    """The faces around a vertex (their rows), grouped into circuits that pass no neighbour twice."""
    leaving: dict[int, list[tuple[int, int]]] = {}
    for row in rows:
        a, b, c = faces[row].tolist()
        start, end = (b, c) if a == vertex else (c, a) if b == vertex else (a, b)
        leaving.setdefault(start, []).append((end, row))
    circuits = []
    for start in list(leaving):
        while leaving[start]:
            nodes, path, at = [start], [], start
            while leaving[at]:
                at, row = leaving[at].pop()
                path.append(row)
                if at in nodes:
                    place = nodes.index(at)
                    circuits.append(path[place:])
                    nodes, path = nodes[: place + 1], path[:place]
                else:
                    nodes.append(at)
    return circuits


def decimate(vertices: np.ndarray, faces: np.ndarray, budget: int) -> tuple[np.ndarray, np.ndarray]:
    """The mesh with at most about `budget` faces, by quadric edge collapse; as it was where it has no more.

    Where the quadrics of a collapse are nearly singular its best place may lie far off the surface, a spike: a vertex that is further than
    a mean edge from all former vertices goes to the nearest of them.
    """
    if len(faces) <= budget:
        return vertices, faces
    # Around the origin and of size one: the library works partly in single precision.
    centre, size = vertices.mean(0), max(float(np.ptp(vertices, 0).max()), 1e-300)
    points, triangles = fast_simplification.simplify(
        np.ascontiguousarray((vertices - centre) / size, np.float64), np.ascontiguousarray(faces, np.int64), target_count=budget
    )
    places = np.asarray(points, np.float64) * size + centre
    edge = float(np.linalg.norm(vertices[faces[:, 1]] - vertices[faces[:, 0]], axis=1).mean())
    distance, nearest = cKDTree(vertices).query(places)
    places = np.where((distance > edge)[:, None], vertices[nearest], places)
    return tidy(places, np.asarray(triangles, np.int64))


def sample(vertices: np.ndarray, faces: np.ndarray, count: int, seed: int, sizes: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Points spread evenly over a surface.

    sizes    (F,) of the faces, to which their points are proportional; None: areas
    returns  face (N,) that each point lies on, ascending, and its barycentric weights (N, 3)

    One point per equal share of the size, in the order of the faces: more even than independent draws, and the same for the same seed.
    """
    rng = np.random.default_rng(seed)
    cumulative = np.cumsum(face_areas(vertices, faces) if sizes is None else sizes)
    where = (np.arange(count) + rng.random(count)) / count * cumulative[-1]
    face = np.minimum(np.searchsorted(cumulative, where, side="right"), len(faces) - 1)
    root, v = np.sqrt(rng.random(count)), rng.random(count)
    return face, np.stack([1 - root, root * (1 - v), root * v], 1)


def sampled(mesh: Mesh, count: int, seed: int, sizes: np.ndarray | None = None) -> PointCloud:
    """`sample` with normals, and colours of the mesh's texture, else of its vertices. The mesh must have a face."""
    face, weight = sample(mesh.vertices, mesh.faces, count, seed, sizes)
    corners = mesh.faces[face]  # (N, 3)

    def mixed(of_corners: np.ndarray) -> np.ndarray:
        return np.einsum("nk,nkc->nc", weight, of_corners)

    normals = mixed(mesh.normals[corners])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.where(length > 1e-6, normals / np.maximum(length, 1e-6), mesh.normals[corners[:, 0]])
    colours = mixed(mesh.colours[corners]) if mesh.texture is None else texture_colours(mesh.texture, mixed(mesh.texture.coordinates[face]))
    return PointCloud(mixed(mesh.vertices[corners]), normals, colours.astype(np.float32))


def texture_colours(texture: Texture, at: np.ndarray) -> np.ndarray:
    """(N, 3) sRGB 0-1 at coordinates (N, 2), bilinear."""
    picture = texture.colours
    height, width = picture.shape[:2]
    x = np.clip(at[:, 0] * width - 0.5, 0, width - 1)
    y = np.clip((1 - at[:, 1]) * height - 0.5, 0, height - 1)
    left, top = x.astype(np.int64), y.astype(np.int64)
    right, bottom = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    across, down = (x - left)[:, None], (y - top)[:, None]
    upper = (1 - across) * picture[top, left] + across * picture[top, right]
    lower = (1 - across) * picture[bottom, left] + across * picture[bottom, right]
    return np.asarray(((1 - down) * upper + down * lower) / 255)
