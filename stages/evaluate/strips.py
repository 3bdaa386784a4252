"""Picture strips "photograph | network | asset | mesh" at full size, of the worst, the median and the best view by the asset's PSNR.

The network renders every pixel of these views, or every n-th along both sides of views of more than STRIP_RAYS pixels; the others are shown at the same
pixels. The figures of a strip are those of what it shows.
"""

import shutil
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from efficientnerf.rendering.field_renderer import FieldRenderer
from stages.evaluate.comparison import Evaluation
from stages.evaluate.mesh import mesh_image
from stages.evaluate.summary import quality
from stages.evaluate.views import stride_for, subsample, subsample_camera
from stages.figures.plots import contact_sheet
from stages.io.png import read_png
from stages.io.scene import View
from stages.scratch import Warn, note, noted

STRIP_RAYS = 2**20  # through the field, for one strip


def strip_views(figures: Sequence[Mapping[str, Any]]) -> list[tuple[str, int]]:
    """Worst, median and best by the asset's PSNR, each with the index of its view; fewer where there are not three views with a PSNR."""
    ranked = sorted((k for k, view in enumerate(figures) if view["asset"]["psnr"] is not None), key=lambda k: (figures[k]["asset"]["psnr"], k))
    if len(ranked) < 2:
        return [("median", k) for k in ranked]
    found = [("worst", ranked[0]), ("median", ranked[len(ranked) // 2]), ("best", ranked[-1])]
    return found if len(ranked) > 2 else [found[0], found[2]]


def write_strips(
    e: Evaluation, load_field: Callable[[], FieldRenderer], views: Sequence[View], chosen: Sequence[tuple[str, int]], warn: Warn
) -> list[dict[str, Any]]:
    """Write the strips of the chosen views; returns their entries of metrics.json. A strip is kept in job.work, so that a kill costs at most one."""
    entries: list[dict[str, Any]] = []
    job = e.job
    for which, k in chosen:
        job.safe_point()
        job.progress(len(entries), len(chosen), f"strip of {views[k].name}")
        done, picture = job.work / f"strip_{k:05d}.json", job.work / f"strip_{k:05d}.png"
        entry = noted(done, dict[str, Any], warn, partial(_check, picture, views[k]))
        if entry is None:
            entry = _write_strip(e, load_field(), views[k], picture)
            note(done, entry, [picture])
        path = job.out / f"strip_{which}.png"
        shutil.copyfile(picture, path)
        entries.append({"which": which, "file": path.name, **entry})
    job.progress(len(chosen), len(chosen))
    return entries


def _write_strip(e: Evaluation, field: FieldRenderer, view: View, path: Path) -> dict[str, Any]:
    stride = stride_for([view], STRIP_RAYS)
    truth, seen = e.truth(view).subsampled(stride), field.colour(subsample_camera(view.camera, stride), lambda *_: e.job.safe_point())
    renders = {
        "network": e.shown(view, seen, "the field", stride),
        "asset": subsample(e.shown(view, e.rendering(view).colour, "the asset"), stride),
        "mesh": subsample(e.shown(view, mesh_image(e.mesh, view.camera, e.background)[0], "the mesh"), stride),
    }
    found = {name: {"psnr": truth.psnr(picture), "ssim": truth.ssim(picture)} for name, picture in renders.items()}
    labels = [f"photograph {view.name}", *(f"{name} {quality(found[name])}" for name in renders)]
    height, width = truth.colour.shape[:2]
    contact_sheet([[truth.colour, *renders.values()]], [labels], path, thumbnail=max(height, width))
    return {"view": view.name, **found, "width": width, "height": height}


def _check(picture: Path, view: View, entry: Mapping[str, Any], outputs: Collection[str]) -> None:
    """Raises where this is no strip of the view, or its picture is missing or can't be read."""
    if entry["view"] != view.name or picture.name not in outputs or min(entry["width"], entry["height"]) < 1:
        raise ValueError("no strip of this view")
    for name in ("network", "asset", "mesh"):
        quality(entry[name])
    read_png(picture)
