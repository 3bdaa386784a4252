"""metrics.json: means over the views, and what they say in words.

network, asset  means over their views of PSNR (in decibels, as published), SSIM and the rest; `scale`: of the pixel grid
asset.on_network_views         those of the views that the network was rendered for
asset_with_network_background  cascade 0 of an unbounded scene's asset between what the field shows before and behind its box; null in other scenes
mesh            means over the views of what `stages.evaluate.mesh` measures, and how many faces and texels the mesh has
splats          the same of the 3D Gaussians (`stages.evaluate.splats`); null where there are none
gap, holes, floaters and the excess error of both  means over the views that the network was rendered for (`stages.evaluate.comparison`)
train           the asset on some views that training saw (`stages.evaluate.judging`); null where that was not measured
trivial         means of what pictures of one colour and blurred photographs would score on the views (`stages.evaluate.trivial`)
sparse_points   how the asset's depth agrees with the sparse points (`stages.evaluate.sparse_points`); null where there are too few
refinement      of the asset: its steps, and how many are usual; null where that is not known
strips          the views that have picture strips, with their figures
views           the metrics of each view
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from stages.evaluate.comparison import AGAINST_NETWORK, GAP, QUALITY, SAMPLE_SHARES
from stages.evaluate.mesh import FIGURES
from stages.evaluate.sparse_points import agreement
from stages.evaluate.splats import FIGURES as SPLATS_FIGURES
from stages.evaluate.trivial import BLURS

FORMAT = 1


def summary(
    figures: Sequence[dict[str, Any]], *, split: str, stride: int, mesh: Mapping[str, Any], perceptual: Sequence[str] = (),
    strips: Sequence[dict[str, Any]] = (), splats: Mapping[str, Any] | None = None,
    refinement: Mapping[str, int] | None = None, train: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """The document of metrics.json.

    figures     the metrics of each view
    stride      of the network's renders
    mesh        facts about the mesh
    splats      facts about the Gaussians, if there are any
    perceptual  names of LPIPS metrics
    refinement  the asset's, see `stages.evaluate.judging`
    train       figures of the asset on views that training saw
    """
    drawn = [view for view in figures if view["network"] is not None]
    networks, assets = [view["network"] for view in drawn], [view["asset"] for view in figures]
    network: dict[str, Any] = {**means(networks), **means(networks, (*perceptual, *SAMPLE_SHARES, "floaters")), "views": len(drawn), "scale": 1.0 / stride}
    asset: dict[str, Any] = {**means(assets), **means(assets, perceptual), "views": len(assets), "scale": 1.0}
    asset["on_network_views"] = means([view["asset"] for view in drawn])
    plain = [view["trivial"] for view in figures if view["trivial"] is not None]
    columns = zip(BLURS, *(view["blurred"] for view in plain), strict=True)
    blurred = [math.fsum(column) / len(plain) for _, *column in columns] if plain else []
    composited = [view["asset_with_network_background"] for view in drawn if view["asset_with_network_background"] is not None]
    return {
        "format": FORMAT,
        "split": split,
        "network": network,
        "asset": asset,
        "mesh": {**means([view["mesh"] for view in figures], FIGURES), **mesh, "views": len(figures), "scale": 1.0},
        "splats": None if splats is None else {**means([view["splats"] for view in figures], SPLATS_FIGURES), **splats, "views": len(figures), "scale": 1.0},
        "asset_with_network_background": {**means(composited), "views": len(composited), "background_scale": 1.0 / stride} if composited else None,
        "gap": {**means([view["gap"] for view in drawn], GAP), "views": len(drawn), "scale": 1.0 / stride},
        **means(drawn, AGAINST_NETWORK),
        "train": train,
        "trivial": {"mean_colour": means(plain, ("mean_colour",))["mean_colour"], "blurs": list(BLURS), "blurred": blurred},
        "sparse_points": agreement([view["sparse_points"] for view in figures]),
        "refinement": refinement,
        "strips": list(strips),
        "views": list(figures),
    }


def means(figures: Sequence[Mapping[str, Any]], names: Sequence[str] = QUALITY) -> dict[str, float | None]:
    """Means by name over those that have the figure; None where none has."""
    found: dict[str, float | None] = {}
    for name in names:
        values = [view[name] for view in figures if view[name] is not None]
        found[name] = math.fsum(values) / len(values) if values else None
    return found


def quality(found: Mapping[str, Any]) -> str:
    """`28.87 dB, SSIM 0.894`."""
    psnr = "no PSNR" if found["psnr"] is None else f"{found['psnr']:.2f} dB"
    return psnr if found["ssim"] is None else f"{psnr}, SSIM {found['ssim']:.3f}"


def in_words(metrics: Mapping[str, Any]) -> str:
    """The means in one line."""
    parts = [f"{name} {quality(metrics[name])}" for name in ("network", "asset", "mesh", "splats") if metrics[name] is not None]
    if metrics["gap"]["psnr"] is not None:
        parts.append(f"gap {metrics['gap']['psnr']:+.2f} dB")
    for name in ("holes", "floaters"):
        if metrics[name] is not None:
            parts.append(f"{name} {100 * metrics[name]:.2f} %")
    return "; ".join(parts)
