"""The model: coarse field, fine field, density voxels and the space they live in; how it renders rays (EfficientNeRF, figure 2)."""

import math
from dataclasses import dataclass, replace
from importlib import import_module
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from efficientnerf.backends import dispatch
from efficientnerf.fields.field import Field
from efficientnerf.fields.gradient_buffer import GradientBuffer
from efficientnerf.geometry.spaces import RayBundle, Space, voxel_centres
from efficientnerf.rendering.compositing import Composite, ray_of_sample
from efficientnerf.rendering.harmonics import harmonics_count
from efficientnerf.sampling.occupancy import DensityVoxels, density_voxels
from efficientnerf.sampling.samples import SampleCapacity, Samples
from efficientnerf.sampling.strategies import Efficient, Hierarchical, Intervals, SamplingRequest, Strategy, Uniform, Valid
from efficientnerf.settings import resolved
from efficientnerf.training.settings import TrainSettings

SKY_DEGREE = 2
SKY_LEAST = 0.01  # of a channel that the sky begins with, and of what is left to 1: from 0 or 1 nothing would ever change it
SAMPLES_AT_ONCE = 2**19  # that are rendered where nothing is pruned
HIDDEN = 1e-4  # of a ray's light: where no more is left, samples are left out of training
UNSEEN = 0.5  # grey: drawn behind a space that reaches to infinity, where nothing can lie


class Sky(nn.Module):
    """The background of an unbounded scene, beyond all samples: a colour that depends on the direction alone."""

    def __init__(self) -> None:
        super().__init__()
        self.sh = nn.Parameter(torch.zeros(harmonics_count(SKY_DEGREE), 3))

    def forward(self, directions: Tensor) -> Tensor:
        """Colours (R, 3) along unit directions (R, 3)."""
        return torch.sigmoid(dispatch.basis(directions, SKY_DEGREE) @ self.sh)

    @torch.no_grad()
    def begin_with(self, harmonics: np.ndarray) -> None:
        """Start from harmonics (K, 3), of what a sigmoid makes colours."""
        self.sh.copy_(torch.from_numpy(harmonics.astype(np.float32)))


@dataclass
class Model:
    """See the module. The settings are those that it was made with, and do not change."""

    space: Space
    settings: TrainSettings
    coarse: Field
    fine: Field
    voxels: DensityVoxels
    strategy: Strategy
    sky: Sky
    background: tuple[float, float, float] | None  # constant colour behind the scene, or None: then `sky` is
    num_coarse_samples: int  # N_c
    step: float  # length of a coarse interval in the box, world units
    max_intervals: int  # intervals on a ray at most

    @property
    def prunes(self) -> bool:
        """Whether the density voxels are used."""
        return self.strategy.prunes

    def distortion_weight(self, fraction: float) -> float:
        """Of the distortion loss (Barron et al. 2022, "Mip-NeRF 360", equation 15), the mean of `RayOutputs.distortion`; fraction of the schedule, 0 to 1."""
        stated = resolved(self.settings.distortion_loss_weight)
        return self.space.distortion_schedule(fraction) * (self.space.distortion_loss_weight if stated is None else stated)

    @property
    def device(self) -> torch.device:
        return self.voxels.values.device

    def rays_at_once(self, most: int) -> int:
        """How many rays to render at once, at most `most`: without pruning a ray has all samples."""
        return most if self.prunes else min(most, max(64, SAMPLES_AT_ONCE // (self.num_coarse_samples + self.settings.num_importance_samples)))

    def snapped_points(self, points: Tensor) -> Tensor:
        """Points (N, 3) in grid coordinates at which the fields are queried: these, or with `train.discretise` the centres of their voxels."""
        side = resolved(self.settings.discretise)
        return points if side is None else voxel_centres(self.space, points, side)

    def parameters(self) -> list[tuple[str, nn.Parameter]]:
        """Everything that is learned, by name, in a fixed order."""
        parts: list[tuple[str, Field | Sky]] = [("coarse", self.coarse), ("fine", self.fine), ("sky", self.sky)]
        return [(f"{part}.{name}", p) for part, module in parts for name, p in module.named_parameters()]

    def gradient_buffers(self) -> dict[str, GradientBuffer]:
        """Those of the fields' tables, by the parameter's name."""
        parts = (("coarse", self.coarse), ("fine", self.fine))
        return {f"{part}.{name}": buffer for part, field in parts for name, buffer in field.gradient_buffers.items()}

    def behind(self, directions: Tensor) -> Tensor:
        """Colour (R, 3) beyond all samples."""
        if self.background is None:
            return torch.full_like(directions, UNSEEN) if self.space.reaches_infinity else self.sky(directions)
        return torch.stack([torch.full((len(directions),), value, device=directions.device) for value in self.background], dim=1)


class RayOutputs(NamedTuple):
    """A rendered bundle of rays: samples and raw field values of both stages, what they composite to, and which coarse samples are pivotal.

    Uniform sampling has no coarse stage: no coarse samples then, and no coarse colour. Samples lie on `rays`, in the frame of the space.
    """

    rays: RayBundle
    coarse: Samples
    coarse_raw: Tensor
    coarse_weight: Tensor
    coarse_colour: Tensor | None
    pivotal: Tensor
    fine: Samples
    fine_raw: Tensor
    # what the fine samples composite to, in the order of `Composite`; the distortion is that of both stages
    fine_colour: Tensor
    fine_opacity: Tensor
    distortion: Tensor
    fine_weight: Tensor
    fine_rgb: Tensor

    @property
    def fine_ray(self) -> Tensor:
        """(N,) which ray each fine sample belongs to."""
        return ray_of_sample(self.fine.first, len(self.fine.start))

    @property
    def fine_middle(self) -> Tensor:
        """(N,) distance along the ray of the middle of each fine sample."""
        return self.fine.start + self.fine.extent / 2

    def opacity_of(self, chosen: Tensor, ray: Tensor) -> Tensor:
        """(R,) opacity of some of the fine samples, (N,) bool; `ray` is `fine_ray`."""
        return torch.zeros_like(self.fine_opacity).index_add(0, ray, self.fine_weight * chosen)

    def surface_distance(self, ray: Tensor) -> Tensor:
        """(R,) distance in the world of the first fine sample at which half of a ray's light is gone; infinity where less is. `ray` is `fine_ray`."""
        gone = torch.cumsum(self.fine_weight.double(), dim=0)
        gone = gone - torch.cat([gone.new_zeros(1), gone])[self.fine.first[:-1]][ray]
        distance = torch.where(gone >= 0.5, self.rays.world_distance(self.fine_middle, ray), torch.inf)
        return torch.full_like(self.fine_opacity, torch.inf).scatter_reduce(0, ray, distance, reduce="amin")


def model(
    space: Space, settings: TrainSettings, background: tuple[float, float, float] | None, device: str = "cpu", span: tuple[float, float] | None = None,
    fields: tuple[Field, Field] | None = None,
) -> Model:  # fmt: skip
    """An untrained model; the same settings give the same numbers.

    span    near and far along the view axis, world units, for `train.near_plane` and `train.far_plane`
    fields  coarse and fine; None: those that `train.field` names
    """
    coarse_samples = resolved(settings.num_coarse_samples) or space.num_coarse_samples
    settings = replace(settings, num_coarse_samples=coarse_samples)
    generator = torch.Generator().manual_seed(settings.seed)
    coarse, fine = fields or import_module(f"efficientnerf.fields.{settings.field}").coarse_and_fine(settings, generator)
    if resolved(settings.far_plane) is None:
        span = None
    elif span is None or space.contracted:
        raise ValueError("train.near_plane and train.far_plane need a scene on a constant background. Leave them auto.")
    step = space.sampled_length(span) / coarse_samples
    voxels = _voxels(settings, space, step, device)
    intervals = Intervals(space, voxels, step, space.max_intervals(step), coarse_samples, span is not None, settings.field != "hash")
    strategy = _strategy(settings, intervals)
    fields = (coarse.to(device), fine.to(device))
    return Model(space, settings, *fields, voxels, strategy, Sky().to(device), background, coarse_samples, step, intervals.max_intervals)


def _voxels(s: TrainSettings, space: Space, step: float, device: str) -> DensityVoxels:
    """Fresh density voxels; under the rule "maximum", valid are those whose density has an alpha above the threshold over one coarse interval."""
    stated = resolved(s.occupancy_alpha_threshold)
    alpha = space.occupancy_alpha_threshold if stated is None else stated
    return density_voxels(
        resolved(s.occupancy_resolution) or space.occupancy_resolution,
        s.occupancy_rule,
        initial=s.occupancy_initial_density,
        beta=s.occupancy_beta,
        decay=s.occupancy_decay,
        threshold=-math.log1p(-min(alpha, 0.999)) / step if s.occupancy_rule == "maximum" else 0.0,
        device=device,
    )


def _strategy(s: TrainSettings, intervals: Intervals) -> Strategy:
    """The sampling strategy that `train.sampling` names."""
    pivots = (s.pivotal_threshold, s.max_pivots)
    if s.sampling == "efficient":
        return Efficient(intervals, *pivots, s.exploration_fraction, s.occupancy_update_ray_fraction)
    if s.sampling == "valid":
        return Valid(intervals, *pivots, s.num_importance_samples, s.occupancy_update_ray_fraction)
    if s.sampling == "hierarchical":
        return Hierarchical(intervals, *pivots, s.num_importance_samples)
    return Uniform(intervals, s.num_importance_samples)


def render_rays(
    m: Model, origins: Tensor, directions: Tensor, near: Tensor, far: Tensor, offset: Tensor, behind: Tensor, *,
    prune: bool = True, rng: np.random.Generator | None = None, capacity: SampleCapacity | None = None, samples_per_pivot: int = 0,
    explored: Tensor | None = None,
) -> RayOutputs:  # fmt: skip
    """Both stages along a bundle of rays, at the samples of the model's strategy.

    origins, directions  (R, 3) world frame, unit directions
    near, far, offset    (R,) distances, and the offset of the samples in their intervals
    behind               (R, 3) colour beyond all samples
    samples_per_pivot    N_s of this bundle; 0: as the settings say
    prune, rng, capacity, explored  see `efficientnerf.sampling.strategies.SamplingRequest`
    """
    rays = m.space.rays(origins, directions, near, far)
    request = SamplingRequest(rays, offset, samples_per_pivot or m.settings.samples_per_pivot, prune, rng, capacity, explored)
    if isinstance(m.strategy, Uniform):
        fine = m.strategy.samples(request)
        fine_raw, out = _composited(m, m.fine, directions, fine, behind)
        nothing = fine.start[:0]
        none = Samples(torch.zeros_like(fine.first), nothing, nothing, nothing, fine.point[:0], fine.tried)
        pivotal = torch.zeros(0, dtype=torch.bool, device=m.device)
        return RayOutputs(rays, none, fine_raw[:0], out.weight[:0], None, pivotal, fine, fine_raw, *out)
    stage = m.strategy.coarse(request)
    coarse = stage.samples
    coarse_raw, coarse_out = _composited(m, m.coarse, directions, coarse, behind)
    pivotal, fine = m.strategy.fine(request, stage, coarse_out.weight.detach())
    # On a device samples are padded to numbers that those of earlier steps decide.
    if prune and rng is not None and isinstance(m.strategy, Efficient) and not dispatch.on_device(m.voxels.values):
        fine = _visible(m, fine)
    fine_raw, out = _composited(m, m.fine, directions, fine, behind)
    out = out._replace(distortion=out.distortion + coarse_out.distortion)
    return RayOutputs(rays, coarse, coarse_raw, coarse_out.weight, coarse_out.colour, pivotal, fine, fine_raw, *out)


@torch.no_grad()
def _visible(m: Model, fine: Samples) -> Samples:
    """The fine samples that are not behind what the fine field has: two in three are, for the coarse field is less sharp, and nothing is learned from them."""
    return dispatch.visible_samples(fine, lambda points: m.fine.density(m.snapped_points(points)), m.fine.activation, HIDDEN)


def _composited(m: Model, field: Field, directions: Tensor, samples: Samples, behind: Tensor) -> tuple[Tensor, Composite]:
    """Raw values of a field at samples (N, 1 + 3K), and what they composite to along their rays."""
    raw = field.along_rays(m.snapped_points(samples.point), directions, samples.first)
    return raw, dispatch.composite(raw, samples.length, samples.first, field.harmonics(directions), behind, field.activation)


def state_of(m: Model) -> dict[str, Tensor]:
    """Everything that training changed, by name."""
    return {name: p.detach() for name, p in m.parameters()} | {"voxels": m.voxels.values}


def restore(m: Model, state: dict[str, Tensor]) -> None:
    """Put `state_of`'s tensors back; ValueError names what does not fit."""
    wanted = state_of(m)
    check_tensors(state, wanted)
    for name, tensor in wanted.items():
        tensor.copy_(state[name])


def check_tensors(state: dict[str, Tensor], wanted: dict[str, Tensor]) -> None:
    """ValueError names the first tensor that is missing, or of another type or shape than the wanted one."""
    for name, tensor in wanted.items():
        if name not in state:
            raise ValueError(f"tensor '{name}' is missing")
        if state[name].shape != tensor.shape or state[name].dtype != tensor.dtype:
            raise ValueError(f"tensor '{name}' is {state[name].dtype} {tuple(state[name].shape)}; expected {tensor.dtype} {tuple(tensor.shape)}")
