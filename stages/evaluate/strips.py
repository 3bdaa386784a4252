"""Picture strips "photograph | network | asset | mesh" at full size, of the worst, the median and the best view by the asset's PSNR.

The network renders every pixel of these views, or every n-th along both sides of views of more than STRIP_RAYS pixels; the others are shown at the same
pixels. The figures of a strip are those of what it shows.
"""

import shutil
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from efficientnerf.rendering.field_renderer import FieldRenderer
from pipeline.stage import Job
from stages.artifacts import EvaluateOutputs, PosesOutputs
from stages.evaluate.asset import EvaluatedAsset, is_over_field, render_asset
from stages.evaluate.comparison import as_shown
from stages.evaluate.mesh import EvaluatedMesh, mesh_image
from stages.evaluate.summary import quality
from stages.evaluate.views import ground_truth, stride_for, subsample, subsample_camera
from stages.figures.plots import contact_sheet
from stages.io.png import read_png
from stages.io.scene import Scene, View
from stages.scratch import Warn, note, noted
from stages.train.averaged import Taken

STRIP_RAYS = 2**20  # through the field, for one strip
FIGURES = ("psnr", "ssim")


def strip_views(figures: Sequence[Mapping[str, Any]]) -> list[tuple[str, int]]:
    """Worst, median and best by the asset's PSNR, each with the index of its view; fewer where there are not three views with a PSNR."""
    ranked = sorted((k for k, view in enumerate(figures) if view["asset"]["psnr"] is not None), key=lambda k: (figures[k]["asset"]["psnr"], k))
    if len(ranked) < 2:
        return [("median", k) for k in ranked]
    found = [("worst", ranked[0]), ("median", ranked[len(ranked) // 2]), ("best", ranked[-1])]
    return found if len(ranked) > 2 else [found[0], found[2]]


def write_strips(
    asset: EvaluatedAsset, mesh: EvaluatedMesh, load_field: Callable[[], FieldRenderer], scene: Scene, views: Sequence[View], chosen: Sequence[tuple[str, int]],
    job: Job, warn: Warn, taken: Taken | None = None,
) -> list[dict[str, Any]]:
    """Write the strips of the chosen views; returns their entries of metrics.json. A strip is kept in job.work, so that a kill costs at most one."""
    entries: list[dict[str, Any]] = []
    started, rays = time.monotonic(), 0
    for which, k in chosen:
        job.safe_point()
        job.progress(len(entries), len(chosen), f"strip of {views[k].name}")
        done, picture = job.work / f"strip_{k:05d}.json", job.work / f"strip_{k:05d}.png"
        entry = noted(done, dict[str, Any], warn, partial(_check, picture, views[k]))
        if entry is None:
            stride = stride_for([views[k]], STRIP_RAYS)
            entry = _write_strip(asset, mesh, load_field(), scene, views[k], stride, picture, job, taken)
            rays += entry["width"] * entry["height"]
            note(done, entry, [picture])
        path = EvaluateOutputs(job.out).strip(which)
        shutil.copyfile(picture, path)
        entries.append({"which": which, "file": path.name, **entry})
    job.progress(len(chosen), len(chosen))
    if rays:
        job.say(f"strips: the network at {rays} pixels in {time.monotonic() - started:.0f} s (skip with evaluate.strips=off)")
    return entries


def _write_strip(
    asset: EvaluatedAsset, mesh: EvaluatedMesh, field: FieldRenderer, scene: Scene, view: View, stride: int, path: Path, job: Job, taken: Taken | None
) -> dict[str, Any]:
    truth = ground_truth(job.inputs[PosesOutputs.stage], view, scene.background)
    small, shown = subsample_camera(view.camera, stride), partial(as_shown, job, view, taken)
    truth, seen, tick = truth.subsampled(stride), None, lambda *_: job.safe_point()
    if is_over_field(asset, scene):
        seen = field.render(small, progress=tick, box=asset.box, reach=asset.reach)
    network = shown(field.colour(small, tick) if seen is None else seen.colour, "the field", stride)
    image = subsample(shown(render_asset(asset, scene, view, seen, stride)[0], "the asset"), stride)
    drawn = subsample(shown(mesh_image(mesh, asset, scene, view, seen, stride)[0], "the mesh"), stride)
    renders = {"network": network, "asset": image, "mesh": drawn}
    found = {name: {"psnr": truth.psnr(picture), "ssim": truth.ssim(picture)} for name, picture in renders.items()}
    pictures: list[np.ndarray | None] = [truth.colour, *renders.values()]
    labels = [f"photograph {view.name}", *(f"{name} {quality(found[name])}" for name in renders)]
    contact_sheet([pictures], [labels], path, thumbnail=max(image.shape[:2]))
    return {"view": view.name, **found, "width": image.shape[1], "height": image.shape[0]}


def _check(picture: Path, view: View, entry: Mapping[str, Any], outputs: Collection[str]) -> None:
    """Raises where this is no strip of the view, or its picture is missing or can't be read."""
    names = ("network", "asset", "mesh")
    if entry["view"] != view.name or not all({*FIGURES} <= entry[name].keys() for name in names) or min(entry["width"], entry["height"]) < 1:
        raise ValueError("no strip of this view")
    if picture.name not in outputs or read_png(picture).shape[2] != 3:
        raise ValueError(f"{picture.name} is missing")
