"""The codes of a packed asset: as good as its size has room for."""

from types import SimpleNamespace
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


def noisy(side: int = 20) -> NerfTree:
    rng = np.random.default_rng(0)
    at = np.argwhere(np.ones((side,) * 3, bool))
    density = np.where(np.linalg.norm(at - side / 2 + 0.5, axis=1) < side / 4, rng.uniform(1, 30, len(at)), 0.2)
    sh = rng.normal(size=(len(at), 4, 3)).astype(np.float32)
    return tree_from_voxels((side // 4,) * 3, 2 / side, BOUNDS[0], at, density, sh, background=(1.0, 1.0, 1.0))


def packed(tree: NerfTree, size: int) -> tuple[NerfTree, list[str], list[str]]:
    """The packed tree, what was said and what was warned of."""
    said: list[str] = []
    warned: list[str] = []
    settings = BakeSettings(visibility_rays=1000, seed=0, refine_rays_per_batch=256)
    job: Any = SimpleNamespace(device="cpu", settings=settings, say=said.append, warn=warned.append, safe_point=lambda: None)
    found, psnr = economy.packed_tree(job, tree, Targets(pixels(), (1.0, 1.0, 1.0)), size)
    assert f"{psnr:.2f} dB" in said.pop()
    return found, said, warned


@pytest.fixture(scope="module")
def tree() -> NerfTree:
    return noisy()


@pytest.mark.parametrize("share", [0.7])
def test_codes_are_coarser_where_the_file_would_be_too_large(tree: NerfTree, share: float) -> None:
    most = len(serialize(economy_of(tree).at(DEFAULT_RATE), "packed"))
    found, _, warned = packed(tree, int(share * most))
    assert 0.85 * share * most < len(serialize(found, "packed")) <= share * most
    assert not warned
    again, _, _ = packed(tree, int(share * most))
    assert serialize(again, "packed") == serialize(found, "packed")


def test_voxels_that_weigh_least_go_where_the_coarsest_codes_are_too_large(tree: NerfTree, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(economy, "COARSEST", 10 * DEFAULT_RATE)
    coarsest = len(serialize(economy_of(tree).at(10 * DEFAULT_RATE), "packed"))
    found, _, _ = packed(tree, coarsest // 2)
    assert len(serialize(found, "packed")) <= coarsest // 2
    assert len(found.density_values) < len(tree.density_values)
    assert found.density_values.max() > 1


def test_a_stopped_packing_stops_at_each_step(tree: NerfTree) -> None:
    """Signals are answered before codes are chosen and after each step that tables are fitted in."""
    calls = 0

    def count() -> None:
        nonlocal calls
        calls += 1

    settings = BakeSettings(visibility_rays=1000, seed=0, refine_rays_per_batch=256)
    job: Any = SimpleNamespace(device="cpu", settings=settings, say=lambda _: None, warn=lambda _: None, safe_point=count)
    economy.packed_tree(job, tree, Targets(pixels(), (1.0, 1.0, 1.0)), 10**7)
    assert calls > REFIT_STEPS / economy.REFIT_ROUNDS
