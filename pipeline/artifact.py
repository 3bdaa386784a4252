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

A start that finds old-<stage> without RUN/<stage> was cut short between 2 and 3: it does 3 if out/ is whole, else it undoes 2. One that finds
both was cut short between 3 and 4. A work folder without out/ belongs to an artifact that was published.
"""

from __future__ import annotations

import fnmatch
import stat
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from pipeline import files, manifest
from pipeline.errors import CorruptArtifact, StageFailed
from pipeline.hashes import Hashes
from pipeline.manifest import Manifest, Output, Request
from pipeline.stage import Stage

WORK = ".work"
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
    names = list(names)
    more = len(names) - _SHOWN
    return ", ".join(names[:_SHOWN]) + (f" and {more} more" if more > 0 else "")


def outputs_of(folder: Path, stage: Stage, hashes: Hashes | None = None) -> dict[str, Output]:
    """Hash all that a stage left in its folder. Raises StageFailed for what is no plain file, and for nothing at all."""
    hashes = hashes or Hashes()
    outputs = {}
    for name, status in files.walk(folder):
        if not stat.S_ISREG(status.st_mode):
            raise StageFailed(f"{stage.name}: left {name}, which is no plain file: an artifact must stay whole when the run is moved")
        if name == manifest.NAME:
            raise StageFailed(f"{stage.name}: left a file named {manifest.NAME}, which is the engine's own")
        is_volatile = any(fnmatch.fnmatchcase(name, pattern) for pattern in stage.volatile)
        outputs[name] = Output(hashes.digest(f"{stage.name}/{name}", folder / name, anew=True), status.st_size, is_volatile)
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
            same = hashes.digest(f"{folder.name}/{name}", folder / name) == expected.sha256
        except OSError:
            same = False
        if not same:
            altered.append(name)
    return Differences(tuple(altered), tuple(sorted(outputs.keys() - found.keys())), tuple(sorted(found.keys() - outputs.keys())))


def prepare(place: Workplace, trash: Path) -> bool:
    """Make the folders of a request: an empty out/, scratch/ as it was; other requests' work is removed. Returns whether scratch/ held anything."""
    place.root.mkdir(parents=True, exist_ok=True)
    for other in list(place.root.iterdir()):
        if other.name != place.request:
            files.discard(other, trash)
    files.discard(place.out, trash)
    place.scratch.mkdir(parents=True, exist_ok=True)
    place.out.mkdir()
    return not files.is_empty(place.scratch)


def abandon(place: Workplace, trash: Path) -> None:
    """After a failure: out/ is removed, checkpoints stay."""
    files.discard(place.out, trash)
    if place.scratch.is_dir() and not files.is_empty(place.scratch):
        place.out.mkdir()
        return
    files.discard(place.folder, trash)
    if place.root.is_dir() and files.is_empty(place.root):
        place.root.rmdir()


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
    if files.is_empty(place.root):
        place.root.rmdir()


def finished(place: Workplace) -> Manifest | None:
    """The manifest of a sealed out/ whose publication was cut short, every file checked; None if there is none such."""
    try:
        made = manifest.read_manifest(place.out)
    except CorruptArtifact:
        return None
    whole = made.request.digest == place.request and not differences(place.out, made.outputs).damaged
    return made if whole else None


def recover(run: Path) -> list[str]:
    """Complete or undo what a kill cut short; returns a sentence for each thing done. Only for who holds the run's lock."""
    work = run / WORK
    if not work.is_dir():
        return []
    done = []
    for old in sorted(work.glob("old-*")):
        stage = old.name.removeprefix("old-")
        done.append(f"{stage}: {_recovered(run, stage, old)}")
    for root in sorted(path for path in work.iterdir() if path.is_dir() and "-" not in path.name):
        _clear_published(run / root.name, root, work)
    for trash in work.glob("trash-*"):
        files.remove(trash)
    return done


def _recovered(run: Path, stage: str, old: Path) -> str:
    work, target = run / WORK, run / stage
    if files.exists(target) and _is_sealed(target):
        files.discard(old, work)
        return "the former artifact, already replaced, was deleted"
    files.discard(target, work)
    whole = [path for path in (work / stage).glob("*/out") if _is_sealed(path)]
    if len(whole) == 1:
        files.rename(whole[0], target)
        _sync(whole[0].parent, run)
        files.discard(old, work)
        return "a replacement that was cut short was completed"
    files.rename(old, target)
    _sync(work, run)
    return "a replacement that was cut short was undone"


def _clear_published(target: Path, root: Path, work: Path) -> None:
    for folder in list(root.iterdir()):
        if not files.exists(folder / "out") and _is_sealed(target) and manifest.read_manifest(target).request.digest == folder.name:
            files.discard(folder, work)
    if files.is_empty(root):
        root.rmdir()


def _is_sealed(folder: Path) -> bool:
    try:
        manifest.read_manifest(folder)
    except CorruptArtifact:
        return False
    return True


def _sync(*folders: Path) -> None:
    for folder in folders:
        files.sync_folder(folder)
