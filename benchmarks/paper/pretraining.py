"""Train IBRNet or MVSNeRF over drawn scenes, and measure it on scenes that it was not trained on.

    python -m benchmarks.scenes SCENES --drawn 150 --size 128 --train 40 --val 0 --test 0
    python -m benchmarks.paper.pretraining train SCENES ibrnet benchmarks/paper/weights/ibrnet.safetensors --steps 4000
    python -m benchmarks.paper.pretraining train SCENES mvsnerf benchmarks/paper/weights/mvsnerf.safetensors --steps 5000
    python -m benchmarks.paper.pretraining measure SCENES ibrnet benchmarks/paper/weights/ibrnet.safetensors

These made the weights of this package, with one thread.
The last HELD_OUT scenes are those to measure on. `measure` renders views of them from the others without finetuning, and compares with a picture that is
blended from the nearest views by warping without depth.
"""

import argparse
import json
import os
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch

from benchmarks.paper.pretrained import NETWORKS, pretrained_network
from benchmarks.paper.source_view_training import FAR, SETTINGS, SOURCES, WHITE, PosedImages, pretrain
from benchmarks.paper.source_views import SourceViews, angles, bilinear, projected
from benchmarks.scenes.drawn import MIDDLE
from efficientnerf.evaluation.metrics import psnr
from efficientnerf.geometry.cameras import Camera, pose_from_opengl, rays, resized
from efficientnerf.geometry.spaces import BoundedSpace
from efficientnerf.model import model
from efficientnerf.rendering.field_renderer import FieldRenderer
from stages.evaluate.views import evenly_spaced, subsample, subsample_camera
from stages.io.field_file import write_tensors
from stages.io.png import read_png

HELD_OUT = 10


def read_scene(folder: Path, shrink: int = 1) -> PosedImages:
    """A drawn scene, in its box; its images `shrink` times smaller."""
    document = json.loads((folder / "transforms.json").read_text(encoding="utf-8"))
    lens = tuple(document[name] for name in ("fl_x", "fl_y", "cx", "cy"))
    cameras, images = [], []
    for frame in document["frames"]:
        pose = pose_from_opengl(np.array(frame["transform_matrix"]))
        camera = Camera(frame["file_path"], document["w"], document["h"], "PINHOLE", lens, pose)
        cameras.append(resized(camera, camera.width // shrink, camera.height // shrink))
        image = read_png(folder / frame["file_path"])
        images.append(cv2.resize(image, (cameras[-1].width, cameras[-1].height), interpolation=cv2.INTER_AREA))
    return PosedImages(BoundedSpace(np.array(MIDDLE) + np.array([[-1.0], [1.0]])), cameras, np.stack(images))


def train(scenes: list[PosedImages], method: str, out: Path, steps: int, seed: int) -> None:
    torch.manual_seed(seed)
    network = NETWORKS[method]()
    begun, used, errors = time.perf_counter(), time.process_time(), []
    for step, error in enumerate(pretrain(network, scenes, steps, seed), 1):
        errors.append(error)
        if step % 100 == 0:
            wall, cpu = time.perf_counter() - begun, time.process_time() - used
            print(f"step {step}: {-10 * np.log10(np.mean(errors[-100:])):.2f} dB, {wall:.0f} s, {cpu:.0f} s of a core", flush=True)
    write_tensors(network.state_dict(), {"network": method}, out)


def warped(sources: SourceViews, camera: Camera) -> np.ndarray:
    """(H, W, 3) what a camera sees if all lay on the plane through the middle of the box that faces it: each source view warped by the homography of that
    plane, blended by how well its direction agrees; white where none sees the plane."""
    origins, directions = (torch.as_tensor(a, dtype=torch.float32) for a in rays(camera))
    forward = torch.as_tensor(camera.forward, dtype=torch.float32)
    middle = sources.low + sources.extent / 2
    points = origins + ((middle - origins) @ forward / (directions @ forward))[:, None] * directions  # (N, 3)
    matrix, view = sources.pixels_from_world, torch.arange(len(sources.centre)).expand(len(points), -1)
    pixel, seen = projected(sources, torch.einsum("vij,nj->nvi", matrix[..., :3], points) + matrix[..., 3])
    weight = seen / (1 - angles(sources, points, directions, view)[..., 3] + 1e-3)
    total = weight.sum(1, keepdim=True)
    colour = (bilinear(sources.colour, view, pixel) * weight[..., None]).sum(1) / total.clamp(min=1e-9)
    return torch.where(total > 0, colour, 1.0).reshape(camera.height, camera.width, 3).numpy()


def measure(scenes: list[PosedImages], method: str, weights: Path, views: int) -> dict[str, float]:
    """Mean PSNR over held-out views, every second pixel of every second row: of the network with both samplings, and of the nearest views warped."""
    network = pretrained_network(method, weights)
    found: dict[str, list[float]] = {"uniform": [], "efficient": [], "warped": []}
    for scene in scenes:
        for target in evenly_spaced(len(scene.cameras), views):
            (sources, references), camera = scene.sources(target, SOURCES), subsample_camera(scene.cameras[target], 2)
            truth = subsample(scene.over_white(np.array([target]))[0], 2)
            with torch.no_grad():
                network.observe(sources, references)
            for sampling in ("uniform", "efficient"):
                m = model(scene.space, replace(SETTINGS, sampling=sampling), WHITE, fields=(network.coarse, network.fine))
                found[sampling].append(psnr(np.clip(FieldRenderer(m, 0.0, FAR).render(camera).colour, 0, 1), truth))
            found["warped"].append(psnr(warped(sources, camera), truth))
    return {name: float(np.mean(values)) for name, values in found.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["train", "measure"])
    parser.add_argument("scenes", type=Path)
    parser.add_argument("method", choices=list(NETWORKS))
    parser.add_argument("weights", type=Path)
    parser.add_argument("--steps", type=int, default=4000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--views", type=int, default=2, help="views of each scene to measure on")
    given = parser.parse_args()
    torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", os.cpu_count() or 1)))
    folders = sorted(given.scenes.glob("drawn_*"))
    if given.what == "train":
        scenes = [read_scene(folder, shrink) for folder in folders[:-HELD_OUT] for shrink in (1, 2)]  # what a network learns should not depend on the size
        train(scenes, given.method, given.weights, given.steps, given.seed)
    else:
        print(json.dumps(measure([read_scene(folder) for folder in folders[-HELD_OUT:]], given.method, given.weights, given.views)))


if __name__ == "__main__":
    main()
