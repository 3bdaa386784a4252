"""Near planes, and what is masked before them, keep clear of the subject whatever the photographs happen to observe."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from efficientnerf.geometry.cameras import Camera, project
from efficientnerf.geometry.spaces import ContractedSpace
from stages.framing.near_planes import content_depths, reliable_points
from stages.framing.scene_bounds import in_view
from stages.framing.training_frame import TrainingFrame, find_training_frame
from stages.framing.view_coverage import cells_before_near, contradicted
from stages.io.capture import Capture, Photo, SparsePoints
from tests.stages.forward_facing import looking

SIDE = 48


def seen_by(cameras: list[Camera], points: np.ndarray, most: int, rng: np.random.Generator) -> list[tuple[int, ...]]:
    """Of each point up to `most` of the cameras that have it in view: its track."""
    visible = in_view(points, cameras)
    return [tuple(sorted(rng.permutation(np.flatnonzero(column))[:most].tolist())) for column in visible.T]


def room_capture(seed: int, *, cameras: int = 24, heights: int = 1, on_subject: int = 40, stray: str = "none", scale: float = 1.0) -> Capture:
    """A plain subject of radius 0.5 in a room 10 across, seen all round from 3 away: nearly all sparse points lie on the walls, and every fifth photograph
    observes none but those. Some tracks are wrong.

    on_subject  points on the subject and the table below it
    stray       "none"; "inside": a camera in the ring; "wrong": one turned away by 90 degrees; "both"
    """
    rng = np.random.default_rng(seed)
    angles = np.linspace(0, 2 * np.pi, cameras, endpoint=False)
    placed = [looking(np.array([3 * np.cos(a), 3 * np.sin(a), 0.8 + 0.9 * (n % heights)]), rng.normal(0, 0.05, 3)) for n, a in enumerate(angles)]
    if stray in ("inside", "both"):
        at = rng.uniform(-0.8, 0.8, 3)
        placed[3] = looking(at, at + np.append(rng.normal(size=2), 0))
    if stray in ("wrong", "both"):
        placed[7] = looking(placed[7].centre, placed[7].centre + np.array([-placed[7].centre[1], placed[7].centre[0], 0]))
    walls = rng.uniform(-5, 5, (3000, 3))
    axis = rng.integers(0, 2, 3000)
    walls[np.arange(3000), axis] = rng.choice([-5.0, 5.0], 3000)
    walls[:, 2] = rng.uniform(-1, 4, 3000)
    direction = rng.normal(size=(on_subject, 3))
    subject = 0.5 * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    outliers = rng.uniform(-4, 4, (15, 3))
    xyz = np.concatenate([walls, subject, outliers])
    tracks = seen_by(placed, xyz, 6, rng)
    plain = set(range(0, cameras, 5))
    tracks = [tuple(v for v in track if not (v in plain and n >= 3000)) for n, track in enumerate(tracks)]
    error = np.concatenate([rng.uniform(0.3, 1.0, 3000 + on_subject), rng.uniform(2, 4, 15)])
    observed = [n for n, track in enumerate(tracks) if len(track) >= 2]
    points = SparsePoints(scale * xyz[observed], np.zeros((len(observed), 3), np.uint8), error[observed], tuple(tracks[n] for n in observed))
    photos = []
    for n, camera in enumerate(placed):
        pose = camera.world_from_camera.copy()
        pose[:3, 3] *= scale
        photos.append(Photo(replace(camera, name=f"{n:03d}.jpg", world_from_camera=pose), Path("a.jpg")))
    return Capture("photographs", tuple(photos), None, points=points)


def masked_share_of_subject(capture: Capture, scale: float, framed: TrainingFrame) -> float:
    """The share of points in the subject that lie in density voxels which are masked before the near planes."""
    world = framed.world_from_capture
    cameras = [world.camera(photo.camera) for photo in capture.photos]
    filled = world.points(capture.points.xyz[reliable_points(capture.points, len(cameras))])
    space = ContractedSpace(framed.bounds)
    cells = cells_before_near(space, cameras, framed.near_far_planes[:, 0].tolist(), SIDE, filled)
    inside = np.random.default_rng(0).normal(size=(2000, 3))
    inside *= 0.5 * scale * np.random.default_rng(1).uniform(0, 1, (2000, 1)) ** (1 / 3) / np.linalg.norm(inside, axis=1, keepdims=True)
    return contradicted(cells, space, world.points(inside))


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.too_slow], derandomize=True)
@given(
    seed=st.integers(0, 1000), cameras=st.integers(12, 40), heights=st.integers(1, 2), on_subject=st.integers(0, 200),
    stray=st.sampled_from(["none", "inside", "wrong", "both"]), scale=st.sampled_from([1e-3, 1.0, 1e4]),
)  # fmt: skip
def test_nothing_of_the_subject_is_masked(seed: int, cameras: int, heights: int, on_subject: int, stray: str, scale: float) -> None:
    capture = room_capture(seed, cameras=cameras, heights=heights, on_subject=on_subject, stray=stray, scale=scale)
    assert masked_share_of_subject(capture, scale, find_training_frame(capture)) <= 0.01


def test_points_that_others_observe_count_as_much_as_a_photographs_own() -> None:
    """What each photograph observes itself lies on the walls alone."""
    capture = room_capture(0, on_subject=200)
    framed = find_training_frame(capture)
    world = framed.world_from_capture
    placed = [world.camera(photo.camera) for photo in capture.photos]
    begins = content_depths(capture, placed, world)[:, 0] / world.scale
    assert begins.max() < 3.0
    assert (framed.near_far_planes[:, 0] / world.scale).max() <= 1.5


def test_near_planes_never_begin_behind_the_subjects_middle() -> None:
    capture = replace(room_capture(0), points=None)
    framed = find_training_frame(capture)
    placed = [framed.world_from_capture.camera(photo.camera) for photo in capture.photos]
    middle = framed.world_from_capture.points(np.zeros((1, 3)))
    depths = np.array([project(camera, middle)[1][0] for camera in placed])
    assert (framed.near_far_planes[:, 0] < 0.6 * depths).all()


def test_no_single_view_masks_what_lies_before_its_near_plane() -> None:
    capture = room_capture(0)
    framed = find_training_frame(capture)
    space, cameras = ContractedSpace(framed.bounds), [framed.world_from_capture.camera(photo.camera) for photo in capture.photos]
    near = framed.near_far_planes[:, 0].copy()
    usual = cells_before_near(space, cameras, near.tolist(), SIDE)
    near[5] *= 10
    grown = cells_before_near(space, cameras, near.tolist(), SIDE) & ~usual
    world = space.world(torch.from_numpy((np.argwhere(grown) + 0.5) / SIDE)).numpy()
    others = [camera for n, camera in enumerate(cameras) if n != 5]
    before = sum(((world - c.centre) @ c.forward < near[n] * 1.2).astype(int) for n, c in enumerate(cameras) if n != 5)
    close = np.min([np.linalg.norm(world - camera.centre, axis=1) for camera in others], axis=0)
    assert ((before >= 1) | (close < near.max())).all()
