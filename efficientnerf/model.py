"""The model: coarse field, fine field, density voxels and the space they live in; how it looks along rays (EfficientNeRF, figure 2)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from efficientnerf.density import DensityVoxels, density_voxels
from efficientnerf.fields.hash import HashField
from efficientnerf.fields.mlp import MlpField
from efficientnerf.grid import Space
from efficientnerf.harmonics import basis, harmonics_count
from efficientnerf.kernels import dispatch
from efficientnerf.sampling import FARTHEST, Samples
from efficientnerf.settings import TrainSettings

SKY_DEGREE = 2
COARSEST = 16


class Sky(nn.Module):
    """What lies beyond all samples of a scene with surroundings: a colour that depends on the direction alone."""

    def __init__(self) -> None:
        super().__init__()
        self.sh = nn.Parameter(torch.zeros(harmonics_count(SKY_DEGREE), 3))

    def forward(self, directions: Tensor) -> Tensor:
        """Colours (R, 3) along unit directions (R, 3)."""
        return torch.sigmoid(basis(directions, SKY_DEGREE) @ self.sh)


@dataclass
class Model:
    """See the module.

    step        length of a coarse interval in the box, world units
    slots       intervals on a ray at most
    background  constant colour behind the scene, or None: then `sky` is
    """

    space: Space
    settings: TrainSettings
    coarse: HashField | MlpField
    fine: HashField | MlpField
    voxels: DensityVoxels
    sky: Sky
    background: tuple[float, float, float] | None
    step: float
    slots: int

    @property
    def device(self) -> torch.device:
        return self.voxels.values.device

    def parameters(self) -> list[tuple[str, nn.Parameter]]:
        """Everything that is learned, by name, in a fixed order."""
        parts: list[tuple[str, nn.Module]] = [("coarse", self.coarse), ("fine", self.fine), ("sky", self.sky)]
        return [(f"{part}.{name}", p) for part, module in parts for name, p in module.named_parameters()]

    def behind(self, directions: Tensor) -> Tensor:
        """Colour (R, 3) beyond all samples."""
        if self.background is None:
            return self.sky(directions)
        return torch.tensor(self.background, device=directions.device).expand(len(directions), 3)


class Look(NamedTuple):
    """What one bundle of rays met: samples of both stages, what the fields said, and whether each coarse sample was pivotal."""

    coarse: Samples
    coarse_raw: Tensor
    coarse_weight: Tensor
    coarse_colour: Tensor
    pivotal: Tensor
    fine: Samples
    fine_raw: Tensor
    fine_colour: Tensor
    fine_opacity: Tensor
    fine_weight: Tensor
    fine_rgb: Tensor
    distortion: Tensor


def model(space: Space, settings: TrainSettings, background: tuple[float, float, float] | None, device: str = "cpu") -> Model:
    """An untrained model; the same settings give the same numbers."""
    generator = torch.Generator().manual_seed(settings.seed)
    if settings.field == "hash":
        coarse: HashField | MlpField = HashField(
            levels=max(1, settings.levels // 2), log2_table=max(8, settings.log2_table - 2), coarsest=COARSEST, finest=max(COARSEST, settings.finest // 4),
            hidden=settings.coarse_hidden, layers=settings.coarse_layers, degree=0, initial_density=settings.initial_density, generator=generator,
        )  # fmt: skip
        fine: HashField | MlpField = HashField(
            levels=settings.levels, log2_table=settings.log2_table, coarsest=COARSEST, finest=settings.finest,
            hidden=settings.hidden, layers=settings.layers, degree=settings.degree, initial_density=settings.initial_density,
            generator=generator,
        )  # fmt: skip
    else:
        coarse = MlpField(hidden=settings.coarse_hidden, layers=settings.coarse_layers, degree=settings.degree, generator=generator)
        fine = MlpField(hidden=settings.hidden, layers=settings.layers, degree=settings.degree, generator=generator)
    diagonal = 2 * float(np.linalg.norm(space.half))
    step = diagonal / settings.coarse_samples
    slots = settings.coarse_samples + 1
    if space.contracted:
        # In front of the box and behind it: the contracted distance from the edge of space to the box and back, in steps, with some room
        # for rays that run slantwise through the shell.
        slots += math.ceil(4 * (1 - FARTHEST) * float(space.half.max()) * math.sqrt(3) / step)
    side = settings.voxels or (192 if space.contracted else 128)
    # A valid voxel absorbs `voxel_absorption` of the light over one coarse interval.
    threshold = -math.log1p(-min(settings.voxel_absorption, 0.999)) / step if settings.voxel_rule == "maximum" else 0.0
    voxels = density_voxels(
        side, settings.voxel_rule, initial=settings.voxel_initial, beta=settings.voxel_beta, decay=settings.voxel_decay, threshold=threshold, device=device
    )
    return Model(space, settings, coarse.to(device), fine.to(device), voxels, Sky().to(device), background, step, slots)


def look(
    m: Model, origins: Tensor, directions: Tensor, near: Tensor, far: Tensor, offset: Tensor, behind: Tensor, *,
    prune: bool = True, rng: np.random.Generator | None = None,
) -> Look:  # fmt: skip
    """Both stages along a bundle of rays: valid samples through the coarse field, pivotal ones through the fine one.

    origins, directions  (R, 3) world frame, unit directions
    near, far, offset    (R,) distances, and the offset of the samples in their intervals
    behind               (R, 3) colour beyond all samples
    prune                whether the density voxels are heeded (not in the warm-up)
    rng                  in training: a random share of the valid intervals is looked at by the fine field too. Without it the fine field would be
                         free to put matter where this ray has no pivot and another has one, and the baked asset, which has no coarse
                         stage to hide it, would show it.
    """
    threshold = m.voxels.threshold if prune else -math.inf
    coarse = dispatch.valid_samples(m.space, origins, directions, near, far, offset, m.step, m.slots, m.voxels.values, threshold)
    coarse_raw = m.coarse(coarse.point)
    seen = dispatch.composite(coarse_raw, coarse.length, coarse.first, basis(directions, m.coarse.degree), behind, m.coarse.activation)
    pivotal = dispatch.pivots(seen.weight.detach(), coarse.first, m.settings.pivotal_weight, m.settings.max_pivots)
    if rng is not None and m.settings.explored > 0:
        pivotal = pivotal | torch.from_numpy(rng.random(len(pivotal), np.float32) < m.settings.explored).to(pivotal.device)
    fine = dispatch.pivotal_samples(m.space, origins, directions, offset, coarse, pivotal, m.settings.fine_samples)
    fine_raw = m.fine(fine.point)
    out = dispatch.composite(fine_raw, fine.length, fine.first, basis(directions, m.fine.degree), behind, m.fine.activation)
    return Look(
        coarse, coarse_raw, seen.weight, seen.colour, pivotal,
        fine, fine_raw, out.colour, out.opacity, out.weight, out.sample_colour, seen.distortion + out.distortion,
    )  # fmt: skip


def state_of(m: Model) -> dict[str, Tensor]:
    """Everything that training changed, by name."""
    return {name: p.detach() for name, p in m.parameters()} | {"voxels": m.voxels.values}


def restore(m: Model, state: dict[str, Tensor]) -> None:
    """Put `state_of`'s tensors back; ValueError names what does not fit."""
    wanted: dict[str, Any] = dict(m.parameters()) | {"voxels": m.voxels.values}
    for name, tensor in wanted.items():
        if name not in state:
            raise ValueError(f"tensor '{name}' is missing")
        if state[name].shape != tensor.shape or state[name].dtype != tensor.dtype:
            raise ValueError(f"tensor '{name}' is {state[name].dtype} {tuple(state[name].shape)}; expected {tensor.dtype} {tuple(tensor.shape)}")
        tensor.data.copy_(state[name])
