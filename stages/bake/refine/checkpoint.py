"""The checkpoint of a refinement in the bake's scratch folder: the state, how far it is, and which voxels it has.

A state's voxels are all of those that were baked in the first phase, and some of them in the second.

N voxels that were baked, n of the state.
"""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from efficientnerf.asset.cascades import subset
from efficientnerf.asset.refinement.schedule import RefinementSchedule, recorded_schedule
from efficientnerf.asset.refinement.state import MOMENTS, STATE, RefinementState
from efficientnerf.asset.tree import NerfTree
from pipeline.files import atomic, exists, remove
from pipeline.stage import Job
from stages.bake.pruning import Pruned
from stages.scratch import opened, unusable
from stages.train.budget import schedule_state

CHECKPOINT = "refinement.safetensors"
_Seconds = Annotated[float, msgspec.Meta(ge=0, le=1e10)]


class _About(msgspec.Struct, forbid_unknown_fields=True):
    """The metadata of a checkpoint: `Point` without the state."""

    step: Annotated[int, msgspec.Meta(ge=0, le=2**40)]
    phase: Annotated[int, msgspec.Meta(ge=0, le=1)]
    pruned: Pruned | None
    schedule: list[dict[str, Any]]
    seconds: _Seconds
    began: _Seconds
    allotted: _Seconds


@dataclass
class Point:
    """How far a refinement is."""

    state: RefinementState
    schedule: RefinementSchedule  # of the steps
    phase: int = 0  # number of the one whose steps are taken
    pruned: Pruned | None = None  # what was dropped after the first; None in it
    kept: np.ndarray | None = None  # (N,) bool, the voxels that were not dropped; None: all
    seconds: float = 0.0  # of the stage up to here
    began: float = 0.0  # seconds at which the phase began
    allotted: float = 0.0  # seconds that it may take, where there is a budget


def save(job: Job, point: Point) -> None:
    """Replace the checkpoint."""
    state = point.state
    state.fetch()
    tensors = {name: np.ascontiguousarray(getattr(state, name)) for name in STATE}
    if point.kept is not None:
        tensors["kept"] = point.kept
    if state.errors is not None:
        tensors["errors"] = state.errors
    times = (point.seconds, point.began, point.allotted)
    about = _About(state.step, point.phase, point.pruned, point.schedule.state(), *times)
    tensors["about"] = np.frombuffer(msgspec.json.encode(about), np.uint8)
    with atomic(job.work / CHECKPOINT, durable=False) as temporary:
        save_file(tensors, str(temporary), metadata={"sha256": digest_of(tensors)})


def digest_of(tensors: Mapping[str, np.ndarray]) -> str:
    """SHA-256 over names, types, shapes and bytes."""
    digest = hashlib.sha256()
    for name, values in sorted(tensors.items()):
        digest.update(f"{name} {values.dtype} {values.shape}\n".encode())
        digest.update(np.ascontiguousarray(values).data)
    return digest.hexdigest()


def restored(job: Job, tree: NerfTree, stated: RefinementSchedule, hold: int | None = None, *, cells: int) -> Point | None:
    """The last checkpoint of a refinement of this tree; None where there is none that fits, and one that does not is removed.

    tree    as it was baked
    stated  the schedule
    hold    of a phase whose number of steps follows from the time that they take; None: all of them are stated
    cells   of the error map
    """
    path = job.work / CHECKPOINT
    if not exists(path):
        return None
    try:
        found = _read(path)
        about, schedule, kept = check(found, tree, stated, hold)
        errors = _errors(found, about.step, cells)
        fitted = _with_values(tree, kept, np.array(found["density"]), np.array(found["sh"]))
        density, sh, visits = (np.array(found[name]) for name in MOMENTS)
        state = RefinementState(fitted, density, sh, visits, about.step, errors)
    except (OSError, ValueError, RecursionError) as error:
        job.warn(unusable(path, error))
        remove(path)
        return None
    job.say(f"resuming the refinement from step {state.step}")
    return Point(state, schedule, about.phase, about.pruned, kept if "kept" in found else None, about.seconds, about.began, about.allotted)


def _read(path: Path) -> dict[str, np.ndarray]:
    """The tensors of a checkpoint; ValueError or OSError where it is not as it was written."""
    try:
        with opened(path), safe_open(str(path), framework="np") as file:
            found = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
            written = (file.metadata() or {}).get("sha256")
    except (SafetensorError, TypeError, AttributeError) as error:  # of a type that numpy does not have
        raise ValueError(str(error)[:80]) from None
    if digest_of(found) != written:
        raise ValueError("its values are not those that its SHA-256 was made of")
    return found


def _errors(found: Mapping[str, np.ndarray], step: int, cells: int) -> np.ndarray | None:
    """The errors of an error map of so many cells; ValueError where they are missing, or none."""
    if step == 0 and "errors" not in found:
        return None
    errors = found.get("errors")
    if errors is None or errors.dtype != np.float32 or errors.shape != (2, cells) or not np.isfinite(errors).all():
        raise ValueError(f"'errors' is missing, or no float32 {(2, cells)}")
    return np.array(errors)


def _with_values(tree: NerfTree, kept: np.ndarray, density: np.ndarray, sh: np.ndarray) -> NerfTree:
    """The tree with the voxels `kept`, (N,) bool, alone, and their values."""
    structure = subset(replace(tree, harmonics=tree.sh[:, :0]), kept)  # harmonics are most of the memory: none are copied
    return replace(structure, density_values=density, harmonics=sh.reshape(len(sh), -1, 3))


def check(
    found: Mapping[str, np.ndarray], tree: NerfTree, stated: RefinementSchedule, hold: int | None = None
) -> tuple[_About, RefinementSchedule, np.ndarray]:
    """The checkpoint's metadata; the schedule; and (N,) bool, which of the tree's voxels the state has. ValueError where the tensors are no state of a
    refinement of this tree, or a step in it is out of range."""
    if "about" not in found or found["about"].dtype != "uint8" or found["about"].ndim != 1 or len(found["about"]) > 2**20:
        raise ValueError("'about' is missing, or no text")
    about = msgspec.json.decode(found["about"].tobytes(), type=_About)
    baked = len(tree.density_values)
    kept = found["kept"] if "kept" in found else np.ones(baked, bool)
    if kept.dtype != bool or kept.shape != (baked,) or not kept.any() or (about.phase == 0 and not kept.all()) or kept.view(np.uint8).max() > 1:
        raise ValueError("its voxels are not those that were baked")
    count = int(kept.sum())
    for name in STATE:
        kind, shape = "int32" if name == "visits" else "float32", (count, 3 * tree.harmonics_count) if name == "sh" else (count,)
        if name not in found or found[name].dtype != kind or found[name].shape != shape:
            raise ValueError(f"'{name}' is missing, or no {kind} {shape}")
    if (about.pruned is None) == (about.phase == 1):
        raise ValueError(f"what was dropped up to phase {about.phase} is not what is dropped there")
    if hold is None:
        schedule = stated
        if about.schedule != stated.state():
            raise ValueError(f"step {about.step} is of another number of steps")
    else:
        if len(about.schedule) != about.phase + 1:
            raise ValueError(f"step {about.step} is not of the last phase that has begun")
        schedule = recorded_schedule([schedule_state(one, hold) for one in about.schedule])
    low, high = schedule.begin(about.phase), schedule.begin(about.phase + 1)
    if not low <= about.step <= high:
        raise ValueError(f"step {about.step} is not from {low} to {high}")
    return about, schedule, kept
