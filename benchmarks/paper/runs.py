"""The runs behind a table: settings from the preset `paper-n4`, shrunk by a scale, trained through the engine, and measured.

A row's run is an ordinary run folder, OUT/runs/<scene>/<row>: it resumes after an interruption, and `enerf status` and the rest work on it.
"""

import json
import math
import statistics
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.paper.result import Request
from efficientnerf.asset import format
from efficientnerf.asset.rendering import render
from efficientnerf.asset.tree import NerfTree
from efficientnerf.backends import dispatch
from efficientnerf.evaluation.metrics import psnr, ssim
from efficientnerf.geometry.cameras import Camera
from efficientnerf.rendering.field_renderer import SampleCounts
from pipeline.errors import BadInput
from pipeline.run import NAME, Run
from pipeline.runner import run_stages
from stages.artifacts import BakeOutputs, TrainOutputs
from stages.cores import use_all_cores
from stages.evaluate.views import evaluation_views, evenly_spaced, ground_truth
from stages.io import scene
from stages.io.field_file import load_renderer
from workflows import asset
from workflows.cli.resolve import Settings, read_preset, table_of

PRESET = "paper-n4"
CONVERGED_PSNR = 22.0  # less is not converged: such a row says nothing about the method
SCENES_OF = {"transforms_train.json", "transforms.json", "poses_bounds.npy"}


@dataclass(frozen=True)
class Row:
    """One training to be measured."""

    name: str  # of its run folder
    changes: Mapping[str, Any] = field(default_factory=dict)  # to the train settings of PRESET, as they are in the paper; `scaled` shrinks them like the rest
    bakes: bool = False  # whether its tree is baked and measured too


@dataclass(frozen=True)
class Figures:
    """Results of a row's run; seconds are of training steps alone, evaluation excluded, as in the paper."""

    psnr: float  # of the network, mean over the test views that were rendered, decibels; ssim likewise
    ssim: float | None
    step: float  # seconds of a step, mean over the run
    steady: float  # seconds of a step, median over the last fifth of the run
    hours: float  # of all steps
    # coarse, fine: samples of a training ray that went through the coarse and the fine network, over the last fifth
    coarse: float
    fine: float
    # valid, pivotal: shares over rays x N_c of the test views (equations 5 and 12)
    valid: float
    pivotal: float
    curve: tuple[list[float], list[float]]  # (seconds of training, PSNR of a validation view)
    tree: Mapping[str, Any] | None = None  # figures of the baked tree, where baked: psnr, ssim, frames a second, size of a frame

    @property
    def converged(self) -> bool:
        """Whether it has converged."""
        return self.psnr >= CONVERGED_PSNR


def scenes(data: Path) -> list[Path]:
    """The data sets of a folder: itself, or those in it."""
    if any((data / name).exists() for name in SCENES_OF):
        return [data]
    found = sorted(folder for folder in data.iterdir() if folder.is_dir() and any((folder / name).exists() for name in SCENES_OF))
    if not found:
        raise BadInput(f"{data}: holds no data set (no {', '.join(sorted(SCENES_OF))}, nor folders that do). Give the folder of a scene, or of scenes.")
    return found


def scaled(stages: dict[str, dict[str, Any]], scale: float) -> dict[str, dict[str, Any]]:
    """Settings shrunk together: iterations by `scale`, and by powers of it: image sides 0.3, density voxels 0.225, batches 0.2, widths 0.15, depths 0.05.

    Samples on a ray stay, so that ratios between rows keep their meaning. The learning rate rises by the third root and falls less over the run, for
    small networks and few steps. The warm-up becomes a larger fraction of the steps, because pruning must wait until the coarse network has converged,
    and pruned samples are evaluated on more rays, which recovers density that was pruned by mistake.
    """
    if scale == 1:
        return stages
    out = {name: dict(entries) for name, entries in stages.items()}
    train, fifth = out["train"], scale**0.2

    def width(units: int) -> int:
        return max(16, 16 * round(units * scale**0.15 / 16))

    train["iterations"] = max(60, round(train["iterations"] * scale))
    train["max_rays_per_batch"] = max(64, 32 * round(train["max_rays_per_batch"] * fifth / 32))
    for name in ("hidden_dim", "coarse_hidden_dim"):
        train[name] = width(train[name])
    for name in ("num_layers", "coarse_num_layers"):
        train[name] = max(2, round(train[name] * scale**0.05))
    train["occupancy_resolution"] = max(32, 8 * round(train["occupancy_resolution"] * scale**0.225 / 8))  # docs/experiments/occupancy.md
    train["learning_rate"] = train["learning_rate"] / scale ** (1 / 3)
    train["lr_decay_steps"] = max(1, round(train["lr_decay_steps"] * scale**0.9))
    train["occupancy_warmup_steps"] = round(train["iterations"] * min(0.35, train["occupancy_warmup_steps"] / 1e6 * scale**-0.6))
    train["occupancy_update_ray_fraction"] = min(max(0.05, train["occupancy_update_ray_fraction"]), train["occupancy_update_ray_fraction"] * scale**-0.3)
    train["precrop_steps"] = min(train["precrop_steps"], train["iterations"] // 10)
    train["checkpoint_every"] = max(50, train["iterations"] // 4)
    train["preview_every"] = max(10, train["iterations"] // 8)
    out["poses"]["max_image_size"] = max(48, 4 * round(800 * scale**0.3 / 4))
    out["bake"]["resolution"] = max(96, 8 * round(out["bake"]["resolution"] * scale**0.3 / 8))
    out["bake"]["samples_per_voxel"] = max(4, round(out["bake"]["samples_per_voxel"] * fifth))
    out["bake"]["visibility_rays"] = max(50_000, round(1e6 * fifth))
    out["bake"]["refine_rays_per_batch"] = max(4096, 1024 * round(out["bake"]["refine_rays_per_batch"] * fifth / 1024))
    out["evaluate"] |= {"field_views": 10 if scale < 0.1 else "all", "field_image_scale": 1.0}
    return out


def settings_of(row: Row, scale: float) -> dict[str, dict[str, Any]]:
    """Settings of all stages for a row."""
    settings = Settings({stage.name: stage.settings for stage in asset.STAGES})
    settings.put_table(read_preset(PRESET).table, PRESET)
    settings.put_table({"train": row.changes}, row.name)
    settings.put_table(scaled(table_of(settings.resolved()), scale), f"--scale {scale}")
    return table_of(settings.resolved())


def measured(request: Request, scene: Path, row: Row) -> Figures:
    """Train a row on a scene, or resume its run, and measure it."""
    folder = request.out / "runs" / scene.name / row.name
    settings = settings_of(row, request.scale)
    request.say(f"{scene.name}, {row.name}: training {settings['train']['iterations']} steps")
    run, outcomes = run_to(request, folder, scene, settings, ("poses", "train", "bake") if row.bakes else ("poses", "train"))
    request.say(f"{scene.name}, {row.name}: measuring")
    quality = _quality(run, str(outcomes[1].digest), settings, request.device)
    lines = [json.loads(line) for line in TrainOutputs.of_run(run.path).log.read_text(encoding="utf-8").splitlines()]
    return Figures(
        **{name: quality[name] for name in ("psnr", "ssim", "valid", "pivotal")}, **_pace(lines),
        tree=_tree_figures(run, _count(settings["evaluate"]["field_views"]), request.device) if row.bakes else None,
    )  # fmt: skip


def run_to(request: Request, folder: Path, source: Path, settings: dict[str, dict[str, Any]], names: Sequence[str]) -> tuple[Run, list[Any]]:
    """A run in a folder, made or resumed, and the outcomes of these stages of it."""
    run = Run.open(folder) if (folder / NAME).exists() else Run.create(folder, source.resolve(), settings, preset=PRESET, device=request.device)
    stages = [stage for stage in asset.STAGES if stage.name in names]
    with run.locked():
        run.update(source=source.resolve(), settings=settings, preset=PRESET)
        return run, run_stages(run, stages, device=request.device, report=request.report)


def _pace(lines: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Seconds, samples and the curve from the log of a training."""
    counts = [after["step"] - before for after, before in zip(lines, [0, *(line["step"] for line in lines)], strict=False)]
    spent = [line["step_seconds"] * count for line, count in zip(lines, counts, strict=True)]
    total = math.fsum(spent)
    late = [line for line in lines if line["step"] > 0.8 * lines[-1]["step"]] or list(lines[-1:])
    curve: tuple[list[float], list[float]] = ([], [])
    for n, line in enumerate(lines):
        if line["preview_psnr"] is not None:
            curve[0].append(math.fsum(spent[: n + 1]))
            curve[1].append(line["preview_psnr"])
    rays = sum(line["rays"] for line in late)
    return {
        "step": total / lines[-1]["step"],
        "steady": statistics.median(line["step_seconds"] for line in late),
        "hours": total / 3600,
        "coarse": sum(line["valid"] for line in late) / rays,
        "fine": sum(line["fine"] for line in late) / rays,
        "curve": curve,
    }


def _quality(run: Run, digest: str, settings: Mapping[str, Mapping[str, Any]], device: str) -> dict[str, Any]:
    """PSNR, SSIM and shares of the network on test views; cached next to the run until the field or the views change."""
    kept = run.path / "network.json"
    key = {"field": digest, "views": settings["evaluate"]["field_views"]}
    if kept.exists() and (found := json.loads(kept.read_text(encoding="utf-8")))["of"] == key:
        return dict(found)
    use_all_cores()
    s = scene.load(run.folder("poses"))
    views, split = evaluation_views(s)
    renderer = load_renderer(run.folder("train"), device)
    decibels, similarities, counts = [], [], SampleCounts()
    for view in [views[k] for k in evenly_spaced(len(views), _count(settings["evaluate"]["field_views"]))]:
        rendering = renderer.render(view.camera)
        truth = ground_truth(run.folder("poses"), view, s.background).colour
        image = np.clip(rendering.colour, 0, 1)
        decibels.append(psnr(image, truth))
        similarities.append(ssim(image, truth))
        counts += rendering.counts
    quality = {
        "of": key,
        "split": split,
        "psnr": float(np.mean(decibels)),
        "ssim": float(np.mean(similarities)),
        "valid": counts.valid_share,
        "pivotal": counts.pivotal_share,
        "psnr_of_views": decibels,
    }
    kept.write_text(json.dumps(quality, indent=1) + "\n", encoding="utf-8")
    return quality


def _count(field_views: int | str) -> int | None:
    """evaluate.field_views for `evenly_spaced`."""
    return None if isinstance(field_views, str) else field_views


def _frame_seconds(tree: NerfTree, camera: Camera, background: tuple[float, float, float] | None) -> float:
    """Seconds of a render; on a device its framebuffer stays there."""
    if tree.device == "cpu" or tree.ndc is not None or not dispatch.triton_usable():
        begun = time.perf_counter()
        render(tree, camera, background=background)
        return time.perf_counter() - begun

    from efficientnerf.backends.triton.tree import device_tree_of, render_image  # needs Triton

    torch.cuda.synchronize()
    begun = time.perf_counter()
    render_image(device_tree_of(tree), camera, background=background)
    torch.cuda.synchronize()
    return time.perf_counter() - begun


def _tree_figures(run: Run, wanted: int | None, device: str) -> dict[str, Any]:
    """PSNR and SSIM of the baked tree on the test views of the network (`wanted` of them, None: all), and frames a second at their size."""
    tree = format.load(BakeOutputs.of_run(run.path).asset).to(device)
    s = scene.load(run.folder("poses"))
    views, _ = evaluation_views(s)
    drawn = [views[k] for k in evenly_spaced(len(views), wanted)]
    _frame_seconds(tree, drawn[0].camera, s.background)  # compiled, and in memory
    decibels, similarities, seconds = [], [], []
    for view in drawn:
        image = render(tree, view.camera, background=s.background).colour
        seconds.append(_frame_seconds(tree, view.camera, s.background))
        truth = ground_truth(run.folder("poses"), view, s.background).colour
        decibels.append(psnr(np.clip(image, 0, 1), truth))
        similarities.append(ssim(np.clip(image, 0, 1), truth))
    camera = drawn[0].camera
    return {
        "psnr": float(np.mean(decibels)),
        "ssim": float(np.mean(similarities)),
        "fps": 1 / float(np.median(seconds)),
        "frame": f"{camera.width}x{camera.height}",
    }
