"""DTU's protocol on files as DTU has them, of a plane whose distances are known."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.io import savemat

from benchmarks.dtu import FARTHEST, SPACING, distances, in_masks, observed, thinned
from efficientnerf.geometry.cameras import Camera

SCAN = 24


def square(height: float, side: float = 20.0) -> tuple[np.ndarray, np.ndarray]:
    """A square of two faces at a height, from 0 to `side` in x and y."""
    corners = np.array([[0, 0, height], [side, 0, height], [side, side, height], [0, side, height]], np.float64)
    return corners, np.array([[0, 1, 2], [0, 2, 3]])


@pytest.fixture(scope="module")
def dtu(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scan of the square at height 0, every 0.25 mm, and of the table at -5; the observed box ends at x = 15."""
    folder = tmp_path_factory.mktemp("dtu")
    (folder / "ObsMask").mkdir()
    (folder / "Points" / "stl").mkdir(parents=True)
    x, y = (part.ravel() for part in np.meshgrid(*2 * (np.arange(0.125, 20, 0.25),)))
    both = np.concatenate([np.stack([x, y, np.full(len(x), height)], 1) for height in (0.0, -5.0)])
    trimesh.PointCloud(both).export(folder / "Points" / "stl" / f"stl{SCAN:03d}_total.ply")
    savemat(folder / "ObsMask" / f"ObsMask{SCAN}_10.mat", {"ObsMask": np.ones((31, 41, 21), bool), "BB": np.array([[0, 0, -5], [15, 20, 5.0]]), "Res": 0.5})
    savemat(folder / "ObsMask" / f"Plane{SCAN}.mat", {"P": np.array([[0.0], [0.0], [1.0], [2.0]])})  # above -2: not the table
    return folder


def test_a_mesh_over_the_scan_is_as_far_as_it_lies_above(dtu: Path) -> None:
    found = distances(*square(1.5), observed(dtu, SCAN))
    assert found.accuracy == pytest.approx(1.5, abs=0.02)
    assert found.completeness == pytest.approx(1.5, abs=0.02)
    assert found.chamfer == (found.accuracy + found.completeness) / 2


def test_only_what_was_observed_counts_for_accuracy_and_all_of_the_mesh_for_completeness(dtu: Path) -> None:
    """A part beyond the observed box, far from the scan, leaves accuracy as it is; without it the scan there is not met."""
    truth = observed(dtu, SCAN)
    vertices, faces = square(0.0)
    raised = vertices + np.array([16.0, 0.0, 9.0])
    both = distances(np.concatenate([vertices, raised]), np.concatenate([faces, faces + 4]), truth)
    assert both.accuracy < 0.1
    assert both.completeness < 0.15
    half = distances(vertices * [0.5, 1, 1], faces, truth)
    assert half.accuracy == pytest.approx(both.accuracy, abs=0.02)
    assert 2.4 < half.completeness < 2.6  # half of it 0 to 10 mm away


def test_what_is_farthest_does_not_count(dtu: Path) -> None:
    truth = observed(dtu, SCAN)
    vertices, faces = square(0.0)
    sunk = distances(np.concatenate([vertices, vertices * [0.5, 0.5, 1] + [0, 0, -FARTHEST - 1]]), np.concatenate([faces, faces + 4]), truth)
    assert sunk.accuracy == pytest.approx(distances(vertices, faces, truth).accuracy, abs=0.01)
    assert not np.isfinite(distances(vertices + np.array([0, 0, 500.0]), faces, truth).chamfer)


def test_thinned_points_are_apart_and_leave_no_holes() -> None:
    points = np.random.default_rng(1).random((20_000, 3)) * [4, 4, 0]
    kept = thinned(points, SPACING)
    apart = np.linalg.norm(kept[:, None] - kept, axis=2) + 9 * np.eye(len(kept))
    assert apart.min() > SPACING
    assert np.linalg.norm(points[:, None] - kept, axis=2).min(1).max() <= SPACING


def test_faces_outside_of_a_mask_go_with_a_margin() -> None:
    """A camera above the square shows it 1600 pixels wide; the mask is its left half."""
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[:3, 3] = 10, 10, 20
    camera = Camera("above", 1600, 1600, "SIMPLE_PINHOLE", (1600.0, 800.0, 800.0), pose)
    mask = np.zeros((400, 400), bool)  # of the working size
    mask[:, :200] = True
    left = np.array([[0.5, 1, 0], [9, 1, 0], [9, 9, 0.0]])
    kept = in_masks(np.concatenate([left + np.array([right, 0, 0]) for right in (0.0, 1.2, 1.4)]), np.arange(9).reshape(3, 3), [camera], [mask])
    assert kept.tolist() == [[0, 1, 2], [3, 4, 5]]  # 16 and 32 pixels beyond: 24 are allowed
