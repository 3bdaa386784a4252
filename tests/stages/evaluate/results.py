"""Figures of results that were never made: metrics.json with one thing or another wrong."""

import copy
from collections.abc import Callable
from typing import Any

from stages.evaluate.trivial import BLURS

# Of the still life's photographs, as measured: a picture of the mean colour, and blurs of the photographs.
MEAN_COLOUR, BLURRED = 16.2, [32.0, 28.8, 25.7, 23.7, 22.0, 20.4]


def a_result(
    psnr: float = 29.4, *, fitted: float | None = None, mean_colour: float = MEAN_COLOUR, blurred: list[float] | None = None, detail: float | None = None
) -> dict[str, Any]:
    """metrics.json of a result of which nothing is bad but for what is given; its detail is as good as it is, unless that is given."""
    blurred, fitted = blurred or BLURRED, psnr if fitted is None else fitted
    quality = {"psnr": psnr, "ssim": 0.9, "psnr_colour_fitted": fitted}
    views = [
        {"name": f"v{k}.jpg", "asset": {**quality, "psnr_detail": fitted if detail is None else detail}, "network": dict(quality),
         "mesh": {"psnr": psnr - 1, "roughness": 0.05}, "splats": {"psnr": psnr},
         "trivial": {"mean_colour": mean_colour, "blurred": list(blurred), "blurred_detail": list(blurred)}} for k in range(5)
    ]  # fmt: skip
    return {
        "split": "test",
        "asset": dict(quality),
        "network": {**quality, "floaters": 0.01},
        "mesh": {"psnr": psnr - 1, "faces": 1000},
        "splats": {"psnr": psnr},
        "gap": {"psnr": 0.0},
        "holes": 0.0, "floaters": 0.01, "holes_excess_error": 0.0, "floaters_excess_error": 0.0,
        "train": {"psnr": psnr + 1, "blur": BLURS[1]},
        "sparse_points": {"points": 900, "agreeing": 0.9, "nearer": 0.05, "farther": 0.05, "subject_farther": 0.02},
        "refinement": {"steps": 800, "usual_steps": 827},
        "strips": [{"which": "worst", "file": "strip_worst.png"}],
        "views": views,
    }  # fmt: skip


def _views(part: str, change: float) -> Callable[[dict[str, Any]], None]:
    def worse(found: dict[str, Any]) -> None:
        for each in (found, *found["views"]):
            for name in ("psnr", "psnr_colour_fitted", "psnr_detail"):
                if name in each[part]:
                    each[part][name] -= change

    return worse


def _put(found: dict[str, Any], path: str, value: float) -> None:
    *parts, last = path.split(".")
    for part in parts:
        found = found[part]
    found[last] = value


def _shares(found: dict[str, Any], name: str, step: float) -> None:
    points = found["sparse_points"]
    points[name] = min(1.0, points[name] + step)
    points["agreeing"] = max(0.0, points["agreeing"] - step)


# What can become worse, each by a step; every step gives a figure that is no better than before.
WORSE: dict[str, Callable[[dict[str, Any]], None]] = {
    "asset": _views("asset", 1.3),
    "mesh": _views("mesh", 2.0),
    "splats": _views("splats", 2.0),
    "one view": lambda found: _put(found["views"][2], "asset.psnr_colour_fitted", found["views"][2]["asset"]["psnr_colour_fitted"] - 3.0),
    "colours": lambda found: [_put(view, "asset.psnr", view["asset"]["psnr"] - 2.0) for view in (found, *found["views"])] and None,
    "gap": lambda found: _put(found, "gap.psnr", found["gap"]["psnr"] - 0.7),
    "holes": lambda found: _put(found, "holes", min(1.0, found["holes"] + 0.03)),
    "holes' error": lambda found: _put(found, "holes_excess_error", found["holes_excess_error"] + 0.001),
    "floaters": lambda found: _put(found, "floaters", min(1.0, found["floaters"] + 0.04)),
    "floaters' error": lambda found: _put(found, "floaters_excess_error", found["floaters_excess_error"] + 0.001),
    "points nearer": lambda found: _shares(found, "nearer", 0.1),
    "points farther": lambda found: _shares(found, "farther", 0.1),
    "subject": lambda found: _put(found, "sparse_points.subject_farther", min(1.0, found["sparse_points"]["subject_farther"] + 0.2)),
    "rough mesh": lambda found: [_put(view, "mesh.roughness", min(1.0, view["mesh"]["roughness"] + 0.06)) for view in found["views"]] and None,
    "mesh gone": lambda found: _put(found, "mesh.faces", 0),
    "nothing held out": lambda found: found.update(split="train"),
}


def worse(found: dict[str, Any], *names: str) -> dict[str, Any]:
    """A copy that is worse in each of these."""
    made = copy.deepcopy(found)
    for name in names:
        WORSE[name](made)
    return made
