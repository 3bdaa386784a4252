"""The checkpoint of a refinement in the bake's scratch folder: the state, the phase, and where its voxels lie.

What was baked gives the grids. A state's voxels are some of those that were baked: all of them before voxels are dropped for the first time.

N voxels, n voxels of the state.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from efficientnerf.asset.refinement.schedule import Phase, phase_ends
from pipeline.files import atomic, exists, remove
from pipeline.stage import Job
from stages.baking.pruning import Pruned
from stages.scratch import opened, unusable

if TYPE_CHECKING:
    from efficientnerf.asset.refinement.state import RefinementState
    from efficientnerf.asset.tree import NerfTree

CHECKPOINT = "refinement.safetensors"


@dataclass
class Point:
    """How far a refinement is.

    phase   number of the one whose steps are taken; those before it are done, and what is done after each of them
    pruned  what the last pruning dropped; None before the first
    """

    state: RefinementState
    phase: int = 0
    pruned: Pruned | None = None


def save(job: Job, point: Point) -> None:
    """Replace the checkpoint."""
    from safetensors.numpy import save_file

    from efficientnerf.asset.cascades import voxel_cascades
    from efficientnerf.asset.refinement.state import STATE
    from efficientnerf.asset.tree import voxel_coordinates

    state = point.state
    state.fetch()
    tensors = {name: np.ascontiguousarray(getattr(state, name)) for name in STATE}
    tensors["coordinates"] = voxel_coordinates(state.tree)
    if state.tree.outer:
        tensors["cascades"] = voxel_cascades(state.tree)
    tensors["progress"] = np.array([state.step, point.phase], np.int64)
    if point.pruned is not None:
        tensors["holes"] = np.array([point.pruned.without, point.pruned.restored, point.pruned.voxels], np.float64)
    with atomic(job.work / CHECKPOINT, durable=False) as temporary:
        save_file(tensors, str(temporary), metadata={"sha256": digest_of(tensors)})


def digest_of(tensors: Mapping[str, np.ndarray]) -> str:
    """SHA-256 over names, types, shapes and bytes."""
    digest = hashlib.sha256()
    for name, values in sorted(tensors.items()):
        digest.update(f"{name} {values.dtype} {values.shape}\n".encode())
        digest.update(np.ascontiguousarray(values).data)
    return digest.hexdigest()


def restored(job: Job, tree: NerfTree, phases: Sequence[Phase], steps: int) -> Point | None:
    """The last checkpoint of a refinement of this tree with these phases; None where there is none that fits, and one that does not is removed.

    tree   as it was baked
    steps  of all phases
    """
    from efficientnerf.asset.refinement.state import MOMENTS, RefinementState

    path = job.work / CHECKPOINT
    if not exists(path):
        return None
    try:
        found = _read(path)
        kept = check(found, tree, phases, steps)
        step, phase = (int(x) for x in found["progress"])
        without, again, voxels = found["holes"].tolist() if "holes" in found else (0.0, 0.0, 0)
        fitted = _with_values(tree, kept, np.array(found["density"]), np.array(found["sh"]))
        density, sh, visits = (np.array(found[name]) for name in MOMENTS)
        state = RefinementState(fitted, density, sh, visits, step)
    except (OSError, ValueError) as error:
        job.warn(unusable(path, error))
        remove(path)
        return None
    job.say(f"the refinement goes on from step {state.step}")
    return Point(state, phase, Pruned(without, again, int(voxels)) if "holes" in found else None)


def _read(path: Path) -> dict[str, np.ndarray]:
    """The tensors of a checkpoint; ValueError or OSError where it is not as it was written."""
    from safetensors import SafetensorError, safe_open

    try:
        with opened(path), safe_open(str(path), framework="np") as file:
            found = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
            written = (file.metadata() or {}).get("sha256")
    except (SafetensorError, TypeError, AttributeError) as error:  # of a type that numpy does not have
        raise ValueError(str(error)[:80]) from None
    if digest_of(found) != written:
        raise ValueError("its values are not those that its SHA-256 was made of")
    return found


def _with_values(tree: NerfTree, kept: np.ndarray, density: np.ndarray, sh: np.ndarray) -> NerfTree:
    """The tree with the voxels `kept`, places of its own, alone, and their values."""
    from efficientnerf.asset.cascades import subset

    keep = np.zeros(len(tree.density_values), bool)
    keep[kept] = True
    structure = subset(replace(tree, harmonics=tree.sh[:, :0]), keep)  # harmonics are most of the memory: none are copied
    return replace(structure, density_values=density, harmonics=sh.reshape(len(sh), -1, 3))


def check(found: Mapping[str, np.ndarray], tree: NerfTree, phases: Sequence[Phase], steps: int) -> np.ndarray:
    """The places in the tree of the state's voxels. ValueError where the tensors are no state of a refinement of this tree, or a step in it is out of range."""
    kinds = {"density": "float32", "sh": "float32", "square_density": "float32", "square_sh": "float32", "visits": "int32"}
    count = len(found["density"]) if "density" in found and found["density"].ndim else 0
    shapes = dict.fromkeys(kinds, (count,)) | {"sh": (count, 3 * tree.harmonics_count), "coordinates": (count, 3), "progress": (2,), "cascades": (count,)}
    kinds |= {"coordinates": "int32", "progress": "int64"} | ({"cascades": "uint8"} if tree.outer else {})
    for name, kind in kinds.items():
        if name not in found or found[name].dtype != kind or found[name].shape != shapes[name]:
            raise ValueError(f"'{name}' is missing, or no {kind} {shapes[name]}")
    step, phase = (int(x) for x in found["progress"])
    if not 0 <= phase <= len(phases):
        raise ValueError(f"step {step} of phase {phase}, of {len(phases)} phases")
    pruned = any(before.after == "prune" for before in phases[:phase])
    if pruned and ("holes" not in found or found["holes"].dtype != "float64" or found["holes"].shape != (3,) or not np.isfinite(found["holes"]).all()):
        raise ValueError("'holes' is missing, or no three numbers")
    low, high = [0, *phase_ends(phases, steps), steps][phase : phase + 2]
    if not low <= step <= high:
        raise ValueError(f"step {step} is not from {low} to {high}")
    place = places(tree, found["coordinates"], found["cascades"] if tree.outer else np.zeros(count, np.uint8))
    if not count or (np.diff(place) <= 0).any() or (count < len(tree.density_values) and not pruned):
        raise ValueError("its voxels are not those that were baked, in their order")
    return place


def places(tree: NerfTree, coordinates: np.ndarray, cascades: np.ndarray) -> np.ndarray:
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
