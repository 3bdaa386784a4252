"""Rendering ends, whatever the file and the camera say; Python answers to signals meanwhile; and memory keeps to the file's size."""

import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from efficientnerf.asset.format import FormatError, describe, load
from efficientnerf.asset.rendering import MOST_PIXELS, render, render_rays
from efficientnerf.asset.tree import NerfTree
from efficientnerf.surface.extraction import surface
from efficientnerf.surface.volume import volume_of
from tests.efficientnerf.hostile import HOSTILE, filled
from tests.efficientnerf.tree_reference import render_reference
from tests.efficientnerf.trees import looking, random_cascades, random_tree, uniform_tree

FAR = [1e9, 1e15, 1e18, 1e25, 1e200]


@pytest.mark.parametrize(("lookup", "distance"), [("trilinear", FAR[0]), ("trilinear", FAR[-1]), ("nearest", FAR[-1])])
def test_rays_from_far_away_end(lookup: str, distance: float) -> None:
    """Rounding makes the stretch of such a ray in the grid longer than the grid, by far more steps than could ever be done."""
    tree = random_tree(0, lookup=lookup)
    directions = np.array([[1.0, 0, 0], [0.6, 0.8, 0], [-0.48, 0.6, 0.64], [np.sqrt(1 / 3)] * 3])
    origins = (tree.bounds_min + tree.bounds_max) / 2 - distance * directions
    found = render_rays(tree, origins, directions)
    assert ((found.opacity >= 0) & (found.opacity <= 1)).all()
    reference = render_reference(tree, torch.from_numpy(origins), torch.from_numpy(directions))
    assert torch.isfinite(reference[0]).all()


@pytest.mark.parametrize("tree", [random_tree(0), random_cascades(0, count=3)], ids=["one box", "cascades"])
def test_rays_of_numbers_that_are_not_finite_see_nothing(tree: NerfTree) -> None:
    origins, directions = np.full((4, 3), 0.5), np.full((4, 3), 0.5)
    origins[0, 1], origins[1, 2], directions[2, 0], directions[3] = np.nan, np.inf, np.nan, np.inf
    found = render_rays(tree, origins, directions)
    assert not found.opacity.any()
    assert np.isfinite(found.colour).all()


@pytest.mark.parametrize("lookup", ["trilinear", "nearest"])
@pytest.mark.parametrize("least", [-1e-42, 1e-42, -1e-320, 1e-31, 0.0])
def test_rays_along_a_face_of_cells_end(lookup: str, least: float) -> None:
    """A direction's component may be so small that its inverse is infinite, and the distance to the face zero."""
    tree = replace(uniform_tree((4, 4, 4)), voxel=1.0, bounds_min=np.zeros(3), lookup=lookup)
    for axis in range(3):
        origins = np.full((3, 3), 4.0) + np.arange(3)[:, None] * 4.0
        directions = np.full((3, 3), least)
        directions[:, axis], origins[:, axis] = 1.0, -2.0
        assert np.isfinite(render_rays(tree, origins, directions).opacity).all()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"width": 10**6, "height": 10**6}, f"1000000 x 1000000 pixels; expected 1 to {MOST_PIXELS}"),
        ({"width": 0}, "0 x 23 pixels"),
        ({"params": (0.0, 10.0, 10.0)}, "focal length 0"),
        ({"params": (-1.0, 10.0, 10.0)}, "focal length -1"),
        ({"params": (np.inf, 10.0, 10.0)}, "not finite"),
        ({"params": (30.0, np.nan, 10.0)}, "not finite"),
        ({"world_from_camera": np.full((4, 4), np.nan)}, "not finite"),
    ],
)
def test_cameras_without_an_image_are_refused(changes: dict[str, Any], message: str) -> None:
    tree = random_tree(0)
    with pytest.raises(ValueError, match=message):
        render(tree, replace(looking(tree), **changes))


class _Signalled(Exception):
    pass


@pytest.mark.skipif(not hasattr(signal, "setitimer"), reason="no interval timers here")
@pytest.mark.parametrize("lookup", ["trilinear", "nearest"])
def test_a_signal_is_answered_while_an_image_is_rendered(lookup: str) -> None:
    """The whole image takes many times as long as is waited for."""
    fog = replace(uniform_tree((8, 8, 8), brick=16, voxel=0.01, sigma=0.01), lookup=lookup)
    render(fog, looking(fog, 8))

    def answer(*_: Any) -> None:
        raise _Signalled

    before = signal.signal(signal.SIGALRM, answer)
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.3)
        begin = time.perf_counter()
        with pytest.raises(_Signalled):
            render(fog, looking(fog, 4000))
        assert time.perf_counter() - begin < 3  # a second where nothing else runs
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


@pytest.mark.parametrize("which", ["one voxel in 2^27 cells", "large bricks of one voxel each"])
def test_memory_that_a_file_would_take_is_known_before_it_is_taken(which: str, tmp_path: Path) -> None:
    import tracemalloc

    make, message = HOSTILE[which]
    path = tmp_path / "a.nerftree"
    path.write_bytes(make())
    tracemalloc.start()
    for read in (load, describe):
        with pytest.raises(FormatError, match=message):
            read(path)
    assert tracemalloc.get_traced_memory()[1] < 2**20
    tracemalloc.stop()


@pytest.mark.parametrize("cells", [(300, 300, 300), (65536, 20, 20), (20, 65536, 1)])
def test_the_surface_of_a_few_voxels_in_a_vast_grid(cells: tuple[int, int, int], tmp_path: Path) -> None:
    """Neither memory nor time go with the grid."""
    path = tmp_path / "a.nerftree"
    path.write_bytes(filled(cells, 20, brick=16))
    tree = load(path)
    tree.density_values[:] = 1e3
    begin = time.perf_counter()
    mesh = surface(volume_of(tree), 500.0)
    assert len(mesh.faces) > 0
    assert time.perf_counter() - begin < 20  # two where nothing else runs


MEASURE = """
import resource, sys
from pathlib import Path
from efficientnerf.asset.format import load
from efficientnerf.asset.rendering import render
from tests.efficientnerf.trees import looking, random_tree
small = random_tree(0)
render(small, looking(small))
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
tree = load(Path(sys.argv[1]))
render(tree, looking(tree, 100))
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="ru_maxrss has other units elsewhere")
@pytest.mark.parametrize("made", [lambda: filled((320, 320, 320), 1), lambda: filled((96, 96, 96), 96**3)])
def test_memory_keeps_to_eight_times_the_file_and_200_mb(made: Any, tmp_path: Path) -> None:
    """Files that are nearly all empty, as large as the rule lets pass, and one whose bricks are all there."""
    path = tmp_path / "a.nerftree"
    path.write_bytes(made())
    done = subprocess.run([sys.executable, "-c", MEASURE, str(path)], capture_output=True, text=True, check=True)
    assert int(done.stdout) < 8 * path.stat().st_size + 200e6
