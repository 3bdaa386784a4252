"""Train nerfstudio's nerfacto on a CPU for some minutes, and render the pixels of the test views that are asked for.

Runs in nerfstudio's own environment, and imports nothing of this project: `benchmarks/peers/__main__.py` starts it. The settings are those that
nerfstudio's documentation gives for scenes made in Blender, and SMALLER; the learning rate reaches its end when the time is up. Nothing is evaluated on
the way, no viewer runs and no checkpoint is written. Setting up and reading images are not counted.
"""

import argparse
import json
import resource
import sys
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch

# Fewer rays and samples, one small proposal network: the best of four variants (docs/experiments/peers.md).
SMALLER: dict[str, Any] = {
    "datamanager.train_num_rays_per_batch": 1024, "model.num_proposal_iterations": 1, "model.num_proposal_samples_per_ray": (96,),
    "model.proposal_net_args_list": ({"hidden_dim": 16, "log2_hashmap_size": 15, "num_levels": 5, "max_res": 128, "use_linear": False},),
    "model.num_nerf_samples_per_ray": 24, "model.log2_hashmap_size": 17, "model.proposal_weights_anneal_max_num_iters": 200,
}  # fmt: skip
# https://docs.nerf.studio/nerfology/methods/nerfacto.html, for Blender's scenes
SETTINGS: dict[str, Any] = {
    "model.implementation": "torch", "model.background_color": "white", "model.proposal_initial_sampler": "uniform", "model.near_plane": 2.0,
    "model.far_plane": 6.0, "model.camera_optimizer.mode": "off", "model.use_average_appearance_embedding": False, "model.use_appearance_embedding": False,
    "model.distortion_loss_mult": 0.0, "model.disable_scene_contraction": True, "model.eval_num_rays_per_chunk": 4096, **SMALLER,
}  # fmt: skip
OPERATORS = torch.library.Library("torchvision", "FRAGMENT")
LIBRARIES = ("nerfstudio", "torch", "numpy")


def declare_operators() -> None:
    """PyPI's torchvision is built for CUDA and cannot load its operators into a torch without; it declares two of them all the same. None is used."""
    try:
        torch.ops.load_library(next(Path(p, "torchvision", "_C.so") for p in sys.path if Path(p, "torchvision", "_C.so").exists()))
    except (OSError, StopIteration):
        for name in ("nms", "qnms"):
            OPERATORS.define(f"{name}(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")


def configured(data: Path, out: Path) -> Any:
    """nerfacto's own configuration with SETTINGS: names are those of its fields, with dots, from the pipeline's on."""
    from nerfstudio.configs.method_configs import method_configs
    from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManagerConfig
    from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig
    from torchmetrics.image import lpip

    lpip.LearnedPerceptualImagePatchSimilarity = lambda **_: None  # its weights are a download, and it is not asked for
    config = method_configs["nerfacto"]
    config.output_dir, config.experiment_name, config.timestamp, config.vis = out, "peer", "run", "none"
    config.machine.device_type = "cpu"
    rays = config.pipeline.datamanager.train_num_rays_per_batch
    config.pipeline.datamanager = VanillaDataManagerConfig(dataparser=BlenderDataParserConfig(data=data, alpha_color="white"), train_num_rays_per_batch=rays)
    for name, value in SETTINGS.items():
        *parents, last = name.split(".")
        holder = config.pipeline
        for parent in parents:
            holder = getattr(holder, parent)
        setattr(holder, last, value)
    return config


def train(trainer: Any, seconds: float) -> tuple[int, float]:
    """Steps as nerfstudio's trainer makes them until the time is up; their number and the seconds that they took."""
    from nerfstudio.engine.callbacks import TrainingCallbackLocation

    schedules = [group["scheduler"] for group in trainer.config.optimizers.values()]
    step, start = 0, time.monotonic()
    while (spent := time.monotonic() - start) < seconds:
        if step >= 10:  # the learning rate ends with the time
            for schedule in schedules:
                schedule.max_steps = max(step + 1, round(step * seconds / spent))
        trainer.step = step
        trainer.pipeline.train()
        for callback in trainer.callbacks:
            callback.run_callback_at_location(step, location=TrainingCallbackLocation.BEFORE_TRAIN_ITERATION)
        loss, _, _ = trainer.train_iteration(step)
        for callback in trainer.callbacks:
            callback.run_callback_at_location(step, location=TrainingCallbackLocation.AFTER_TRAIN_ITERATION)
        step += 1
        if step % 50 == 0:
            print(f"step {step}, {spent:.0f} s, loss {float(loss):.4f}", flush=True)
    return step, time.monotonic() - start


@torch.no_grad()
def rendered(pipeline: Any, stride: int) -> np.ndarray:
    """(V, H', W', 3) float16 of all test views: every stride-th row and column, beginning in the middle of the first stride."""
    pipeline.eval()
    cameras, first = pipeline.datamanager.eval_dataset.cameras, (stride - 1) // 2
    images = []
    for index in range(len(cameras)):
        rows, columns = torch.arange(first, int(cameras.height[index]), stride), torch.arange(first, int(cameras.width[index]), stride)
        coordinates = torch.stack(torch.meshgrid(rows + 0.5, columns + 0.5, indexing="ij"), dim=-1)  # (H', W', 2), y first
        rays = cameras.generate_rays(camera_indices=torch.full((*coordinates.shape[:2], 1), index), coords=coordinates)
        images.append(pipeline.model.get_outputs_for_camera_ray_bundle(rays)["rgb"].clamp(0, 1).numpy().astype(np.float16))
        print(f"view {index + 1} of {len(cameras)}", flush=True)
    return np.stack(images)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="a data set as Blender's: transforms_train.json, transforms_test.json")
    parser.add_argument("out", type=Path, help="folder for renders.npy and report.json")
    parser.add_argument("--minutes", type=float, default=1.0)
    parser.add_argument("--stride", type=int, default=8)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    given = parser.parse_args()
    torch.set_num_threads(given.threads)
    given.out.mkdir(parents=True, exist_ok=True)
    declare_operators()
    config = configured(given.data, given.out)
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup(test_mode="test")
    print("training", flush=True)
    steps, seconds = train(trainer, 60 * given.minutes)
    peak, start = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, time.monotonic()
    model = trainer.pipeline.model
    np.save(given.out / "renders.npy", rendered(trainer.pipeline, given.stride))
    rays = steps * trainer.pipeline.datamanager.get_train_rays_per_batch()
    report = {
        "steps": steps, "seconds": seconds, "rays_per_second": rays / seconds, "peak_mib": peak, "rendering_seconds": time.monotonic() - start,
        "model_bytes": sum(tensor.numel() * tensor.element_size() for tensor in model.parameters()), "threads": given.threads, "settings": SETTINGS,
        "versions": {name: version(name) for name in LIBRARIES},
    }  # fmt: skip
    (given.out / "report.json").write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
