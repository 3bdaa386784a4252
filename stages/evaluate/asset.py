"""A baked asset as the evaluate stage measures it: what it shows by itself, and where its density lies."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from efficientnerf.asset.cascades import cascade_tree, cascades_of
from efficientnerf.asset.rendering import render
from efficientnerf.asset.tree import NerfTree
from efficientnerf.evaluation.surfaces import opacity_nearer, surface_limits
from stages.evaluate.views import upsample
from stages.io.scene import View

RenderTree = Callable[..., Any]  # (camera, background=..., normals=...) -> Rendering
OnRays = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]  # origins (R, 3), directions (R, 3), distances (R,) -> (R,)


@dataclass(frozen=True, eq=False)
class EvaluatedAsset:
    """An asset to be measured."""

    render: RenderTree  # all of it, as `efficientnerf.asset.rendering.render`
    # limits, nearer: `surface_limits` and `opacity_nearer` of `efficientnerf.evaluation.surfaces`
    limits: OnRays
    nearer: OnRays
    inner: RenderTree | None = None  # of an unbounded scene: cascade 0 alone; None: the scene is bounded, or forward-facing
    box: np.ndarray | None = None  # (2, 3) of cascade 0; None: that of the field's space
    reach: np.ndarray | None = None  # (2, 3) of all cascades; None: the same


def evaluated(tree: NerfTree) -> EvaluatedAsset:
    """The asset of a tree, on the tree's device."""
    whole, limits, nearer = partial(render, tree), partial(surface_limits, tree), partial(opacity_nearer, tree)
    if not tree.outer and tree.environment is None:
        return EvaluatedAsset(whole, limits, nearer)
    bounds = [cascade.bounds(tree.brick) for cascade in cascades_of(tree)]
    return EvaluatedAsset(whole, limits, nearer, inner=partial(render, cascade_tree(tree, 0)), box=bounds[0], reach=bounds[-1])


def over_field(render_tree: RenderTree, view: View, seen: Any, stride: int) -> np.ndarray:
    """(H, W, 3): the tree rendered in the field's box, between the field's rendering before and behind it.

    before + (1 - before's alpha) (asset + (1 - asset's alpha) behind)

    seen  the field's rendering on every stride-th pixel
    """
    output = render_tree(view.camera, normals=False)
    size = (stride, view.camera.width, view.camera.height)
    before, behind = upsample(seen.before, *size), upsample(seen.behind, *size)
    middle = output.colour + (1.0 - output.opacity[..., None]) * behind
    return np.asarray(before[..., :3] + (1.0 - before[..., 3:]) * middle)
