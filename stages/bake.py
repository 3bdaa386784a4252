"""The bake stage: a trained field in, the asset out.

    asset.nerftree  see efficientnerf/asset/FORMAT.md
    report.json     resolution and what decided it, voxels, bytes; PSNR of a sample of the training pixels before and after the optimisation

What takes long is kept in the scratch folder: what the network shows of the voxels, each block of baked values, and the state of the optimisation.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from msgspec import Meta

from efficientnerf.settings import Auto, Count, Fraction, NonNegative, PositiveInt, Seed, given, setting
from pipeline.files import atomic
from pipeline.stage import Job, Stage
from stages.artifacts import BakeInputs, BakeOutputs, inputs_of, needs_of
from stages.compiling import compiling_kernels
from stages.cores import use_all_cores

if TYPE_CHECKING:
    from efficientnerf.asset.bake import Visible
    from efficientnerf.geometry.spaces import Space
    from efficientnerf.training.pixels import Pixels
    from stages.baking.resolution import Choice
    from stages.framing.forward_facing import ForwardFacing
    from stages.io.scene import Scene


@dataclass(frozen=True)
class BakeSettings:
    """How finely the field is baked."""

    resolution: Annotated[int, Meta(ge=1, le=4096)] | Auto = setting(
        "auto", "Voxels along the longest side of the box; auto: train.discretise, or as many as max_mib holds and the images resolve."
    )
    lookup: Literal["trilinear", "nearest"] = setting(
        "trilinear", "Value of a point in the asset: interpolated from the voxels around it (trilinear), or that of its own voxel (nearest).", advanced=True
    )
    max_resolution: Annotated[int, Meta(ge=32, le=4096)] | Auto = setting(
        "auto", "Most voxels along the longest side where resolution is auto; auto: 384 in contracted scenes, else 1024.", advanced=True
    )
    ndc_voxel_depth: Annotated[float, Meta(ge=1.0, le=8.0)] | Auto = setting(
        "auto", "Depth of a voxel over its width, in normalised device coordinates; auto: 2, or 1 with train.discretise.", advanced=True
    )
    brick_size: Annotated[int, Meta(ge=1, le=16)] = setting(4, "Voxels D_f along a side of a coarse cell of the NerfTree.", advanced=True)
    visibility_rays: Annotated[int, Meta(ge=1000)] = setting(
        1_000_000, "Training pixels that the field is rendered for, to find the visible voxels.", advanced=True
    )
    weight_threshold: Fraction = setting(1e-3, "A voxel is kept where its weight in some pixel exceeds this.", advanced=True)
    max_mib: PositiveInt | Auto = setting(
        "auto",
        "Largest size of the asset: resolution auto follows from it, and voxels of least weight are dropped to keep to it; auto: 24, or 36 bytes for each pixel"
        " of a forward-facing capture, from 24 to 56.",
        unit="MiB",
    )
    layout: Literal["compact", "small", "sparse"] = setting(
        "compact", "How voxels are stored: codes of 8 bits (compact), a coarser palette of half the bytes (small), or 16-bit floats (sparse)."
    )
    dilate: Annotated[int, Meta(ge=0, le=8)] = setting(1, "Voxels by which the visible ones are dilated.", advanced=True)
    min_component: Fraction = setting(
        0.02,
        "Size below which connected components that the box cuts off are dropped in unbounded scenes, as a fraction of the largest one's voxels; a hundredth"
        " of this applies to all components.",
        advanced=True,
    )
    samples_per_voxel: Annotated[int, Meta(ge=1, le=256)] = setting(
        8, "Jittered points averaged in a voxel; its centre alone where train.discretise has the same voxels.", advanced=True
    )
    seed: Seed = setting(0, "Seed of the jitter and of the rays of the refinement.", advanced=True)
    refine_steps: Count | Auto = setting(
        "auto",
        "Steps in which the baked values are refined on the training images; auto: five rays for each voxel, at least 320 steps, or 160 in unbounded scenes.",
        advanced=True,
    )
    refine_rays_per_batch: Annotated[int, Meta(ge=1, le=1 << 22)] = setting(32768, "Rays in a step of the refinement.", advanced=True)
    density_lr: NonNegative = setting(0.3, "Learning rate of the refinement for the logarithm of a voxel's optical thickness.", advanced=True)
    sh_lr: NonNegative = setting(0.03, "Learning rate of the refinement for the spherical harmonics.", advanced=True)
    view_dependent_lr_ratio: Fraction | Auto = setting(
        "auto", "Ratio of the learning rate of view-dependent harmonics to sh_lr; auto: 1 for objects with alpha, 0.2 in unbounded scenes.", advanced=True
    )
    lr_final_ratio: Fraction = setting(0.3, "Ratio to which the learning rates of the refinement fall exponentially.", advanced=True)
    licence: str = setting("", "Licence text to write into the asset.")


@compiling_kernels
def run(job: Job) -> None:
    from efficientnerf.asset import bake, format, serialisation
    from efficientnerf.asset.refinement import Targets
    from efficientnerf.asset.tree import tree_from_voxels
    from stages.baking.memory import refuse_more_than_fits
    from stages.baking.refinement import optimised
    from stages.baking.resolution import budget_of
    from stages.evaluate import constant_background
    from stages.io import scene
    from stages.io.field_file import load_renderer
    from stages.training.data import pixels_of

    settings: BakeSettings = job.settings
    use_all_cores()
    m = load_renderer(job.inputs["train"], job.device).model
    if m.settings.field == "nerf":
        from pipeline.errors import UsageError

        raise UsageError("train.field=nerf: its colours depend on the direction inside the network, which can't be baked. Use mlp or hash, or --until train.")
    s = scene.load(job.inputs["poses"])
    space, mib = _voxel_space(job, m), budget_of(s, given(settings.max_mib))
    bounds = space.bounds
    low = np.asarray(bounds[0], np.float64)
    pixels = pixels_of(job.inputs["poses"], scene.views_of(s, "train"))
    choice, seen, indices = _chosen(job, m, s, pixels, space, mib)
    resolution = choice.resolution
    indices = _seen_by_enough(m, s, indices, resolution)
    if settings.lookup == "nearest" and m.settings.discretise not in ("off", resolution):
        job.warn(f"bake.resolution={resolution}, but the field was trained on train.discretise={m.settings.discretise}: on other voxels than are baked")
    if not len(indices):
        from pipeline.errors import StageFailed

        found = "no voxel of the box contributes to any training image"
        raise StageFailed(f"bake: the trained field is empty: {found}. Train longer, or check the box (poses.crop_box).")
    refuse_more_than_fits(len(indices), (m.fine.degree + 1) ** 2, resolution, mib)
    shape, voxel = bake.grid_of(bounds, resolution, settings.brick_size)
    job.say(f"{resolution} voxels along the longest side ({choice.why}); {len(indices):,} voxels are baked")
    points = 0 if m.settings.discretise == resolution and space is m.space else settings.samples_per_voxel
    facts = metadata_of(s, settings, m)
    plain = constant_background(s)
    if plain is None:
        targets = Targets(pixels, None, seen.chosen, seen.before, seen.behind)
    else:
        targets = Targets(pixels, plain, infinite=s.background is None)
    most = serialisation.most_voxels(mib * 2**20, settings.layout, m.fine.degree, shape, settings.brick_size)
    # The raw values go in without a name here: they are large, and not needed once the fitting has its own.
    tree, fitted = optimised(
        job,
        tree_from_voxels(
            shape, voxel, low, indices, *_values(job, m, indices, voxel, low, points, space),
            brick=settings.brick_size, background=s.background, metadata=facts, ndc=space.ndc, lookup=settings.lookup,
        ),
        targets, most,
    )  # fmt: skip
    provenance = {**facts["provenance"], "sources": sources_of(job), "metrics": {"training_psnr": fitted["psnr_after"]}}
    format.save(tree.with_metadata(provenance=provenance), BakeOutputs(job.out).asset, settings.layout)
    size = BakeOutputs(job.out).asset.stat().st_size
    report = {"resolution": list(tree.resolution), "voxels": len(tree.density_values), "bricks": len(tree.voxel_index), "bytes": size, "optimisation": fitted}
    report |= {"voxels_along_longest_side": resolution, "resolution_decided_by": choice.why, "max_mib": mib}
    BakeOutputs(job.out).report.write_text(json.dumps(report, indent=1, sort_keys=True) + "\n", encoding="utf-8")


def sources_of(job: Job) -> dict[str, str]:
    """SHA-256 of what the asset was made from: the cameras, and the network."""
    from pipeline.hashes import sha256_of

    inputs = inputs_of(BakeInputs, job.inputs)
    return {path.name: sha256_of(path) for path in (inputs.poses.scene, inputs.train.field)}


def metadata_of(s: Scene, settings: BakeSettings, m: Any) -> dict[str, Any]:
    """What the bare asset must know to be used without its run."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        tool = version("efficientnerf")
    except PackageNotFoundError:
        tool = "unknown"
    similarity, orbit = s.world_from_capture, s.orbit
    return {
        "world_from_capture": {
            "scale": float(similarity.scale),
            "rotation": np.asarray(similarity.rotation, np.float64).tolist(),
            "translation": np.asarray(similarity.translation, np.float64).tolist(),
        },
        "orbit": {
            "centre": [float(x) for x in orbit.centre],
            "radius": float(orbit.radius),
            "elevation": float(orbit.elevation),
            "forward_facing": bool(orbit.forward_facing),
            "heading": float(orbit.heading),
        },
        "metric": bool(s.metric),
        **({} if s.forward is None else {"spiral": spiral_of(s.forward)}),
        "licence": settings.licence,
        "provenance": {
            "tool": f"efficientnerf {tool}",
            "kind": s.kind,
            "training_views": sum(v.split == "train" for v in s.views),
            "iterations": m.settings.iterations,
        },
    }


def spiral_of(forward: ForwardFacing) -> dict[str, Any]:
    """What a camera path before a forward-facing scene has to know; see FORMAT.md."""
    return {
        "radii": [float(x) for x in forward.radii],
        "focus": float(forward.focus),
        "tangents": [float(x) for x in forward.tangents],
        "far": float(forward.far),
    }


def _voxel_space(job: Job, m: Any) -> Space:
    """The network's space, in a frame where voxels are cubes."""
    from efficientnerf.geometry.spaces import NdcSpace

    depth, discretise, space = given(job.settings.ndc_voxel_depth), given(m.settings.discretise), m.space
    if not isinstance(space, NdcSpace):
        if depth is not None:
            job.warn("bake.ndc_voxel_depth is for scenes in normalised device coordinates, which this is none of: voxels are cubes")
        return m.space
    if depth is None:
        depth = 1.0 if discretise else space.voxel_depth
    elif discretise and depth != 1:
        job.warn(f"bake.ndc_voxel_depth={depth:g}, but the field was trained on train.discretise={discretise}: on other voxels than are baked")
    return space if depth == 1 else space.with_voxel_depth(depth)


SPARE = 2  # so many times the voxels that there is room for are baked at most: the tree itself then shows which of them matter
# And so many at a resolution that is chosen: few of the grown voxels show. More are too many where the budget is large: chair_200 in 1 MiB with 1.7 times
# 35.4 dB, 2.4: 36.2; but chair_800 in 24 MiB with 1.4 times 31.9 dB, 2.4: 31.8.
DENSE = 1.7


def _chosen(job: Job, m: Any, s: Scene, pixels: Pixels, space: Space, mib: int) -> tuple[Choice, Visible, np.ndarray]:
    """The resolution, what the network shows, and the coordinates of the voxels to bake."""
    from efficientnerf.asset import bake, serialisation
    from stages.baking.resolution import Choice, affordable_resolution, finest_resolution

    settings: BakeSettings = job.settings
    bounds, brick = space.bounds, settings.brick_size

    def room(resolution: int) -> int:
        shape, _ = bake.grid_of(bounds, resolution, brick)
        return serialisation.most_voxels(mib * 2**20, settings.layout, m.fine.degree, shape, brick)

    stated: int | None = given(settings.resolution)
    discretise: int | None = given(m.settings.discretise)
    if (fixed := stated or discretise) is not None:
        choice = Choice(fixed, "bake.resolution" if stated else "train.discretise")
        shape, voxel = bake.grid_of(bounds, choice.resolution, brick)
        seen = _seen(job, m, pixels, shape, voxel, np.asarray(bounds[0], np.float64), space)
        return choice, seen, _kept(job, seen, shape, SPARE * room(choice.resolution))

    finest = finest_resolution(s, given(settings.max_resolution))
    top_shape, top_voxel = bake.grid_of(bounds, finest.resolution, brick)
    seen = _seen(job, m, pixels, top_shape, top_voxel, np.asarray(bounds[0], np.float64), space)
    last: tuple[int, Visible, np.ndarray] | None = None

    def look(resolution: int) -> tuple[int, Visible, np.ndarray]:
        nonlocal last
        if last is None or last[0] != resolution:
            last = None
            job.safe_point()
            shape, voxel = bake.grid_of(bounds, resolution, brick)
            coarse = seen if resolution == finest.resolution else bake.coarsened(seen, top_shape, top_voxel, shape, voxel, brick, settings.weight_threshold)
            last = resolution, coarse, bake.chosen_voxels(coarse, shape, brick, settings.weight_threshold, settings.dilate)
        return last

    choice = affordable_resolution(finest, lambda at: len(look(at)[2]), lambda at: int(DENSE * room(at)))
    _, coarse, indices = look(choice.resolution)
    most = SPARE * room(choice.resolution)
    if len(indices) > most:
        indices = _kept(job, coarse, bake.grid_of(bounds, choice.resolution, brick)[0], most)
    return choice, coarse, indices


def _seen(job: Job, m: Any, pixels: Pixels, shape: tuple[int, int, int], voxel: float, low: np.ndarray, space: Space) -> Visible:
    """What the network shows of the voxels, from scratch or from an earlier attempt."""
    from efficientnerf.asset import bake

    settings: BakeSettings = job.settings
    names = ("cells", "greatest", "chosen", "before", "behind")
    stored = {name: part for name in names if (part := _read_npy(job.work / f"seen_{name}.npy")) is not None}
    if len(stored) == len(names):
        # What is not known of a space that ends with the box is kept as an empty array.
        return bake.Visible(**{name: None if name in ("before", "behind") and not len(part) else part for name, part in stored.items()})  # type: ignore[arg-type]

    def looked(done: int, total: int) -> None:
        job.progress(done, total, "finding the voxels that matter")
        job.safe_point()

    seen = bake.visible_voxels(m, pixels, shape, voxel, low, settings.brick_size, settings.visibility_rays, looked, space)
    for name in names:
        part = getattr(seen, name)
        _write_npy(np.empty(0, np.float16) if part is None else part, job.work / f"seen_{name}.npy")
    return seen


def _kept(job: Job, seen: Visible, shape: tuple[int, int, int], most: int) -> np.ndarray:
    """Coordinates of the voxels to bake: not many more than `most`, and then those of greatest weight."""
    from efficientnerf.asset import bake

    settings: BakeSettings = job.settings
    threshold = settings.weight_threshold
    indices = bake.chosen_voxels(seen, shape, settings.brick_size, threshold, settings.dilate)
    weights = np.sort(seen.greatest[seen.greatest > threshold])
    while len(indices) > most and len(weights) > 1:
        job.safe_point()
        # Grown voxels are about in proportion to the kept ones; a little less, so that this ends soon.
        weights = weights[-max(1, int(0.95 * len(weights) * most / len(indices))) :]
        indices = bake.chosen_voxels(seen, shape, settings.brick_size, float(weights[0]), settings.dilate)
    return indices


CENTRES = 2**20  # that are looked for in the pictures at once


def _seen_by_enough(m: Any, s: Scene, indices: np.ndarray, resolution: int) -> np.ndarray:
    """The voxels that as many photographs have in view as training asked for, where surroundings are learned: its own voxels, which it closed to
    matter elsewhere (`stages.framing.view_coverage`), are larger, and what they hold sticks out as a rim."""
    from stages.framing.view_coverage import has_min_views
    from stages.io import scene

    if not m.space.contracted or m.settings.min_views == "off":
        return indices
    cameras = [view.camera for view in scene.views_of(s, "train")]
    low, high = np.asarray(m.space.bounds, np.float64)
    voxel = float((high - low).max()) / resolution
    parts = (indices[at : at + CENTRES] for at in range(0, len(indices), CENTRES))
    keep = [has_min_views((part + 0.5) * voxel + low, cameras, m.settings.min_views) for part in parts]
    return indices[np.concatenate(keep)] if keep else indices


def _values(job: Job, m: Any, indices: np.ndarray, voxel: float, low: np.ndarray, points: int, space: Space) -> tuple[np.ndarray, np.ndarray]:
    """Baked values of all voxels; blocks of an earlier attempt are taken as they are."""
    from efficientnerf.asset import bake

    settings: BakeSettings = job.settings
    blocks, harmonics = bake.blocks_of(len(indices), points), (m.fine.degree + 1) ** 2
    density, sh = np.empty(len(indices), np.float32), np.empty((len(indices), harmonics, 3), np.float32)
    done = rows = 0

    def take(part: np.ndarray) -> None:
        nonlocal done, rows
        density[rows : rows + len(part)] = part[:, 0]
        sh[rows : rows + len(part)] = part[:, 1:].reshape(len(part), harmonics, 3)
        done, rows = done + 1, rows + len(part)

    while done < blocks and (stored := _read_npy(job.work / f"block_{done:06d}.npy")) is not None:
        take(stored)
    for some, colours in bake.voxel_values(m, indices, voxel, low, points, settings.seed, first=done, space=space):
        part = np.concatenate([some[:, None], colours.reshape(len(some), -1)], axis=1)
        _write_npy(part, job.work / f"block_{done:06d}.npy")
        take(part)
        job.progress(done, blocks, "baking voxels")
        job.safe_point()
    return density, sh


def _write_npy(values: np.ndarray, path: Path) -> None:
    with atomic(path, durable=False) as temporary, open(temporary, "wb") as file:
        np.save(file, values, allow_pickle=False)


def _read_npy(path: Path) -> np.ndarray | None:
    try:
        return np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError):
        return None


STAGE = Stage(name="bake", version=4, settings=BakeSettings, needs=needs_of(BakeInputs), run=run)
