"""Artifacts that several runs share: the same request is the same artifact, so that one run makes it and others adopt it.

Published files are replaced, never written in place: runs share them by hard links, and each is complete by itself. Where the file system has no hard
links between the two, files are copied.
"""

import contextlib
from collections.abc import Collection
from pathlib import Path

from pipeline import artifact, files, manifest
from pipeline.artifact import Workplace
from pipeline.decide import decide
from pipeline.errors import CorruptArtifact
from pipeline.failures import failed
from pipeline.hashes import Hashes
from pipeline.links import WORK, refuse_links
from pipeline.manifest import Manifest
from pipeline.run import Run
from pipeline.stage import Stage


def take_over(run: Run, stage: Stage, donor: Path) -> bool:
    """Publish in `run` the artifact of the run in the folder `donor`; returns whether that was done.

    Nothing is done where the stage is fresh, where the donor's artifact is not of the very request that the stage has now, or where it is damaged: then the
    stage has to be run. Every file is read and compared with its manifest. Raises RunLocked, CorruptArtifact where the donor holds links, and DiskFull.
    """
    with run.locked():
        try:
            artifact.recover(run.path, [stage.name])
            decision = decide(stage, run)
            if decision.fresh or decision.request is None:
                return False
            made = _made(donor, stage, run.stages)
            if made is None or made.request != decision.request:
                return False
            place = artifact.workplace(run.path, stage.name, decision.request)
            artifact.prepare(place, run.path / WORK)
            if not _linked(donor / stage.name, made, place):
                artifact.abandon(place, run.path / WORK)
                return False
            artifact.publish(run.path, stage.name, place)
        except OSError as error:
            raise failed(run.path, error) from error
        hashes = Hashes(run.cache)
        hashes.forget(f"{stage.name}/")  # those that are remembered are of the files before
        hashes.save()
    return True


def _made(donor: Path, stage: Stage, stages: Collection[str] | None) -> Manifest | None:
    """The manifest of the donor's artifact, or None where there is none that can be read."""
    refuse_links(donor, stages)
    with contextlib.suppress(CorruptArtifact):
        return manifest.read_manifest(donor / stage.name)
    return None


def _linked(source: Path, made: Manifest, place: Workplace) -> bool:
    """Whether the files of an artifact, its manifest last, are in out/ now, each as its manifest says."""
    try:
        for name in made.outputs:
            target = place.out / name
            target.parent.mkdir(parents=True, exist_ok=True)
            files.link_or_copy(source / name, target)
    except FileNotFoundError:
        return False  # damaged, or replaced meanwhile
    if artifact.differences(place.out, made.outputs).damaged:
        return False
    artifact.seal(place.out, made)
    return True
