"""Loss of rays through a tree and its gradients by the tree's values, on every backend, against the loops of `tests/reference.py` and their differences."""

from collections.abc import Callable
from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pytest

from efficientnerf.asset.tree import NerfTree
from efficientnerf.backends.layout import RayTargets
from tests import reference
from tests.efficientnerf.refinements import device_gradients, gradients, gradients_by_autograd, seen_at_random
from tests.efficientnerf.trees import random_tree, rays_at

DEVICE = "cpu"
if find_spec("triton"):
    from tests.efficientnerf.device import DEVICE

RAYS = 16
STEP = 1e-5


def by_triton(tree: NerfTree, origins: np.ndarray, directions: np.ndarray, targets: RayTargets) -> tuple[np.ndarray, ...]:
    pytest.importorskip("triton", reason="Triton is not installed: pip install triton (Linux, x86-64)")
    return device_gradients(tree, origins, directions, targets, DEVICE)


BACKENDS: dict[str, Callable[..., tuple[np.ndarray, ...]]] = {"torch": gradients_by_autograd, "numba": gradients, "triton": by_triton}


def losses(tree: NerfTree, origins: np.ndarray, directions: np.ndarray, targets: RayTargets) -> np.ndarray:
    """(R,) by `RayTargets`' formula."""
    out = []
    for r, (origin, direction) in enumerate(zip(origins, directions, strict=True)):
        colour, opacity, _ = reference.tree_ray(tree, origin, direction)
        composited = np.array(colour) + (1 - opacity) * targets.background[r]
        error = targets.transmittance[r] * composited - targets.colour[r]
        out.append(error @ error + targets.opacity_weight * (opacity - targets.opacity[r]) ** 2)
    return np.array(out)


@pytest.mark.parametrize(("backend", "lookup", "step_size"), [(each, *how) for each in BACKENDS for how in [("trilinear", 0.5), ("nearest", 0.8)]])
def test_gradients_are_differences_of_the_loops(backend: str, lookup: str, step_size: float) -> None:
    tree = random_tree(1, shape=(2, 2, 2), brick=2, degree=1, share=0.8, sigma=4.0, lookup=lookup, step_size=step_size)
    tree = replace(tree, density_values=tree.density_values + np.float32(0.1))  # at 0 the slope has two sides
    origins, directions = (a[np.arange(RAYS) % 4 != 2] for a in rays_at(tree, RAYS))  # none along the faces of voxels
    targets = seen_at_random(len(origins), 0.4)
    loss, *found = BACKENDS[backend](tree, origins, directions, targets)
    np.testing.assert_allclose(loss, losses(tree, origins, directions, targets), atol=2e-5)
    rng = np.random.default_rng(0)
    values = [tree.density_values.astype(np.float64), tree.sh.astype(np.float64)]
    size = sum(float((part**2).sum()) for part in found) ** 0.5
    for _ in range(4):
        along = [rng.normal(size=part.shape) for part in values]
        ends = []
        for sign in (1, -1):
            density, sh = (part + sign * STEP * direction for part, direction in zip(values, along, strict=True))
            ends.append(losses(replace(tree, density_values=density, harmonics=sh), origins, directions, targets).sum())
        slope = sum(float((part * direction).sum()) for part, direction in zip(found, along, strict=True))
        assert slope == pytest.approx((ends[0] - ends[1]) / (2 * STEP), rel=1e-3, abs=1e-3 * size)
    assert size > 0.1
