"""The model: coarse field, fine field, density voxels and the space they live in; how it looks along rays (EfficientNeRF, figure 2).

The hash field's coarse stage is a lighter hash field of densities alone, which measured better than pivots by the density voxels with none
(`train.coarse=voxels`, 40,000 fine samples a step and 64 steps of warm-up, which that way needs), by processor time on one core of an EPYC: *chair* at
200x200 after 500 steps 29.8 dB in 21 s with the field, 29.6 dB in 24 s with voxels alone; the still life in `examples` after 400 steps 23.0 dB in 23 s and
23.2 dB in 27 s; LLFF *fern* at 1008x756 after 700 steps 19.7 dB in 28 s and 14.7 dB in 37 s. In normalised device coordinates hardly a voxel is ever empty,
so that voxels find no surface there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from efficientnerf.backends import dispatch
from efficientnerf.backends.transfer import to_device
from efficientnerf.fields.hash import HashField
from efficientnerf.fields.mlp import MlpField
from efficientnerf.fields.nerf import NerfField
from efficientnerf.geometry.spaces import RayBundle, Space, voxel_centres
from efficientnerf.rendering.compositing import Composite, ray_of_sample
from efficientnerf.rendering.harmonics import basis, harmonics_count
from efficientnerf.sampling.occupancy import DensityVoxels, density_voxels, voxel_weights
from efficientnerf.sampling.samples import Samples, importance_samples, stratified_samples
from efficientnerf.settings import given
from efficientnerf.training.readback import SampleCapacity
from efficientnerf.training.settings import FINEST, LOG2_TABLE, TrainSettings

SKY_DEGREE = 2
COARSEST = 16
UNSEEN = 0.5  # grey: what is drawn behind a space that reaches to infinity, where nothing can lie

AnyField = HashField | MlpField | NerfField


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
    span        near and far along the view axis, world units, where the settings say between what the intervals lie
    """

    space: Space
    settings: TrainSettings
    coarse: AnyField | None
    fine: AnyField
    voxels: DensityVoxels
    sky: Sky
    background: tuple[float, float, float] | None
    step: float
    slots: int
    span: tuple[float, float] | None = None

    @property
    def prunes(self) -> bool:
        """Whether the density voxels are used."""
        return self.settings.sampling in ("efficient", "valid")

    @property
    def distortion(self) -> float:
        """Weight of the loss on spread-out densities."""
        stated = given(self.settings.distortion_loss_weight)
        return self.space.distortion_loss_weight if stated is None else stated

    @property
    def num_coarse_samples(self) -> int:
        """N_c, which `model` settles."""
        count = given(self.settings.num_coarse_samples)
        assert count is not None
        return count

    @property
    def device(self) -> torch.device:
        return self.voxels.values.device

    @property
    def proposal_field(self) -> AnyField:
        """The field whose density the voxels remember."""
        return self.fine if self.coarse is None else self.coarse

    def snapped_points(self, points: Tensor) -> Tensor:
        """Where the fields are asked for what lies at points (N, 3) in grid coordinates: there, or at the centres of voxels where the settings say so."""
        side = given(self.settings.discretise)
        return points if side is None else voxel_centres(self.space, points, side)

    def parameters(self) -> list[tuple[str, nn.Parameter]]:
        """Everything that is learned, by name, in a fixed order."""
        parts: list[tuple[str, nn.Module]] = [("fine", self.fine), ("sky", self.sky)]
        if self.coarse is not None:
            parts.insert(0, ("coarse", self.coarse))
        return [(f"{part}.{name}", p) for part, module in parts for name, p in module.named_parameters()]

    def behind(self, directions: Tensor) -> Tensor:
        """Colour (R, 3) beyond all samples."""
        if self.background is None:
            return torch.full_like(directions, UNSEEN) if self.space.reaches_infinity else self.sky(directions)
        return torch.stack([torch.full((len(directions),), value, device=directions.device) for value in self.background], dim=1)


class RayOutputs(NamedTuple):
    """What one bundle of rays met: samples of both stages, what the fields said, and whether each coarse sample was pivotal.

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
    fine_colour: Tensor
    fine_opacity: Tensor
    fine_weight: Tensor
    fine_rgb: Tensor
    distortion: Tensor


def model(
    space: Space, settings: TrainSettings, background: tuple[float, float, float] | None, device: str = "cpu", span: tuple[float, float] | None = None
) -> Model:
    """An untrained model; the same settings give the same numbers."""
    coarse_samples = given(settings.num_coarse_samples) or space.num_coarse_samples
    settings = replace(settings, num_coarse_samples=coarse_samples)
    generator = torch.Generator().manual_seed(settings.seed)
    coarse, fine = _fields(settings, generator)
    if settings.far_plane != "auto" and (span is None or space.contracted):
        raise ValueError("train.near_plane and train.far_plane need a scene on a constant background. Leave them auto.")
    span = span if settings.far_plane != "auto" else None
    step = space.sampled_length(span) / coarse_samples
    slots = space.max_intervals(step)
    side = given(settings.occupancy_resolution) or space.occupancy_resolution
    # A valid voxel absorbs `voxel_absorption` of the light over one coarse interval.
    absorption = given(settings.occupancy_alpha_threshold)
    if absorption is None:
        absorption = space.occupancy_alpha_threshold
    threshold = -math.log1p(-min(absorption, 0.999)) / step if settings.occupancy_rule == "maximum" else 0.0
    voxels = density_voxels(
        side,
        settings.occupancy_rule,
        initial=settings.occupancy_initial_density,
        beta=settings.occupancy_beta,
        decay=settings.occupancy_decay,
        threshold=threshold,
        device=device,
    )
    return Model(space, settings, None if coarse is None else coarse.to(device), fine.to(device), voxels, Sky().to(device), background, step, slots, span)


def _fields(s: TrainSettings, generator: torch.Generator) -> tuple[AnyField | None, AnyField]:
    """The coarse field, if there is one, and the fine one, untrained."""
    log2_table, finest = given(s.log2_hashmap_size) or LOG2_TABLE, given(s.finest_resolution) or FINEST
    if s.field == "hash":
        return None if s.coarse == "voxels" else HashField(
            levels=max(1, s.num_levels // 2), log2_table=max(8, log2_table - 2), coarsest=COARSEST, finest=max(COARSEST, finest // 4),
            hidden=s.coarse_hidden_dim, layers=s.coarse_num_layers, degree=0, initial_density=s.initial_density, generator=generator, precision=s.precision,
        ), HashField(
            levels=s.num_levels, log2_table=log2_table, coarsest=COARSEST, finest=finest,
            hidden=s.hidden_dim, layers=s.num_layers, degree=s.sh_degree, initial_density=s.initial_density, generator=generator, precision=s.precision,
        )  # fmt: skip
    if s.field == "nerf":
        return (
            NerfField(hidden=s.coarse_hidden_dim, layers=s.coarse_num_layers, generator=generator, precision=s.precision),
            NerfField(hidden=s.hidden_dim, layers=s.num_layers, generator=generator, precision=s.precision),
        )
    return (
        MlpField(hidden=s.coarse_hidden_dim, layers=s.coarse_num_layers, degree=s.sh_degree, generator=generator, precision=s.precision),
        MlpField(hidden=s.hidden_dim, layers=s.num_layers, degree=s.sh_degree, generator=generator, precision=s.precision),
    )


def render_rays(
    m: Model, origins: Tensor, directions: Tensor, near: Tensor, far: Tensor, offset: Tensor, behind: Tensor, *,
    prune: bool = True, rng: np.random.Generator | None = None, room: SampleCapacity | None = None, fine_samples: int = 0,
) -> RayOutputs:  # fmt: skip
    """Both stages along a bundle of rays: valid samples through the coarse field, pivotal ones through the fine one, or as `settings.sampling` says.

    origins, directions  (R, 3) world frame, unit directions
    near, far, offset    (R,) distances, and the offset of the samples in their intervals
    behind               (R, 3) colour beyond all samples
    prune                whether the density voxels are heeded (not in the warm-up)
    rng                  in training: samples by importance are jittered, some rays are looked at whole where the settings say so, and a random
                         share of the valid intervals is looked at by the fine field too. Without that the fine field would be
                         free to put matter where this ray has no pivot and another has one, and the baked asset, which has no coarse
                         stage to hide it, would show it.
    room                 on CUDA: samples are padded to this many at most, and their number is not waited for
    fine_samples         N_s of this bundle; 0: as the settings say
    """
    fine_samples = fine_samples or m.settings.samples_per_pivot
    rays = m.space.rays(origins, directions, near, far)
    bundle = (rays.origins, rays.directions, rays.near, rays.far)
    if m.settings.sampling == "uniform":
        count = m.num_coarse_samples + m.settings.num_importance_samples
        samples, _ = _even_samples(m, *bundle, offset, count, rng, None if room is None else room.fine)
        raw, out = _seen(m, m.fine, directions, samples, behind)
        nothing = samples.start[:0]
        none = Samples(torch.zeros_like(samples.first), nothing, nothing, nothing, samples.point[:0], samples.tried)
        return RayOutputs(rays, none, raw[:0], out.weight[:0], None, torch.zeros(0, dtype=torch.bool, device=raw.device), samples, raw, *_summed(out, 0.0))
    for_coarse, for_fine = (None, None) if room is None else room
    if m.settings.sampling == "hierarchical":
        coarse, at = _even_samples(m, *bundle, offset, m.num_coarse_samples, rng, for_coarse)
    else:
        coarse, at = _valid_samples(m, *bundle, offset, prune=prune, rng=rng, capacity=for_coarse), None
    if m.coarse is None:
        return _looked_by_voxels(m, rays, directions, offset, behind, coarse, prune=prune, rng=rng, capacity=for_fine, fine_samples=fine_samples)
    coarse_raw, seen = _seen(m, m.coarse, directions, coarse, behind)
    weight = seen.weight.detach()
    pivotal = dispatch.select_pivots(weight, coarse.first, m.settings.pivotal_threshold, m.settings.max_pivots)
    if m.settings.sampling == "efficient":
        if rng is not None and m.settings.exploration_fraction > 0:
            pivotal = pivotal | _chance(len(pivotal), m.settings.exploration_fraction, rng, pivotal.device)
        fine = dispatch.pivotal_samples(m.space, *bundle[:2], offset, coarse, pivotal, fine_samples, for_fine)
    else:
        quantile = _strata(len(origins), m.settings.num_importance_samples, rng, offset.device)
        at = coarse.start + offset[ray_of_sample(coarse.first, len(coarse.start))] * coarse.extent if at is None else at
        fine = importance_samples(m.space, *bundle[:2], coarse, at, weight, quantile, for_fine)
    fine_raw, out = _seen(m, m.fine, directions, fine, behind)
    return RayOutputs(rays, coarse, coarse_raw, seen.weight, seen.colour, pivotal, fine, fine_raw, *_summed(out, seen.distortion))


def _looked_by_voxels(
    m: Model, rays: RayBundle, directions: Tensor, offset: Tensor, behind: Tensor, coarse: Samples, *, prune: bool, rng: np.random.Generator | None,
    capacity: int | None, fine_samples: int,
) -> RayOutputs:  # fmt: skip
    """Pivots by what the density voxels hold, without a coarse field; while nothing is pruned, all intervals, with one sample each."""
    weight = voxel_weights(m.voxels, coarse.point, coarse.length, coarse.first)
    if prune:
        pivotal = dispatch.select_pivots(weight, coarse.first, m.settings.pivotal_threshold, m.settings.max_pivots)
        if rng is not None and m.settings.exploration_fraction > 0:
            pivotal = pivotal | _chance(len(pivotal), m.settings.exploration_fraction, rng, pivotal.device)
        fine = dispatch.pivotal_samples(m.space, rays.origins, rays.directions, offset, coarse, pivotal, fine_samples, capacity)
    else:
        pivotal, fine = torch.ones(len(weight), dtype=torch.bool, device=weight.device), coarse
    fine_raw, out = _seen(m, m.fine, directions, fine, behind)
    return RayOutputs(rays, coarse, fine_raw[:0], weight, None, pivotal, fine, fine_raw, *_summed(out, 0.0))


def _chance(count: int, share: float, rng: np.random.Generator, device: torch.device) -> Tensor:
    """(count,) bool, about `share` of them; drawn on the device where there is one, since sending them takes longer."""
    if device.type == "cuda":
        generator = torch.Generator(device).manual_seed(int(rng.integers(2**62)))
        return torch.rand(count, generator=generator, device=device) < share
    return torch.from_numpy(rng.random(count, np.float32) < share)


def _seen(m: Model, field: AnyField, directions: Tensor, samples: Samples, behind: Tensor) -> tuple[Tensor, Composite]:
    """What a field says at samples (N, 1 + 3K), and how it looks along their rays."""
    point = m.snapped_points(samples.point)
    if isinstance(field, NerfField):
        raw = field(point, directions[ray_of_sample(samples.first, len(samples.start))])
        harmonics = torch.ones_like(directions[:, :1])  # the colour is what the network says
    else:
        raw, harmonics = field(point), basis(directions, field.degree)
    return raw, dispatch.composite(raw, samples.length, samples.first, harmonics, behind, field.activation)


def _summed(out: Composite, coarse_distortion: Tensor | float) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """The last five entries of a Look."""
    return out.colour, out.opacity, out.weight, out.sample_colour, out.distortion + coarse_distortion


def _valid_samples(
    m: Model, origins: Tensor, directions: Tensor, near: Tensor, far: Tensor, offset: Tensor, *, prune: bool, rng: np.random.Generator | None,
    capacity: int | None,
) -> Samples:  # fmt: skip
    """Coarse samples where the voxels say that something is; of the first rays, which are as random as any, all, where the settings say so."""
    threshold = m.voxels.threshold if prune else -math.inf
    whole = math.ceil(m.settings.occupancy_update_ray_fraction * len(origins)) if rng is not None else 0
    bundle = (origins, directions, near, far, offset)
    return dispatch.valid_samples(m.space, *bundle, m.step, m.slots, m.voxels.values, threshold, capacity, whole=whole)


def _even_samples(
    m: Model, origins: Tensor, directions: Tensor, near: Tensor, far: Tensor, offset: Tensor, count: int, rng: np.random.Generator | None,
    capacity: int | None,
) -> tuple[Samples, Tensor]:  # fmt: skip
    """`count` stratified samples between near and far, or between where the ray enters the box and leaves it; their distances (N,)."""
    if m.space.contracted:  # intervals that grow with the distance, all of them
        step = m.step * m.num_coarse_samples / count
        slots = math.ceil(m.slots * count / m.num_coarse_samples)
        samples = dispatch.valid_samples(m.space, origins, directions, near, far, offset, step, slots, m.voxels.values, -math.inf, capacity)
        return samples, samples.start + offset[ray_of_sample(samples.first, len(samples.start))] * samples.extent
    if m.span is None:
        near, far = m.space.clip(origins, directions, near, far)
    jitter = offset[:, None].expand(-1, count)
    if rng is not None:
        jitter = to_device(torch.from_numpy(rng.random((len(origins), count), np.float32)), offset.device)
    return stratified_samples(m.space, origins, directions, near, far, jitter, outside=m.settings.field != "hash", capacity=capacity)


def _strata(rays: int, count: int, rng: np.random.Generator | None, device: torch.device) -> Tensor:
    """(rays, count) quantiles, one in each of `count` equal parts of [0, 1]: random in training, the middles in rendering."""
    within = torch.full((rays, count), 0.5) if rng is None else torch.from_numpy(rng.random((rays, count), np.float32))
    return to_device((torch.arange(count) + within) / count, device)


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
