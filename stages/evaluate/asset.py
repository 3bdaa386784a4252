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
from efficientnerf.model import UNSEEN
from stages.evaluate.views import constant_background, upsample
from stages.io.scene import Scene, View

RenderTree = Callable[..., Any]  # (camera, background=..., normals=...) -> Rendering
OnRays = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]  # origins (R, 3), directions (R, 3), distances (R,) -> (R,)


@dataclass(frozen=True, eq=False)
class EvaluatedAsset:
    """An asset to be measured.

    render   all of it, as `efficientnerf.asset.rendering.render`
    inner    cascade 0 alone, where that lies in surroundings that the asset shows too; None: the asset shows what lies in its box, and no more
    box      (2, 3) of cascade 0; None: that of the field's space
    reach    (2, 3) of all cascades; None: the same
    limits, nearer  `surface_limits` and `opacity_nearer` of `efficientnerf.evaluation.surfaces`
    behind   what to draw it on where nothing else says so, sRGB; None: it has an environment map
    """

    render: RenderTree
    limits: OnRays
    nearer: OnRays
    inner: RenderTree | None = None
    box: np.ndarray | None = None
    reach: np.ndarray | None = None
    behind: tuple[float, float, float] | None = None


def evaluated(tree: NerfTree) -> EvaluatedAsset:
    """The asset of a tree, on the tree's device."""
    whole, limits, nearer = partial(render, tree), partial(surface_limits, tree), partial(opacity_nearer, tree)
    behind = None if tree.environment is not None else tree.background or (UNSEEN, UNSEEN, UNSEEN)
    if not tree.outer and tree.environment is None:
        return EvaluatedAsset(whole, limits, nearer, behind=behind)
    bounds = [cascade.bounds(tree.brick) for cascade in cascades_of(tree)]
    return EvaluatedAsset(whole, limits, nearer, inner=partial(render, cascade_tree(tree, 0)), box=bounds[0], reach=bounds[-1], behind=behind)


def is_over_field(asset: EvaluatedAsset, scene: Scene) -> bool:
    """Whether the field shows what surrounds the asset: in an unbounded scene of which it has its box alone."""
    return constant_background(scene) is None and asset.inner is None


def render_asset(asset: EvaluatedAsset, scene: Scene, view: View, seen: Any, stride: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The asset's image of a view (H, W, 3), and the opacity and the depth of its voxels (H, W).

    seen    the field's rendering on every stride-th pixel: the surroundings of an asset that shows none in an unbounded scene; else it is not used
    """
    if is_over_field(asset, scene):
        return over_field(asset.render, view, seen, stride)
    output = asset.render(view.camera, background=constant_background(scene) or asset.behind, normals=False)
    return output.colour, output.opacity, output.depth


def over_field(render_tree: RenderTree, view: View, seen: Any, stride: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The tree rendered in the field's box, between the field's rendering before and behind it: (H, W, 3), and the tree's opacity and depth (H, W).

    before + (1 - before's alpha) (asset + (1 - asset's alpha) behind)
    """
    output = render_tree(view.camera, normals=False)
    size = (stride, view.camera.width, view.camera.height)
    before, behind = upsample(seen.before, *size), upsample(seen.behind, *size)
    middle = output.colour + (1.0 - output.opacity[..., None]) * behind
    return before[..., :3] + (1.0 - before[..., 3:]) * middle, output.opacity, output.depth
