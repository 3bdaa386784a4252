"""The codes of a packed asset: as good as its size has room for."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from efficientnerf.asset.economy import DEFAULT_RATE, economy_of
from efficientnerf.asset.format import serialize
from efficientnerf.asset.refinement.targets import Targets
from efficientnerf.asset.tree import NerfTree, tree_from_voxels
from stages.bake import economy
from stages.bake.refine.timing import REFIT_STEPS
from stages.bake.settings import BakeSettings
from tests.efficientnerf.balls import BOUNDS, pixels
from tests.stages.balls import StopAt, job


@pytest.fixture(scope="module")
def tree() -> NerfTree:
    side, rng = 20, np.random.default_rng(0)
    at = np.argwhere(np.ones((side,) * 3, bool))
    density = np.where(np.linalg.norm(at - side / 2 + 0.5, axis=1) < side / 4, rng.uniform(1, 30, len(at)), 0.2)
    sh = rng.normal(size=(len(at), 4, 3)).astype(np.float32)
    return tree_from_voxels((side // 4,) * 3, 2 / side, BOUNDS[0], at, density, sh, background=(1.0, 1.0, 1.0))


def packed(tree: NerfTree, size: int, folder: Path) -> tuple[NerfTree, list[dict[str, Any]], StopAt]:
    """The packed tree, what was reported, and how often it could have been stopped."""
    events: list[dict[str, Any]] = []
    stop = StopAt()
    made = job(folder, BakeSettings(visibility_rays=1000, seed=0, refine_rays_per_batch=256), events=events, stop=stop)
    found, psnr = economy.packed_tree(made, tree, Targets(pixels(), (1.0, 1.0, 1.0)), size)
    assert f"{psnr:.2f} dB" in events[-1]["text"]
    return found, events, stop


def test_codes_are_coarser_where_the_file_would_be_too_large(tree: NerfTree, tmp_path: Path) -> None:
    size = int(0.7 * len(serialize(economy_of(tree).at(DEFAULT_RATE), "packed")))
    found, events, _ = packed(tree, size, tmp_path)
    assert 0.85 * size < len(serialize(found, "packed")) <= size
    assert not [event for event in events if event["event"] == "warning"]
    again, _, _ = packed(tree, size, tmp_path)
    assert serialize(again, "packed") == serialize(found, "packed")


def test_voxels_that_weigh_least_go_where_the_coarsest_codes_are_too_large(tree: NerfTree, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(economy, "COARSEST", 10 * DEFAULT_RATE)
    coarsest = len(serialize(economy_of(tree).at(10 * DEFAULT_RATE), "packed"))
    found, _, _ = packed(tree, coarsest // 2, tmp_path)
    assert len(serialize(found, "packed")) <= coarsest // 2
    assert len(found.density_values) < len(tree.density_values)
    assert found.density_values.max() > 1


def test_a_stopped_packing_stops_at_each_step(tree: NerfTree, tmp_path: Path) -> None:
    """Signals are answered before codes are chosen and after each step that tables are fitted in."""
    assert packed(tree, 10**7, tmp_path)[2].count > REFIT_STEPS / economy.REFIT_ROUNDS
