"""Tables and palettes fitted to images, codes as they are."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from efficientnerf.asset.format import serialize
from efficientnerf.asset.palettes import PaletteHarmonics
from efficientnerf.asset.quantisation import compacted
from efficientnerf.asset.refinement import fit
from efficientnerf.asset.refinement.fit import error
from efficientnerf.asset.refinement.quantised import _rising, refit
from efficientnerf.asset.refinement.targets import Targets
from efficientnerf.asset.tree import NerfTree
from tests.efficientnerf.balls import pixels
from tests.efficientnerf.refinements import ball_tree


def coded(shift: float = 0.0) -> NerfTree:
    """A ball in few codes, its palette and bases off by `shift`."""
    tree = compacted(ball_tree(), 8)
    held = tree.harmonics
    assert isinstance(held, PaletteHarmonics)
    return replace(tree, harmonics=replace(held, base_table=held.base_table + np.float32(shift)))


def targets() -> Targets:
    return Targets(pixels(), (1.0, 1.0, 1.0))


def test_tables_that_are_off_are_put_right_and_codes_stay() -> None:
    tree, seen = coded(0.8), targets()
    found = refit(tree, seen, 12, rounds=3, rays=1024, sh_lr=0.1)
    before, after = tree.harmonics, found.harmonics
    assert isinstance(before, PaletteHarmonics)
    assert isinstance(after, PaletteHarmonics)
    assert np.array_equal(before.base, after.base)
    assert np.array_equal(before.codes, after.codes)
    ranks = [np.unique(one.density_values, return_inverse=True)[1] for one in (tree, found)]
    assert np.array_equal(*ranks)
    assert len(serialize(found, "packed")) == len(serialize(tree, "packed"))
    assert np.array_equal(after.palette, after.palette.astype(np.float16).astype(np.float32))
    assert error(found, seen, 4096, 1) < 0.8 * error(tree, seen, 4096, 1)


def test_the_same_is_found_every_time_and_no_step_changes_nothing() -> None:
    tree, seen = coded(0.4), targets()
    first, second = (refit(tree, seen, 4, rays=512) for _ in range(2))
    assert np.array_equal(first.density_values, second.density_values)
    assert np.array_equal(first.sh, second.sh)
    assert refit(tree, seen, 0) is tree


def test_a_worse_tree_is_never_made(monkeypatch: pytest.MonkeyPatch) -> None:
    """Steps that lead astray are not taken over."""
    def astray(state: Any, *_: Any, until: int, **__: Any) -> Any:
        state.tree.sh[:] += np.array([40, -40, 40], np.float32)
        state.square_sh[:] = 1
        state.step = until
        yield 0.0

    monkeypatch.setattr(fit, "optimise", astray)
    tree = coded()
    assert refit(tree, targets(), 4) is tree


def test_densities_that_would_meet_or_pass_each_other_keep_their_order() -> None:
    found = _rising(np.array([0, 3, 3, 1, 5], np.float32))
    assert (np.diff(found) > 0).all()
    np.testing.assert_allclose(found, [0, 3, 3, 3, 5], rtol=1e-6)
    assert np.array_equal(_rising(found), found)
