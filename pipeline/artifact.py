"""A folder and the SHA-256 of each file in it: written aside, synced, renamed into place, and put right after a kill.

    RUN/<stage>/                            the artifact; manifest.json in it
    RUN/.work/<stage>/<request>/out/        what a stage is writing
    RUN/.work/<stage>/<request>/scratch/    its checkpoints
    RUN/.work/old-<stage>/                  the former artifact, while it is being replaced
    RUN/.work/trash-*/                      what is being deleted

Publishing, where each line is durable before the next begins:

    1  out/manifest.json is written, after every file in out/ was synced
    2  RUN/<stage>  ->  .work/old-<stage>       if there is one
    3  out          ->  RUN/<stage>
    4  .work/old-<stage>  ->  .work/trash-*, deleted; the request's work folder too

A start that finds old-<stage> without RUN/<stage> was cut short between 2 and 3: it does 3 if out/ is complete, else it undoes 2. One that finds
both was cut short between 3 and 4. A work folder without out/ belongs to an artifact that was published.

Only names that these lines give are completed, undone or deleted, only for stages of the workflow, and only folders whose manifest is of that stage:
.work may be untrusted. links.py has checked that it holds no links.
"""

import fnmatch
import stat
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from pathlib import Path

from pipeline import files, manifest
from pipeline.errors import CorruptArtifact, StageFailed
from pipeline.hashes import Hashes
from pipeline.links import WORK
from pipeline.manifest import Manifest, Output, Request
from pipeline.stage import Stage
from pipeline.text import printable

_SHOWN = 3  # names in a message before "and N more"


@dataclass(frozen=True)
class Workplace:
    """The folders of one request of one stage."""

    root: Path
    request: str

    @property
    def out(self) -> Path:
        return self.root / self.request / "out"

    @property
    def scratch(self) -> Path:
        return self.root / self.request / "scratch"

    @property
    def folder(self) -> Path:
        return self.root / self.request


def workplace(run: Path, stage: str, request: Request) -> Workplace:
    return Workplace(run / WORK / stage, request.digest)


@dataclass(frozen=True)
class Differences:
    """Between the outputs of a manifest and the files in the folder; names, sorted."""

    altered: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()
    extra: tuple[str, ...] = ()

    @property
    def damaged(self) -> tuple[str, ...]:
        """Altered or missing; extra files do no harm."""
        return tuple(sorted(self.altered + self.missing))

    def text(self) -> str:
        """ "mesh.ply altered; mesh.glb gone"; empty if nothing is damaged."""
        parts = [(self.altered, "altered"), (self.missing, "gone")]
        return "; ".join(f"{listed(names)} {word}" for names, word in parts if names)


def listed(names: Iterable[str]) -> str:
    """ "a, b, c and 4 more"."""
    names = [printable(name, 200) for name in names]
    more = len(names) - _SHOWN
    return ", ".join(names[:_SHOWN]) + (f" and {more} more" if more > 0 else "")


def outputs_of(folder: Path, stage: Stage, hashes: Hashes | None = None) -> dict[str, Output]:
    """Hash all files of a stage's folder. Raises StageFailed for anything but a plain file, and for an empty folder."""
    hashes = hashes or Hashes()
    outputs = {}
    for name, status in files.walk(folder):
        if not stat.S_ISREG(status.st_mode):
            raise StageFailed(f"{stage.name}: left {printable(name, 200)}, which is no plain file: an artifact must stay whole when the run is moved")
        if name == manifest.NAME:
            raise StageFailed(f"{stage.name}: left a file named {manifest.NAME}, which is the engine's own")
        is_volatile = any(fnmatch.fnmatchcase(name, pattern) for pattern in stage.volatile)
        outputs[name] = Output(hashes.digest(f"{stage.name}/{name}", folder / name, anew=True, follow=False), status.st_size, is_volatile)
    if not outputs:
        raise StageFailed(f"{stage.name}: left no file behind")
    return outputs


def differences(folder: Path, outputs: dict[str, Output], hashes: Hashes | None = None) -> Differences:
    """Compare a folder with what its manifest lists. `hashes` may remember; None reads every file."""
    hashes = hashes or Hashes()
    found = {name: status for name, status in files.walk(folder) if name != manifest.NAME}
    altered = []
    for name in sorted(outputs.keys() & found.keys()):
        status, expected = found[name], outputs[name]
        if not stat.S_ISREG(status.st_mode) or status.st_size != expected.size:
            altered.append(name)
            continue
        try:
            same = hashes.digest(f"{folder.name}/{name}", folder / name, follow=False) == expected.sha256
        except OSError as error:
            if files.is_denied(error):
                raise
            same = False
        if not same:
            altered.append(name)
    return Differences(tuple(altered), tuple(sorted(outputs.keys() - found.keys())), tuple(sorted(found.keys() - outputs.keys())))


def prepare(place: Workplace, trash: Path) -> bool:
    """Make the folders of a request: an empty out/, scratch/ as it was; other requests' work is removed. Returns whether scratch/ held anything."""
    for folder in (place.root, place.folder, place.scratch):
        if files.exists(folder) and not files.is_folder(folder):
            files.discard(folder, trash)  # a stranger may have put a file there
    place.root.mkdir(parents=True, exist_ok=True)
    for other in list(place.root.iterdir()):
        if other.name != place.request:
            files.discard(other, trash)
    files.discard(place.out, trash)
    place.scratch.mkdir(parents=True, exist_ok=True)
    place.out.mkdir()
    _sync(place.folder, place.root, trash, trash.parent)  # a checkpoint is as durable as the folders above it
    return not files.is_empty(place.scratch)


def abandon(place: Workplace, trash: Path) -> None:
    """After a failure: out/ is removed, checkpoints stay."""
    files.discard(place.out, trash)
    if place.scratch.is_dir() and not files.is_empty(place.scratch):
        place.out.mkdir()
        return
    files.discard(place.folder, trash)
    _remove_if_empty(place.root)


def seal(out: Path, made: Manifest) -> None:
    """Step 1: sync everything in the folder, then write the manifest."""
    files.sync_tree(out)
    files.write_atomically(out / manifest.NAME, made.to_bytes())


def publish(run: Path, stage: str, place: Workplace) -> None:
    """Steps 2 to 4 for a sealed out/."""
    work, target, old = run / WORK, run / stage, run / WORK / f"old-{stage}"
    files.discard(old, work)
    if files.exists(target):
        files.rename(target, old)
        _sync(run, work)
    files.rename(place.out, target)
    _sync(place.folder, run)
    files.discard(old, work)
    files.discard(place.folder, work)
    _remove_if_empty(place.root)


def finished(place: Workplace, stage: str) -> Manifest | None:
    """The manifest of a sealed out/ whose publication was cut short, every file checked; None if there is none."""
    made = _sealed(place.out, stage, place.request)
    return None if made is None or differences(place.out, made.outputs).damaged else made


def is_published(run: Path, stage: str, place: Workplace) -> bool:
    """Whether out/ has become RUN/<stage>, whatever failed after that."""
    return _sealed(run / stage, stage, place.request) is not None and not files.exists(place.out)


def clear_published(run: Path, place: Workplace) -> None:
    """Delete the work folder of a published artifact: an interrupted forced run left it, and nothing resumes it."""
    files.discard(place.folder, run / WORK)
    _remove_if_empty(place.root)


def recover(run: Path, stages: Collection[str]) -> list[str]:
    """Complete or undo what a kill cut short; returns a sentence for each thing done. The caller holds the run's lock.

    stages  names of the workflow's; what .work holds of others stays as it is
    """
    work = run / WORK
    if not files.is_folder(work):
        return []
    done = []
    for stage in sorted(stages):
        if files.exists(work / f"old-{stage}"):
            done.append(f"{stage}: {_recovered(run, stage, work / f'old-{stage}')}")
        if files.is_folder(work / stage):
            published = _sealed(run / stage, stage)
            place = None if published is None else workplace(run, stage, published.request)
            if place is not None and files.is_folder(place.folder) and not files.exists(place.out):
                files.discard(place.folder, work)
            _remove_if_empty(work / stage)
    for path in list(work.iterdir()):
        if files.is_trash(path.name):
            files.remove(path)
    return done


def _recovered(run: Path, stage: str, old: Path) -> str:
    work, target = run / WORK, run / stage
    if _sealed(target, stage) is not None:
        files.discard(old, work)
        return "the former artifact, already replaced, was deleted"
    if _sealed(old, stage) is None:
        files.discard(old, work)
        return "what was set aside as the former artifact is none, and was deleted"
    files.discard(target, work)
    whole = [path for path in (work / stage).glob("*/out") if _sealed(path, stage, path.parent.name) is not None]
    if len(whole) == 1:
        files.rename(whole[0], target)
        _sync(whole[0].parent, run)
        files.discard(old, work)
        return "a replacement that was cut short was completed"
    files.rename(old, target)
    _sync(work, run)
    return "a replacement that was cut short was undone"


def _remove_if_empty(folder: Path) -> None:
    if files.is_folder(folder) and files.is_empty(folder):
        folder.rmdir()


def _sealed(folder: Path, stage: str, request: str | None = None) -> Manifest | None:
    """The manifest of an artifact of this stage, and of this request if one is given; None if the folder is not one."""
    if not files.is_folder(folder):
        return None
    try:
        made = manifest.read_manifest(folder)
    except CorruptArtifact:
        return None
    return made if made.request.stage == stage and request in (None, made.request.digest) else None


def _sync(*folders: Path) -> None:
    for folder in folders:
        files.sync_folder(folder)
