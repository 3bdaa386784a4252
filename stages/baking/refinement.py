"""Refinement in the bake stage: the baked values are fitted to the training images, and voxels that do not show are dropped.

Half of the steps are taken with all voxels that were baked. Then the tree is rendered along many training rays: voxels that hardly contribute to any
of them are dropped (floaters have faded by then), and of the others those of least weight, as far as the asset's size demands. The other half of
the steps corrects for what is missing. An interrupted refinement goes on from its checkpoint.
"""

from __future__ import annotations

import hashlib
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from efficientnerf.settings import given
from pipeline.files import atomic, exists, remove
from pipeline.stage import Job
from stages.baking.holes import find_holes, voxels_of_holes
from stages.scratch import opened, unusable

if TYPE_CHECKING:
    from efficientnerf.asset.field_samples import FieldSamples
    from efficientnerf.asset.refinement.state import RefinementState
    from efficientnerf.asset.refinement.targets import Targets
    from efficientnerf.asset.tree import NerfTree
    from stages.bake import BakeSettings

CHECKPOINT = "refinement.safetensors"
CHECKPOINT_SECONDS = 30.0
ERROR_RAYS = 2**16  # training pixels that the report's PSNR is measured on
# Training rays per voxel that are rendered to see which voxels show, at least bake.visibility_rays; in normalised device coordinates, where no ray
# misses and each meets many voxels, fewer. docs/experiments/refinement.md
RAYS_PER_VOXEL, NDC_RAYS_PER_VOXEL = 1.0, 0.25
# docs/experiments/refinement.md
MIN_STEPS, STEP_RAYS_PER_VOXEL, UNBOUNDED_STEPS = 320, 5, 160  # see `refinement_steps`
UNBOUNDED_VIEW_DEPENDENT_LR_RATIO = 0.2  # bake.view_dependent_lr_ratio without a constant background


@dataclass(frozen=True)
class Pruned:
    """That voxels were dropped, and of whole scenes the shares of the rays that end in holes.

    without   after voxels were dropped
    restored  after `voxels` of them were restored
    """

    without: float = 0.0
    restored: float = 0.0
    voxels: int = 0

    def report(self) -> dict[str, Any]:
        return {"pruned": round(self.without, 6), "restored": round(self.restored, 6), "voxels_restored": self.voxels}


def refined(job: Job, tree: NerfTree, targets: Targets, most: int, samples: FieldSamples | None = None) -> tuple[NerfTree, dict[str, Any]]:
    """The refined tree with at most `most` voxels, and the entries of the report.

    samples  of the field, for whole scenes: what was dropped wrongly is restored by them
    """
    from efficientnerf.asset.refinement import fit
    from efficientnerf.asset.refinement.state import MAX_INITIAL_THICKNESS, initial_state

    settings = job.settings
    steps = refinement_steps(settings, min(len(tree.density_values), most), tree.background is not None)
    report: dict[str, Any] = {"steps": steps, "psnr_before": None, "psnr_after": None, "voxels_baked": len(tree.density_values)}
    sample = min(ERROR_RAYS, 4 * len(targets.pixels))
    targets = targets_on_device(job, tree, targets)
    before = fit.error(tree, targets, sample, settings.seed)
    most_thick = MAX_INITIAL_THICKNESS if steps else math.inf
    state, pruned = _restored(job, tree, steps) or (initial_state(tree, most_thick), None)
    baked = None if samples is None or pruned is not None else initial_state(replace(tree, harmonics=tree.sh[:, :0]), most_thick).density
    del tree  # the state has values of its own
    if pruned is None:
        _take_steps(job, state, targets, steps, steps // 2, None)
        state, pruned = _prune(job, state, targets, most, samples, baked)
        _save_checkpoint(job, state, pruned)
    _take_steps(job, state, targets, steps, steps, pruned)
    state.to_host()
    tree = state.tree
    report["psnr_before"], report["psnr_after"] = _psnr(before), _psnr(fit.error(tree, targets, sample, settings.seed))
    if samples is not None:
        report["holes"] = {**pruned.report(), "refined": round(find_holes(job, tree, samples)[1], 6)}
        job.say(f"holes, where the field is opaque and the asset is not: {report['holes']['pruned']:.2%} of the rays after the first half of the refinement,"
                f" {report['holes']['restored']:.2%} with {pruned.voxels:,} voxels restored, {report['holes']['refined']:.2%} at the end")  # fmt: skip
    return tree, report


def targets_on_device(job: Job, tree: NerfTree, targets: Targets) -> Targets:
    """The targets on the run's device, where the tree is then fitted; on the host where the device's memory is too small."""
    from efficientnerf.asset.cascades import cascades_of
    from stages.baking.memory import free_on_device, needed_on_device

    cells = sum(cascade.brick_index.size for cascade in cascades_of(tree))
    needed = needed_on_device(len(tree.density_values), tree.harmonics_count, len(tree.voxel_index), cells, tree.brick)
    needed += len(tree.density_values) * bool(tree.outer)  # the cascade of each voxel
    if targets.pixels.images is not None:
        needed += targets.pixels.images.nbytes
    if job.device == "cpu" or needed <= (free := free_on_device(job.device)):
        return targets.to(job.device)
    job.warn(
        f"refining {len(tree.density_values):,} voxels needs about {needed / 2**30:.1f} GiB on the device; {free / 2**30:.1f} are free there:"
        " they are refined on the CPU, which takes longer (lower bake.max_mib or bake.resolution for the device)"
    )
    return targets


def _psnr(error: float) -> float:
    return round(-10 * math.log10(max(error, 1e-10)), 3)


def refinement_steps(settings: BakeSettings, voxels: int, constant_background: bool) -> int:
    """Steps of the refinement of so many voxels, of a scene with a constant background or without one."""
    if (stated := given(settings.refine_steps)) is not None:
        return stated
    steps = max(MIN_STEPS, math.ceil(STEP_RAYS_PER_VOXEL * voxels / settings.refine_rays_per_batch))
    return steps if constant_background else UNBOUNDED_STEPS


def _take_steps(job: Job, state: RefinementState, targets: Targets, steps: int, until: int, pruned: Pruned | None) -> None:
    """Take steps up to `until` of `steps`, with checkpoints on the way and where it is stopped."""
    from efficientnerf.asset.refinement import fit

    settings = job.settings
    ratio = given(settings.view_dependent_lr_ratio)
    written, smooth = time.monotonic(), 0.0
    if ratio is None:
        ratio = UNBOUNDED_VIEW_DEPENDENT_LR_RATIO if state.tree.background is None else 1.0
    run = fit.optimise(
        state, targets, until=until, steps=steps, rays=settings.refine_rays_per_batch, density_lr=settings.density_lr, sh_lr=settings.sh_lr,
        lr_final_ratio=settings.lr_final_ratio, seed=settings.seed, view_dependent_lr_ratio=ratio,
    )  # fmt: skip
    for error in run:
        smooth = error if not smooth else 0.9 * smooth + 0.1 * error
        job.progress(state.step, steps, "refining", psnr=round(_psnr(smooth), 2), voxels=len(state.density))
        if time.monotonic() - written > CHECKPOINT_SECONDS:
            _save_checkpoint(job, state, pruned)
            written = time.monotonic()
        try:
            job.safe_point()
        except BaseException:
            _save_checkpoint(job, state, pruned)
            raise


def _prune(
    job: Job, state: RefinementState, targets: Targets, most: int, samples: FieldSamples | None, baked: np.ndarray | None
) -> tuple[RefinementState, Pruned]:
    """Only the voxels that contribute more than bake.weight_threshold to a pixel, and of these at most `most`, those that contribute most. Of a whole scene,
    voxels without which a ray would end in a hole stay.

    baked  (N,) densities before the first step, of a whole scene
    """
    from efficientnerf.asset.cascades import subset
    from efficientnerf.asset.refinement.state import subset_state

    state.to_host()
    greatest = _greatest_weights(job, state, targets)
    keep = _heaviest(job, greatest, most)
    if not keep.any():
        return state, Pruned()
    if samples is None:
        if state.tree.background is None:
            from efficientnerf.asset.components import small_components

            keep &= ~small_components(state.tree, keep, job.settings.min_component)
        return subset_state(state, keep, subset(state.tree, keep)), Pruned()
    from efficientnerf.asset.components import unsupported_components

    assert baked is not None
    keep &= ~unsupported_components(state.tree, keep, job.settings.min_component, samples)
    holes, pruned_share = find_holes(job, subset(state.tree, keep), samples)
    needed = voxels_of_holes(state.tree, samples, holes)
    restored = needed & ~keep
    state.density[needed] = np.maximum(state.density, baked)[needed]
    keep |= restored
    over = int(keep.sum()) - most
    if over > 0:
        others = np.flatnonzero(keep & ~restored)
        keep[others[np.argsort(greatest[others], kind="stable")[:over]]] = False
    tree = subset(state.tree, keep)
    return subset_state(state, keep, tree), Pruned(pruned_share, find_holes(job, tree, samples)[1], int((restored & keep).sum()))


def _greatest_weights(job: Job, state: RefinementState, targets: Targets) -> np.ndarray:
    """(N,) the greatest contribution of each voxel to one of many training pixels."""
    from efficientnerf.asset.refinement import fit

    settings = job.settings
    per_voxel = RAYS_PER_VOXEL if state.tree.ndc is None else NDC_RAYS_PER_VOXEL
    count = min(max(settings.visibility_rays, int(per_voxel * len(state.density))), 4 * len(targets.pixels))

    def progress(done: int, total: int) -> None:
        job.progress(done, total, "rendering for voxel weights")
        job.safe_point()

    return fit.max_weights(state.tree, targets, count, settings.seed, progress)


def _heaviest(job: Job, greatest: np.ndarray, most: int) -> np.ndarray:
    """(N,) bool: voxels whose weight exceeds bake.weight_threshold, at most `most`."""
    keep = greatest > job.settings.weight_threshold
    if keep.sum() > most:
        order = np.argsort(-greatest, kind="stable")
        keep = np.zeros(len(keep), bool)
        keep[order[:most]] = True
        left_out = float(greatest[order[most]])
        job.say(f"voxels that never weigh more than {left_out:.3g} in a pixel are left out: bake.max_mib has room for {most:,}")
    return keep


def _save_checkpoint(job: Job, state: RefinementState, pruned: Pruned | None) -> None:
    from safetensors.numpy import save_file

    from efficientnerf.asset.cascades import voxel_cascades
    from efficientnerf.asset.refinement.state import STATE
    from efficientnerf.asset.tree import voxel_coordinates

    state.fetch()
    tensors = {name: np.ascontiguousarray(getattr(state, name)) for name in STATE}
    tensors["coordinates"] = voxel_coordinates(state.tree)
    if state.tree.outer:
        tensors["cascades"] = voxel_cascades(state.tree)
    tensors["progress"] = np.array([state.step, pruned is not None], np.int64)
    if pruned is not None:
        tensors["holes"] = np.array([pruned.without, pruned.restored, pruned.voxels], np.float64)
    with atomic(job.work / CHECKPOINT, durable=False) as temporary:
        save_file(tensors, str(temporary), metadata={"sha256": _digest(tensors)})


def _digest(tensors: Mapping[str, np.ndarray]) -> str:
    """SHA-256 over names, types, shapes and bytes."""
    digest = hashlib.sha256()
    for name, values in sorted(tensors.items()):
        digest.update(f"{name} {values.dtype} {values.shape}\n".encode())
        digest.update(np.ascontiguousarray(values).data)
    return digest.hexdigest()


def _restored(job: Job, tree: NerfTree, steps: int) -> tuple[RefinementState, Pruned | None] | None:
    """The state of the last checkpoint of so many steps, and what was dropped by then; None where there is none that fits the tree."""
    from efficientnerf.asset.refinement.state import MOMENTS, RefinementState

    path = job.work / CHECKPOINT
    if not exists(path):
        return None
    try:
        found = _read(path)
        kept = _check(found, tree, steps)
        step, pruned = (int(x) for x in found["progress"])
        without, restored, voxels = found["holes"].tolist() if pruned else (0.0, 0.0, 0)
        fitted = _with_values(tree, kept, np.array(found["density"]), np.array(found["sh"]))
        density, sh, visits = (np.array(found[name]) for name in MOMENTS)
        state = RefinementState(fitted, density, sh, visits, step)
    except (OSError, ValueError) as error:
        job.warn(unusable(path, error))
        remove(path)
        return None
    job.say(f"the refinement goes on from step {state.step}")
    return state, Pruned(without, restored, int(voxels)) if pruned else None


def _read(path: Path) -> dict[str, np.ndarray]:
    """The tensors of a checkpoint; ValueError or OSError where it is not as it was written."""
    from safetensors import SafetensorError, safe_open

    try:
        with opened(path), safe_open(str(path), framework="np") as file:
            found = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
            written = (file.metadata() or {}).get("sha256")
    except (SafetensorError, TypeError, AttributeError) as error:  # of a type that numpy does not have
        raise ValueError(str(error)[:80]) from None
    if _digest(found) != written:
        raise ValueError("its values are not those that its SHA-256 was made of")
    return found


def _with_values(tree: NerfTree, kept: np.ndarray, density: np.ndarray, sh: np.ndarray) -> NerfTree:
    """The tree with the voxels `kept`, places of its own, alone, and their values."""
    from efficientnerf.asset.cascades import subset

    keep = np.zeros(len(tree.density_values), bool)
    keep[kept] = True
    structure = subset(replace(tree, harmonics=tree.sh[:, :0]), keep)  # harmonics are most of the memory: none are copied
    return replace(structure, density_values=density, harmonics=sh.reshape(len(sh), -1, 3))


def _check(found: Mapping[str, np.ndarray], tree: NerfTree, steps: int) -> np.ndarray:
    """The places in the tree of the state's voxels. ValueError where the tensors are no state of a refinement of this tree, or a step in it is out of range."""
    kinds = {"density": "float32", "sh": "float32", "square_density": "float32", "square_sh": "float32", "visits": "int32"}
    count = len(found["density"]) if "density" in found and found["density"].ndim else 0
    shapes = dict.fromkeys(kinds, (count,)) | {"sh": (count, 3 * tree.harmonics_count), "coordinates": (count, 3), "progress": (2,), "cascades": (count,)}
    kinds |= {"coordinates": "int32", "progress": "int64"} | ({"cascades": "uint8"} if tree.outer else {})
    for name, kind in kinds.items():
        if name not in found or found[name].dtype != kind or found[name].shape != shapes[name]:
            raise ValueError(f"'{name}' is missing, or no {kind} {shapes[name]}")
    step, pruned = (int(x) for x in found["progress"])
    if pruned and ("holes" not in found or found["holes"].dtype != "float64" or found["holes"].shape != (3,) or not np.isfinite(found["holes"]).all()):
        raise ValueError("'holes' is missing, or no three numbers")
    low, high = (steps // 2, steps) if pruned else (0, steps // 2)
    if pruned not in (0, 1) or not low <= step <= high:
        raise ValueError(f"step {step} is not from {low} to {high}")
    place = _places(tree, found["coordinates"], found["cascades"] if tree.outer else np.zeros(count, np.uint8))
    if not count or (np.diff(place) <= 0).any() or (count < len(tree.density_values) and not pruned):
        raise ValueError("its voxels are not those that were baked, in their order")
    return place


def _places(tree: NerfTree, coordinates: np.ndarray, cascades: np.ndarray) -> np.ndarray:
    """Which voxels of the tree lie at coordinates (n, 3) of their cascades (n,); ValueError where one of them is not stored."""
    from efficientnerf.asset.cascades import cascades_of, voxel_cascades
    from efficientnerf.asset.tree import voxel_coordinates

    sizes = np.asarray([cascade.shape for cascade in cascades_of(tree)], np.int64) * tree.brick
    if (cascades >= len(sizes)).any() or (coordinates < 0).any() or (coordinates >= sizes[cascades]).any():
        raise ValueError("voxels outside of the grid")
    first = np.cumsum([0, *sizes.prod(axis=1)])

    def keys(at: np.ndarray, of: np.ndarray) -> np.ndarray:
        side = sizes[of]
        return first[of] + (at[:, 0].astype(np.int64) * side[:, 1] + at[:, 1]) * side[:, 2] + at[:, 2]

    ours, theirs = keys(voxel_coordinates(tree), voxel_cascades(tree)), keys(coordinates, cascades)
    order = np.argsort(ours)
    if not len(ours):
        raise ValueError("voxels of a tree that has none")
    place = order[np.minimum(np.searchsorted(ours, theirs, sorter=order), len(ours) - 1)]
    if not np.array_equal(ours[place], theirs):
        raise ValueError("its voxels are not those that were baked, in their order")
    return place
