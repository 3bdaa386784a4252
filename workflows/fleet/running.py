"""A fleet from its scenes to its end: the folder and its lock, the workers, the scheduler, and what is written next to fleet.json."""

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pipeline import files
from pipeline.errors import BadInput, CorruptArtifact, RunLocked
from pipeline.executors.cores import cores
from pipeline.executors.dask import DaskWorkers
from pipeline.executors.memory import Limit
from pipeline.executors.processes import Processes
from pipeline.failures import cannot_write
from pipeline.fleet import requests
from pipeline.fleet.scheduler import Report, Scheduler, states_for
from pipeline.fleet.state import NAME, FleetState, Scene, SceneState, check_scenes, read_fleet
from pipeline.fleet.workers import Worker, Workers
from pipeline.interrupt import stopping
from pipeline.links import HOLDER, LEASE, LOCK
from pipeline.locks.lease import Lease
from pipeline.locks.lock import lock
from pipeline.run import NAME as RUN_NAME
from workflows.cli.device import cuda_device_count
from workflows.fleet.pages.updates import FILES as PAGES
from workflows.workflow import Workflow

_OWN = (NAME, LOCK, HOLDER, LEASE, requests.FOLDER)


@dataclass(frozen=True)
class Placement:
    """Where the stages of a fleet run."""

    jobs: int = 1  # stages at a time on each worker, besides those that have a device
    scheduler: str | None = None  # address of a Dask scheduler; None and no cluster: this machine, without Dask
    cluster: str | None = None  # kind of the Dask cluster to start
    cluster_options: Mapping[str, Any] = field(default_factory=dict)  # of the cluster's class
    device: str = "cpu"  # "cpu" or "cuda"
    memory: Limit | None = None  # what stages on this machine may take together


def check_fleet_folder(fleet: Path) -> None:
    """Raise BadInput unless a fleet is there, or may be begun: nothing, or an empty folder; CorruptArtifact where it holds links."""
    if not files.exists(fleet):
        return
    if not fleet.is_dir():
        raise BadInput(f"{fleet}: exists and is not a folder. Give a new folder for the fleet.")
    names = sorted(os.listdir(fleet))
    if RUN_NAME in names:
        raise BadInput(f"{fleet}: is a run. Give a new folder for the fleet.")
    own = (*_OWN, *PAGES) if LEASE in names else _OWN  # pages without a trace of who wrote them are others'
    others = [name for name in names if name not in own and not files.is_temporary(name, NAME, HOLDER)]
    others = [name for name in others if not (fleet / name / RUN_NAME).is_file()]  # a fleet.json that was damaged may have been removed
    if NAME not in names and others:
        raise BadInput(f"{fleet}: exists and is not a fleet (no {NAME}; it holds {others[0]!r}). Give a new or an empty folder.")
    for name in (*_OWN, *PAGES):
        if os.path.islink(fleet / name):
            raise CorruptArtifact(f"{fleet}: {name} is a link; a fleet holds plain files and folders. Remove it.", (name,))


@contextmanager
def held(fleet: Path) -> Iterator[Lease]:
    """Hold the lock of a fleet, whose folder is made if it is missing. Raises RunLocked, which says who holds it; BadInput."""
    check_fleet_folder(fleet)
    try:
        fleet.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise cannot_write(fleet, error) from None
    with lock(fleet) as lease:
        yield lease


def is_running(fleet: Path) -> bool:
    """Whether a process, here or on another machine, runs it now."""
    try:
        with held(fleet):
            return False
    except RunLocked:
        return True


def run_fleet(
    fleet: Path,
    scenes: Sequence[Scene] | None,
    workflow: Workflow,
    placement: Placement,
    *,
    retry: Sequence[str] | None = None,
    report: Report,
    written: Callable[[FleetState], None],
) -> FleetState:
    """Run what of a fleet is not done, and return its state. Raises RunLocked where it is being run, Interrupted after a signal, PipelineError.

    scenes   None: those of fleet.json
    retry    names of failed or quarantined scenes to try again
    written  called after each writing of fleet.json
    """
    with held(fleet) as lease, stopping() as stop:
        former = read_fleet(fleet) if files.exists(fleet / NAME) else None
        chosen = scenes if scenes is not None else [state.scene() for state in (former or read_fleet(fleet)).scenes]
        check_scenes(chosen)
        again = {*(retry or ()), *requests.left(fleet)}
        states = states_for(chosen, former)
        for state in states:
            if state.name in again and state.state in ("failed", "quarantined"):
                state.state = "waiting"

        def lost() -> str | None:
            why = lease.lost()
            return None if why is None else f"{fleet}: no longer this process's to run: {why}. What is done is kept."

        workers = _workers(workflow, placement)
        return Scheduler(fleet, states, workflow.stages, workers, device=placement.device, report=report, written=written, stop=stop, lost=lost).run()


def check_known(states: Sequence[SceneState], names: Sequence[str]) -> None:
    """Raise BadInput for a name that no scene has."""
    known = {state.name for state in states}
    for name in names:
        if name not in known:
            raise BadInput(f"{name!r:.100}: the fleet has no such scene. 'enerf fleet status FLEET' lists them.")


def scenes_to_retry(states: Sequence[SceneState], names: Sequence[str]) -> list[str]:
    """The failed and quarantined scenes of these names; of all where none is given. Raises BadInput for a name that no scene has."""
    check_known(states, names)
    return [state.name for state in states if state.state in ("failed", "quarantined") and (not names or state.name in names)]


def _workers(workflow: Workflow, placement: Placement) -> Workers:
    if placement.scheduler is not None or placement.cluster is not None:
        kind = placement.cluster or "local"
        return DaskWorkers(workflow.child, address=placement.scheduler, kind=kind, options=placement.cluster_options, slots=placement.jobs)

    gpus = tuple(range(cuda_device_count() or 1)) if placement.device == "cuda" else ()
    memory = None if placement.memory is None else placement.memory.bytes
    return Processes(workflow.child, Worker("local", cores(), memory, gpus, placement.jobs))
