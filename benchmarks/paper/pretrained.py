"""IBRNet and MVSNeRF of table 6: networks that `python -m benchmarks.paper.pretraining` trained over drawn scenes, finetuned on a scene.

Both samplings begin with the same weights, and differ in nothing else: uniform sampling takes UNIFORM even samples of the fine field, ours valid and pivotal
ones, with density voxels that are swept before the first step. Finetunings are kept under OUT/runs as others are.
"""

import json
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from statistics import fmean
from typing import Any, Literal

import numpy as np
import torch

from benchmarks.paper.ibrnet import IbrNet
from benchmarks.paper.mvsnerf import MvsNerf
from benchmarks.paper.result import PAPER, Request, Result
from benchmarks.paper.runs import run_to
from benchmarks.paper.source_views import source_views
from efficientnerf.evaluation.metrics import psnr
from efficientnerf.geometry.spaces import BoundedSpace
from efficientnerf.model import Model, model
from efficientnerf.rendering.field_renderer import FieldRenderer
from efficientnerf.sampling.occupancy import reset_cells, sweep_cells
from efficientnerf.training import loop
from efficientnerf.training.occupancy_update import update_at_cells
from efficientnerf.training.settings import TrainSettings
from pipeline.files import write_json
from stages.evaluate.views import evaluation_views, evenly_spaced, ground_truth, subsample_camera
from stages.io import scene
from stages.io.field_file import digest_of, read_tensors, space_of
from stages.io.scene import View
from stages.train.data import depth_range, pixels_of

SourceViewNetwork = IbrNet | MvsNerf
NETWORKS: dict[str, type[IbrNet] | type[MvsNerf]] = {"ibrnet": IbrNet, "mvsnerf": MvsNerf}
Sampling = Literal["uniform", "efficient"]
BOTH: tuple[Sampling, Sampling] = ("uniform", "efficient")
WEIGHTS = Path(__file__).parent / "weights"
UNIFORM = 128  # samples of a ray: MVSNeRF's, and IBRNet's 64 + 64
SHARE_OF_ITERATIONS = 0.3  # of those of the other rows, which begin from nothing
# Before its activation: valid is a voxel above it. A voxel that a surface cuts is empty in part, so that its mean is below zero, where the paper prunes.
LEAST_DENSITY = -3.0
SWEPT = 2**14  # voxels that are queried at a time: what source views say of more does not fit the cache
REFERENCES = 6  # views whose volumes MVSNeRF encodes, spread over the scene
CHECKS = (0.0, 0.1, 0.25, 0.5, 1.0)  # shares of the steps after which test views are rendered
SEEDS = (0, 1)
EQUAL = "s to equal PSNR"
PRINTED = {("IBRNet", "uniform"): (2.0, 25.49), ("IBRNet", "ours"): (1.0, 26.23), ("MVSNeRF", "uniform"): (0.25, 27.21), ("MVSNeRF", "ours"): (0.18, 28.03)}
VIEWS, STRIDE = 4, 3  # of the test views so many, of which every third pixel of every third row


@dataclass(frozen=True)
class Finetuned:
    """A finetuning: samples of a ray through each field, and (seconds of a core, dB) of the CHECKS; `begun`: seconds before the first step."""

    step: float
    begun: float
    coarse: float
    fine: float
    seconds: list[float]
    psnr: list[float]

    def seconds_to(self, level: float) -> float:
        """Seconds until the curve reaches a level of dB, at most its last or highest one."""
        for n, value in enumerate(self.psnr):
            if value >= level:
                if n == 0:
                    return self.seconds[0]
                share = (level - self.psnr[n - 1]) / (value - self.psnr[n - 1])
                return self.seconds[n - 1] + share * (self.seconds[n] - self.seconds[n - 1])
        raise ValueError(f"the curve never reaches {level:g} dB")


def weights_of(method: str) -> Path:
    """Where the weights of a method lie in this package."""
    return WEIGHTS / f"{method}.safetensors"


def pretrained_network(method: str, path: Path | None = None) -> SourceViewNetwork:
    """The network of a method with its weights; None: those of this package."""
    network = NETWORKS[method]()
    network.load_state_dict(read_tensors(path or weights_of(method))[0])
    return network


def finetuning_settings(train: dict[str, Any], sampling: Sampling, seed: int) -> TrainSettings:
    """From the scaled train settings of the other rows."""
    return TrainSettings(
        field="nerf", sampling=sampling, seed=seed, iterations=max(4, round(SHARE_OF_ITERATIONS * train["iterations"])),
        sample_batch_size="off", max_rays_per_batch=train["max_rays_per_batch"], num_coarse_samples=UNIFORM, num_importance_samples=0,
        samples_per_pivot=1, max_pivots=UNIFORM, early_samples_per_pivot="off", exploration_fraction=0.0, background_color="scene",
        occupancy_rule="momentum", occupancy_resolution=40, occupancy_beta=0.5, occupancy_warmup_steps=0, occupancy_update_fraction=0.0,
        occupancy_update_ray_fraction=train["occupancy_update_ray_fraction"], learning_rate=1e-3, lr_final_ratio=0.3, adam_beta2=0.99, adam_epsilon=1e-8,
        precrop_steps=0, exposure="off", wrong_views="off", sparse_depth_loss_weight=0.0,
    )  # fmt: skip


def finetuned(request: Request, data: Path, method: str, sampling: Sampling, settings: dict[str, dict[str, Any]], seed: int) -> Finetuned:
    """Finetune on a scene, or read what an earlier call found. `settings` are those of the other rows."""
    folder = request.out / "runs" / data.name / "pretrained"
    run, _ = run_to(request, folder, data, settings, ("poses",))
    train = finetuning_settings(settings["train"], sampling, seed)
    network = pretrained_network(method)
    key = {"weights": digest_of(dict(network.state_dict())), "settings": asdict(train)}
    kept = folder / f"{method}-{sampling}-{seed}.json"
    if kept.exists() and (found := json.loads(kept.read_text(encoding="utf-8")))["of"] == key:
        return Finetuned(**found["figures"])
    request.say(f"{data.name}, {method}, {sampling} sampling, seed {seed}: finetuning {train.iterations} steps")
    out = _finetune(run.folder("poses"), network, train)
    write_json(kept, {"of": key, "figures": asdict(out)})
    return out


def _finetune(folder: Path, network: SourceViewNetwork, settings: TrainSettings) -> Finetuned:
    s = scene.load(folder)
    views, space = scene.views_of(s, "train"), space_of(s)
    pixels = pixels_of(folder, views)
    near, far = depth_range(s, pixels, settings)
    held = evaluation_views(s)[0]
    held = tuple(held[k] for k in evenly_spaced(len(held), VIEWS))
    images = np.stack([ground_truth(folder, view, s.background).colour for view in views])

    used = time.process_time()
    m = observed(network, space, views, images, settings, s.background)
    t = loop.trainer(m, cameras=[view.camera for view in views])
    spent = begun = time.process_time() - used
    renderer, due = FieldRenderer(m, near, far), [round(share * settings.iterations) for share in CHECKS]
    seconds, decibels = [spent], [_psnr(renderer, folder, held, s.background)]
    coarse = fine = rays = 0
    used = time.process_time()
    for done in loop.train(t, pixels):
        spent += time.process_time() - used
        if done.step in due:
            seconds.append(spent)
            decibels.append(_psnr(renderer, folder, held, s.background))
        coarse, fine, rays = coarse + done.valid, fine + done.fine, rays + done.rays
        used = time.process_time()
    return Finetuned((spent - begun) / settings.iterations, begun, coarse / rays, fine / rays, seconds, decibels)


def observed(
    network: SourceViewNetwork, space: BoundedSpace, views: tuple[View, ...], images: np.ndarray, settings: TrainSettings,
    background: tuple[float, float, float] | None,
) -> Model:  # fmt: skip
    """A model whose fields have seen the training views, (V, H, W, 3) in 0-1, before any step."""
    sources = source_views(space, [view.camera for view in views], images)
    with torch.no_grad():
        network.observe(sources, torch.tensor(evenly_spaced(len(views), REFERENCES)))
    network.settle()
    m = model(space, settings, background, fields=(network.coarse, network.fine))
    m.voxels.threshold = LEAST_DENSITY
    if m.prunes:
        sweep(m, settings.seed)
    return m


@torch.no_grad()
def sweep(m: Model, seed: int) -> None:
    """Set every voxel to the density at a random point in it: the coarse field knows the scene before it is trained."""
    update_at_cells(replace(m, voxels=replace(m.voxels, beta=1.0)), *sweep_cells(m.voxels, 0, 1, seed), SWEPT)
    reset_cells(m.voxels, ~(m.voxels.values > m.voxels.threshold).any())


def _psnr(renderer: FieldRenderer, folder: Path, views: tuple[View, ...], background: tuple[float, float, float] | None) -> float:
    """Mean over views, every STRIDE-th pixel of every STRIDE-th row."""
    found = []
    for view in views:
        shown = renderer.render(subsample_camera(view.camera, STRIDE)).colour
        found.append(psnr(np.clip(shown, 0, 1), ground_truth(folder, view, background, STRIDE).colour))
    return float(np.mean(found))


def rows(request: Request, data: Sequence[Path], settings: dict[str, dict[str, Any]]) -> Result:
    """The rows of IBRNet and MVSNeRF: means over scenes and SEEDS; no columns."""
    if not all(weights_of(method).exists() for method in NETWORKS):
        return Result([], [], [f"IBRNet and MVSNeRF are left out: python -m benchmarks.paper.pretraining has made no weights in {WEIGHTS}."])
    steps = finetuning_settings(settings["train"], "uniform", 0).iterations
    table: list[dict[str, Any]] = []
    curves: dict[str, tuple[Sequence[float], Sequence[float]]] = {}
    notes = [
        f"IBRNet and MVSNeRF: the same weights, trained over drawn scenes, finetuned for {steps} steps at a rate of 0.001; uniform: {UNIFORM} even"
        f" samples through the fine network; ours: {UNIFORM} coarse intervals, one fine"
        " sample in each pivotal one, voxels swept once before the first step. Seconds are of a core;"
        f" hours and the mean count all before the first step. PSNR is of every {STRIDE**2}th pixel of {VIEWS} test views. {EQUAL}: to the lower"
        " of both samplings' last PSNR. The paper has 25.49 dB for IBRNet in this table and 28.14 in table 2: probably without and with finetuning.",
    ]  # fmt: skip
    for method in ("IBRNet", "MVSNeRF"):
        cases = [(each, seed) for each in data for seed in SEEDS]
        pairs = [[finetuned(request, each, method.lower(), sampling, settings, seed) for sampling in BOTH] for each, seed in cases]
        equal = [[each.seconds_to(min(one.psnr[-1] for one in pair)) for each in pair] for pair in pairs]
        each_case = [
            f"{first.psnr[-1]:.2f} and {second.psnr[-1]:.2f} dB, {one:.0f} and {other:.0f} s to equal PSNR"
            for (first, second), (one, other) in zip(pairs, equal, strict=True)
        ]
        notes.append(f"{method}, uniform and ours, of each scene and seed: {'; '.join(each_case)}. Before the first step: {pairs[0][0].psnr[0]:.2f} and"
                     f" {pairs[0][1].psnr[0]:.2f} dB.")  # fmt: skip
        for k, sampling in enumerate(("uniform", "ours")):
            some = [pair[k] for pair in pairs]
            hours, decibels = PRINTED[method, sampling]
            table.append(
                {"method": method, "sampling": sampling, "training, hours": fmean([f.seconds[-1] / 3600 for f in some]), "training, hours" + PAPER: hours}
                | {"s/iteration": fmean([f.step for f in some]), "mean s/iteration": fmean([f.seconds[-1] / steps for f in some])}
                | {"coarse samples/ray": fmean([f.coarse for f in some]), "fine samples/ray": fmean([f.fine for f in some])}
                | {EQUAL: fmean([pair[k] for pair in equal]), "PSNR": fmean([f.psnr[-1] for f in some]), "PSNR" + PAPER: decibels}
            )
            curves[f"{method}, {sampling}"] = (some[0].seconds, some[0].psnr)
    return Result([], table, notes, curves)
