"""Training of a network over many scenes (`benchmarks.paper.ibrnet`, `benchmarks.paper.mvsnerf`): one flat loop.

A step renders rays of one photograph of a random scene from the other photographs that are nearest to it. Every second step takes uniform samples, the others
coarse and pivotal ones without density voxels, so that the same weights serve both.

R rays, V views of a scene.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from benchmarks.paper.mvsnerf import VIEWS
from benchmarks.paper.pretrained import SourceViewNetwork
from benchmarks.paper.source_views import SourceViews, source_views
from efficientnerf.geometry.cameras import Camera, rays
from efficientnerf.geometry.spaces import BoundedSpace
from efficientnerf.model import Model, model, render_rays
from efficientnerf.training.losses import colour_losses
from efficientnerf.training.optimiser import Adam, ParameterGroup
from efficientnerf.training.settings import TrainSettings

WHITE = (1.0, 1.0, 1.0)
RAYS = 96
SOURCES = 4  # photographs that a target is rendered from
RAMP = 20  # steps until the learning rate is whole
FINAL = 0.03  # of the learning rate, at the end
COVERED_SHARE = 0.5  # of the rays, those that the alpha of the target covers
SETTINGS = TrainSettings(
    field="nerf", num_coarse_samples=64, num_importance_samples=0, samples_per_pivot=4, max_pivots=8, exploration_fraction=0.05, background_color="scene",
    occupancy_rule="momentum", occupancy_resolution=8,
)  # fmt: skip
FAR = 100.0  # beyond every box


@dataclass(frozen=True)
class PosedImages:
    """A scene to train on: cameras, and images (V, H, W, 4) uint8 with straight alpha, in a box."""

    space: BoundedSpace
    cameras: Sequence[Camera]
    images: np.ndarray

    def over_white(self, index: np.ndarray) -> np.ndarray:
        """(len(index), H, W, 3) float32 in 0-1."""
        pixels = self.images[index].astype(np.float32) / np.float32(255)
        return pixels[..., :3] * pixels[..., 3:] + 1 - pixels[..., 3:]

    def nearest(self, view: int, count: int) -> np.ndarray:
        """(count,) the other views whose directions from the middle are closest to that of a view, the closest first."""
        others = np.delete(np.arange(len(self.cameras)), view)
        centre = np.array([camera.centre for camera in self.cameras]) - self.space.centre
        cosine = centre[others] @ centre[view] / np.linalg.norm(centre[others], axis=1)
        near: np.ndarray = others[np.argsort(-cosine)[:count]]
        return near

    def sources(self, target: int, count: int, elsewhere: Sequence[int] = ()) -> tuple[SourceViews, Tensor]:
        """Source views for a view that is not among them: the `count` nearest to it, and the VIEWS nearest to each of some other views. And which of them
        (1 + len(elsewhere),) are the nearest to each."""
        groups = [self.nearest(target, count), *(near[near != target][:VIEWS] for near in (self.nearest(each, VIEWS + 1) for each in elsewhere))]
        chosen = list(dict.fromkeys(int(each) for group in groups for each in group))
        views = source_views(self.space, [self.cameras[n] for n in chosen], self.over_white(np.array(chosen)))
        return views, torch.tensor([chosen.index(int(group[0])) for group in groups])


def pretrain(network: SourceViewNetwork, scenes: Sequence[PosedImages], steps: int, seed: int = 0, learning_rate: float = 3e-3) -> Iterator[float]:
    """Train, yielding the fine colours' mean squared error after each step. The learning rate falls to FINAL of what it is. All scenes have boxes of one size.
    """
    m = model(scenes[0].space, SETTINGS, WHITE, fields=(network.coarse, network.fine))
    uniform = model(scenes[0].space, replace(SETTINGS, sampling="uniform"), WHITE, fields=(network.coarse, network.fine))
    adam = Adam([ParameterGroup(dict(network.named_parameters()))], beta2=0.99, epsilon=1e-8)
    for number in range(1, steps + 1):
        rng = np.random.Generator(np.random.Philox(key=seed, counter=[0, 0, 0, number]))
        scene = scenes[int(rng.integers(len(scenes)))]
        target = int(rng.integers(len(scene.cameras)))
        elsewhere = rng.integers(len(scene.cameras), size=rng.integers(network.most_elsewhere + 1))
        network.observe(*scene.sources(target, SOURCES, elsewhere.tolist()))
        loss, fine = _loss(m if number % 2 else uniform, scene, target, rng)
        loss.backward()
        adam.step(adam.step_size(number, learning_rate * min(1, number / RAMP) * FINAL ** ((number - 1) / steps)))
        yield fine


def _loss(m: Model, scene: PosedImages, target: int, rng: np.random.Generator) -> tuple[Tensor, float]:
    """Of random rays of a view: of both stages, and that of the fine one."""
    camera = scene.cameras[target]
    covered = np.flatnonzero(scene.images[target, ..., 3])
    pixel = rng.integers(camera.width * camera.height, size=RAYS)
    if len(covered):
        pixel[: int(COVERED_SHARE * RAYS)] = rng.choice(covered, int(COVERED_SHARE * RAYS))
    y, x = np.divmod(pixel, camera.width)
    origins, directions = (torch.as_tensor(a, dtype=torch.float32) for a in rays(camera, np.stack([x, y], -1) + 0.5))
    colour = torch.from_numpy(scene.over_white(np.array([target]))[0].reshape(-1, 3)[pixel])
    near, offset = torch.zeros(RAYS), torch.from_numpy(rng.random(RAYS, np.float32))
    outputs = render_rays(m, origins, directions, near, torch.full_like(near, FAR), offset, m.behind(directions), prune=False, rng=rng)
    fine, coarse = colour_losses(outputs, colour, None)
    return fine if coarse is None else fine + coarse, float(fine.detach())
