"""The foreground region, of rays that are cast into scenes made of balls, boxes and planes."""

from collections.abc import Callable, Sequence

import numpy as np
import pytest

from efficientnerf.asset.region import inside_distance
from efficientnerf.asset.tree import Region
from efficientnerf.capture.foreground import find_subject
from efficientnerf.geometry.cameras import Camera, rays
from tests.poses import looking_at

SIDE = 48
Shape = Callable[[np.ndarray, np.ndarray], np.ndarray]


def ball(centre: Sequence[float], radius: float) -> Shape:
    """Distance along rays to a ball."""

    def hit(origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        away = origins - np.asarray(centre)
        half = (away * directions).sum(1)
        inside = half**2 - (away**2).sum(1) + radius**2
        at = -half - np.sqrt(np.maximum(inside, 0))
        return np.where((inside > 0) & (at > 0), at, np.inf)

    return hit


def box(low: Sequence[float], high: Sequence[float], *, from_within: bool = False) -> Shape:
    """Distance along rays to a box, or of rays that begin in it to its far side."""

    def hit(origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        with np.errstate(divide="ignore", invalid="ignore"):
            ends = np.stack([(np.asarray(low) - origins) / directions, (np.asarray(high) - origins) / directions])
        enter, leave = np.nanmax(ends.min(0), axis=1), np.nanmin(ends.max(0), axis=1)
        if from_within:
            return np.where(leave > 0, leave, np.inf)
        return np.where((leave > enter) & (enter > 0), enter, np.inf)

    return hit


def camera(at: Sequence[float], target: Sequence[float], fov: float = 60.0) -> Camera:
    focal = SIDE / 2 / np.tan(np.radians(fov / 2))
    return Camera("", SIDE, SIDE, "SIMPLE_PINHOLE", (focal, SIDE / 2, SIDE / 2), looking_at(at, target))


def ring(count: int, radius: float, height: float, *, arc: float = 360.0, middle: float = -90.0, target: Sequence[float] = (0, 0, 0)) -> list[Camera]:
    angles = np.radians(middle + arc * ((np.arange(count) + 0.5) / count - 0.5))
    return [camera([radius * np.cos(a) + target[0], radius * np.sin(a) + target[1], height], target) for a in angles]


def cast(cameras: Sequence[Camera], shapes: Sequence[Shape], noise: float = 0.0, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points, views and pixels of all rays; not finite where nothing is hit."""
    generator = np.random.default_rng(seed)
    points, views, pixels = [], [], []
    grid = np.stack(np.meshgrid(np.arange(SIDE), np.arange(SIDE)), axis=-1).reshape(-1, 2) + 0.5
    for number, one in enumerate(cameras):
        origins, directions = rays(one, grid)
        far = np.min([shape(origins, directions) for shape in shapes], axis=0)
        far = far * (1 + noise * generator.normal(size=len(far)))
        points.append(origins + directions * far[:, None])
        views.append(np.full(len(far), number))
        pixels.append(2 * grid / SIDE - 1)
    return np.concatenate(points), np.concatenate(views), np.concatenate(pixels)


def region(cameras: Sequence[Camera], shapes: Sequence[Shape], **more: float) -> Region:
    return found_in(*cast(cameras, shapes, **more), cameras)  # type: ignore[arg-type]


def found_in(points: np.ndarray, views: np.ndarray, pixels: np.ndarray, cameras: Sequence[Camera]) -> Region:
    found = find_subject(points, views, pixels, cameras)
    assert found is not None
    return found.region


def on_ball(centre: Sequence[float], radius: float) -> np.ndarray:
    directions = np.random.default_rng(5).normal(size=(400, 3))
    return np.asarray(centre) + radius * directions / np.linalg.norm(directions, axis=1, keepdims=True)


def in_box(low: Sequence[float], high: Sequence[float]) -> np.ndarray:
    return np.random.default_rng(6).uniform(low, high, (400, 3))


ROOM = box([-6, -6, -0.5], [6, 6, 4], from_within=True)


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_a_ball_on_a_floor_is_whole_and_the_floor_a_disc_round_it(noise: float) -> None:
    cameras = ring(30, 2.5, 1.2)
    found = region(cameras, [ball([0, 0, 0], 0.5), ROOM], noise=noise)
    assert (inside_distance(found, on_ball([0, 0, 0], 0.5)) > found.fade).all()
    sides = found.bounds[1] - found.bounds[0]
    assert found.corner_radius == pytest.approx(sides[0] / 2) == pytest.approx(sides[1] / 2)
    assert 1.0 < sides[0] < 2.2
    assert inside_distance(found, np.array([[0.0, 0.0, -0.5]]))[0] > found.fade  # its floor is not faded
    assert found.bounds[0, 2] > -0.9
    assert found.bounds[1, 2] < 1.0


def test_plain_ears_that_reach_towards_the_cameras_belong_to_the_head() -> None:
    """Close-ups before a wall: the head fills the pictures, its ears leave most of them."""
    head, ears = ball([0, -0.45, 0], 0.4), [([0.3, -1.0, 0.35], [0.42, -0.6, 0.9]), ([-0.42, -1.0, 0.35], [-0.3, -0.6, 0.9])]
    nose = ([-0.06, -1.25, -0.1], [0.06, -0.75, 0.0])
    cameras = [camera([2.0 * np.sin(a), -0.3 - 1.8 * np.cos(a), z], [0, -0.4, 0.1], 50) for a in np.radians(np.linspace(-60, 60, 12)) for z in (-0.2, 0.5)]
    wall = box([-8, 0, -8], [8, 1, 8])
    found = region(cameras, [head, wall, *(box(*ear) for ear in ears), box(*nose)])
    for low, high in (*ears, nose):
        assert (inside_distance(found, in_box(low, high)) > found.fade).all()
    assert (inside_distance(found, on_ball([0, -0.45, 0], 0.4)) > found.fade).all()
    sides = found.bounds[1] - found.bounds[0]
    assert sides[0] < 3  # of a wall of 16
    assert sides[2] < 3
    assert found.bounds[1, 1] > found.fade  # the wall belongs to it, unfaded
    assert found.bounds[1, 1] < 0.5


@pytest.mark.parametrize(("away", "uncertain"), [(1.5, 0.0), (2.0, 0.03), (2.6, 0.15)])
def test_a_head_is_whole_in_close_ups_and_before_a_wall_of_uncertain_depth(away: float, uncertain: float) -> None:
    """Photographs by hand; a plain wall, whose depth the field does not know. The closest have the tips of the ears in a tenth of them."""
    centre, ears = [0, -0.45, 0], [([0.3, -1.0, 0.35], [0.42, -0.6, 0.9]), ([-0.42, -1.0, 0.35], [-0.3, -0.6, 0.9])]
    nose = ([-0.06, -1.25, -0.1], [0.06, -0.75, 0.0])
    generator = np.random.default_rng(3)
    cameras = []
    for a in np.radians(np.linspace(-55, 50, 16)):
        for z in (-0.3, 0.2, 0.7):
            shaken = 0.1 * generator.normal(size=3)
            cameras.append(camera([away * np.sin(a) + shaken[0], -0.3 - away * np.cos(a), z], [shaken[1], -0.4, 0.1 + shaken[2]], 50))
    subject = [ball(centre, 0.4), *(box(*ear) for ear in ears), box(*nose)]
    points, views, pixels = cast(cameras, [*subject, box([-8, 0, -8], [8, 1, 8])])
    wall = ~np.isfinite(cast(cameras, subject)[0]).all(axis=1)
    centres = np.array([one.centre for one in cameras])[views]
    points[wall] = centres[wall] + (points - centres)[wall] * (1 + uncertain * generator.normal(size=(int(wall.sum()), 1)))
    found = found_in(points, views, pixels, cameras)
    for low, high in (*ears, nose):
        assert (inside_distance(found, in_box(low, high)) > found.fade).all()
    assert (inside_distance(found, on_ball(centre, 0.4)) > 0).all()
    assert (found.bounds[1] - found.bounds[0]).max() < 4.5  # of a wall of 16


HEAD, NOSE, BODY = ([0, -0.45, 0], 0.4), ([-0.06, -1.25, -0.1], [0.06, -0.75, 0.0]), ([-0.5, -0.3, -1.2], [0.5, 0.5, -0.2])
Corners = tuple[list[float], list[float]]


def both(*boxes: Corners) -> list[Corners]:
    """Boxes and their mirror images, left and right."""
    return [*boxes, *(([-high[0], *low[1:]], [-low[0], *high[1:]]) for low, high in boxes)]


# What lies in one plane that faces the cameras, and what reaches out of the middle of the pictures.
PARTS = {
    "flat ears": both(([0.1, -0.45, 0.3], [0.25, -0.42, 1.2])),
    "wide ears": both(([0.1, -0.45, 0.3], [0.5, -0.42, 1.2])),
    "thick ears": both(([0.1, -0.5, 0.3], [0.25, -0.35, 1.2])),
    "one ear": [([0.05, -0.45, 0.3], [0.3, -0.42, 1.2])],
    "an elephant's ears": both(([0.2, -0.45, -0.5], [1.1, -0.4, 0.5])),
    "a mane": [([-0.8, -0.4, -0.8], [0.8, -0.36, 0.8])],
    "horns": both(([0.3, -0.5, 0.2], [0.4, -0.4, 1.0]), ([0.4, -0.5, 0.9], [0.9, -0.4, 1.0])),
    "antlers": both(([0.2, -0.5, 0.3], [0.28, -0.42, 1.3]), ([0.28, -0.5, 0.8], [0.7, -0.42, 0.88]), ([0.28, -0.5, 1.2], [0.9, -0.42, 1.28])),
}


def in_front(distance: float, height: float) -> list[Camera]:
    angles = np.radians(np.linspace(-60, 60, 20))
    return [camera([distance * np.sin(a), -0.45 - distance * np.cos(a), height], [0, -0.45, 0.2], 55) for a in angles]


CONDITIONS = [(False, 0.2, 0.0), (False, 0.2, 0.01), (True, 0.2, 0.01), (True, 1.2, 0.01)]  # a body, its height, noise


@pytest.mark.parametrize(
    ("kind", "wall", "body", "height", "noise"),
    [(kind, (None, 0.5, 4.0)[n % 3], *CONDITIONS[n % 4]) for n, kind in enumerate(PARTS)],
)
def test_a_head_is_whole_whatever_it_wears(kind: str, body: bool, height: float, noise: float, wall: float | None) -> None:
    """What of it is in one plane is no support: rays pass between and beside its parts, and go on to a wall or to nowhere."""
    cameras, parts = in_front(2.6, height), [*PARTS[kind], NOSE]
    shapes = [ball(*HEAD), *(box(*part) for part in parts)]
    shapes += [box(*BODY)] if body else []
    shapes += [box([-20, wall, -20], [20, wall + 1, 20])] if wall is not None else []
    found = region(cameras, shapes, noise=noise)
    points, views, _ = cast(cameras, [box(*part) for part in parts])
    for low, high in parts:
        place = np.concatenate([in_box(low, high), np.stack([low, high])])
        assert (inside_distance(found, place) > 0).all()
    assert len(np.unique(views[np.isfinite(points).all(axis=1)])) == len(cameras)  # it is in view of all
    head = on_ball(*HEAD)
    assert (inside_distance(found, head[head[:, 1] < HEAD[0][1]]) > 0).all()  # the back is seen by none
    assert (found.bounds[1] - found.bounds[0]).max() < 5  # of a wall of 40


def test_a_table_is_clipped_and_a_panel_that_ends_in_view_is_not() -> None:
    """The same plane with and without edges that all photographs show."""
    cameras = in_front(2.5, 0.2)
    wall, panel = ([-20.0, 0.0, -20.0], [20.0, 1.0, 20.0]), ([-0.9, 0.0, -0.9], [0.9, 0.1, 0.9])
    clipped, whole = (region(cameras, [ball(*HEAD), box(*behind)]) for behind in (wall, panel))
    assert (clipped.bounds[1] - clipped.bounds[0])[[0, 2]].max() < 1.6
    assert (inside_distance(whole, in_box([-0.9, 0.0, -0.9], [0.9, 0.02, 0.9])) > 0).all()


def test_a_known_table_ends_the_region_though_rays_go_on_round_its_middle() -> None:
    """As where a table is plain, and nothing but its middle keeps fog away."""
    cameras = ring(30, 2.5, 1.2)
    points, views, pixels = cast(cameras, [ball([0, 0, 0], 0.5), ROOM])
    clean = found_in(points, views, pixels, cameras)
    generator = np.random.default_rng(2)
    struck = (points[:, 2] < -0.49) & (np.linalg.norm(points[:, :2], axis=1) > 0.9) & (generator.random(len(points)) < 0.4)
    centres = np.array([one.centre for one in cameras])[views]
    points[struck] = centres[struck] + (points - centres)[struck] * generator.uniform(1.2, 2, (int(struck.sum()), 1))
    alone, known = (find_subject(points, views, pixels, cameras, known=planes) for planes in ((), [(np.array([0.0, 0.0, 1.0]), -0.5)]))
    assert alone is not None
    assert known is not None
    assert not alone.planes
    assert np.abs(known.region.bounds - clean.bounds).max() < 0.25
    below = -0.5 - known.region.bounds[0, 2]
    assert clean.fade < below < 0.15, "its depth is known better than to a cell"


@pytest.mark.parametrize("offset", [0.0, 0.4, -3.0])
def test_a_known_plane_that_the_field_refutes_changes_nothing(offset: float) -> None:
    """The floor is seen below it, or nothing is on it."""
    cameras = ring(30, 2.5, 1.2)
    points, views, pixels = cast(cameras, [ball([0, 0, 0], 0.5), ROOM])
    found = find_subject(points, views, pixels, cameras, known=[(np.array([0.0, 0.0, 1.0]), offset)])
    assert found is not None
    np.testing.assert_array_equal(found.region.bounds, found_in(points, views, pixels, cameras).bounds)


def test_floaters_before_the_cameras_and_scattered_ends_change_little() -> None:
    cameras = ring(30, 2.5, 1.2)
    shapes = [ball([0, 0, 0], 0.5), ROOM]
    points, views, pixels = cast(cameras, shapes)
    clean = found_in(points, views, pixels, cameras)
    generator = np.random.default_rng(1)
    struck = generator.random(len(points)) < 0.05
    centres = np.array([one.centre for one in cameras])[views]
    points[struck] = centres[struck] + (points - centres)[struck] * generator.uniform(0.02, 3, (int(struck.sum()), 1))
    blob = generator.choice(len(cameras), 3)
    near = np.isin(views, blob) & (np.linalg.norm(pixels - 0.3, axis=1) < 0.2)
    points[near] = centres[near] + 0.1 * (points - centres)[near]  # a patch before three of the cameras
    noisy = found_in(points, views, pixels, cameras)
    assert np.abs(noisy.bounds - clean.bounds).max() < 0.25


def test_what_is_scattered_far_away_makes_no_cell_larger() -> None:
    """As in a large room: each of a hundred thousand rays ends somewhere else."""
    cameras = ring(48, 2.5, 1.2)
    points, views, pixels = cast(cameras, [ball([0, 0, 0], 0.5), box([-60, -60, -0.5], [60, 60, 40], from_within=True)])
    clean = find_subject(points, views, pixels, cameras)
    centres = np.array([one.centre for one in cameras])[views]
    far = np.linalg.norm(points - centres, axis=1) > 8
    points[far] = centres[far] + (points - centres)[far] * np.random.default_rng(1).uniform(1, 20, (int(far.sum()), 1))
    found = find_subject(points, views, pixels, cameras)
    assert found is not None
    assert clean is not None
    assert found.side == clean.side
    np.testing.assert_array_equal(found.region.bounds, clean.region.bounds)


def test_fog_in_which_hardly_a_ray_ends_where_others_do_has_no_subject() -> None:
    cameras = ring(30, 2.5, 1.2)
    points, views, pixels = cast(cameras, [ball([0, 0, 0], 0.5), ROOM])
    kept = np.random.default_rng(0).random(len(points)) < 0.02
    points[~kept] = np.inf  # the others end nowhere
    assert find_subject(points, views, pixels, cameras) is None


def test_a_subject_seen_from_one_side_is_whole() -> None:
    cameras = ring(16, 2.2, 0.6, arc=90)
    found = region(cameras, [box([-0.4, -0.4, -0.5], [0.4, 0.4, 0.7]), ROOM])
    seen = in_box([-0.4, -0.4, -0.5], [0.4, -0.4, 0.7])
    assert (inside_distance(found, seen) > found.fade).all()
    assert (found.bounds[1] - found.bounds[0])[:2].max() < 3.5


def test_the_scale_of_the_scene_does_not_matter() -> None:
    cameras = ring(20, 2.5, 1.0)
    points, views, pixels = cast(cameras, [ball([0, 0, 0], 0.5), ROOM])
    found = found_in(points, views, pixels, cameras)
    larger = []
    for one in cameras:
        pose = one.world_from_camera.copy()
        pose[:3, 3] *= 8
        larger.append(Camera(one.name, one.width, one.height, one.model, one.params, pose))
    scaled = found_in(8 * points, views, pixels, larger)
    assert scaled.bounds == pytest.approx(8 * found.bounds)
