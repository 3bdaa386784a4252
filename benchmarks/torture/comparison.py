"""What a run has to have in the end: the artifacts of the undisturbed run, and nothing else."""

import json
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from workflows.asset import NAMES as STAGES

# What may stay: the lock's file, the digests that are remembered, what libraries printed; and for a day a temporary file of the pages, which are written
# without a lock, that may be of another process. Which previews of a refinement are drawn depends on the time that they take.
KEPT = re.compile(
    r"\.lock|\.lease/.*|\.work/|\.cache/(?:hashes\.json|libraries\.log)?|\.(?:report|viewer)\.html\.[0-9a-f]+\.part|bake/previews/preview_[0-9]+\.png"
)


@dataclass(frozen=True)
class Expected:
    """Of an undisturbed run: digest of each artifact, and the names of all its files."""

    digests: dict[str, str | None]
    names: frozenset[str]


def digests(run: Path, stages: Sequence[str] = STAGES) -> dict[str, str | None]:
    """The digest of each artifact, from its manifest."""
    found: dict[str, str | None] = {}
    for stage in stages:
        path = run / stage / "manifest.json"
        found[stage] = json.loads(path.read_text(encoding="utf-8"))["digest"] if path.is_file() else None
    return found


def names(run: Path) -> frozenset[str]:
    """Relative paths of all files and empty folders, but those that may come and go."""
    found = set()
    for folder, folders, files in os.walk(run):
        relative = Path(folder).relative_to(run)
        if not folders and not files and relative.parts:
            found.add(f"{relative.as_posix()}/")
        found.update((relative / name).as_posix() for name in files)
    return frozenset(name for name in found if not KEPT.fullmatch(name))


def expected(run: Path) -> Expected:
    """Raises ValueError where a stage is missing."""
    made = digests(run)
    missing = [stage for stage, digest in made.items() if digest is None]
    if missing:
        raise ValueError(f"the undisturbed run made no {', '.join(missing)}")
    return Expected(made, names(run))


def differences(run: Path, wanted: Expected) -> list[str]:
    """In words, what a run has that it should not, or has not."""
    found, there = digests(run, tuple(wanted.digests)), names(run)
    words = [f"{stage}: other bytes" if digest else f"{stage}: missing" for stage, digest in found.items() if digest != wanted.digests[stage]]
    words += [f"left behind: {name}" for name in sorted(there - wanted.names)[:5]]
    words += [f"gone: {name}" for name in sorted(wanted.names - there)[:5]]
    work = run / ".work"
    if work.is_dir() and any(work.iterdir()):
        words.append(f".work holds {', '.join(sorted(path.name for path in work.iterdir())[:5])}")
    return words
