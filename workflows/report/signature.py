"""Whether a page of a run was written by this program, and here: a page is a program that a browser runs, and a run may be untrusted.

A page's last line is a comment with the SHA-256 of all before it, and with an HMAC of that by a key which the user alone can read. By the first `verify`
finds a page that was altered; by the second a page is known, before it is opened, to be by a holder of the key. Others are made again.
"""

import functools
import hashlib
import hmac
import os
import re
import secrets
import stat
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from efficientnerf.backends.kernel_cache import cache_folder, first_private
from pipeline import files
from pipeline.errors import CorruptArtifact
from pipeline.hashes import CHUNK
from pipeline.manifest import DISTRIBUTION, read_manifest
from pipeline.run import Run
from stages.artifacts import BakeOutputs, SplatsOutputs
from stages.splats.settings import STAGE as SPLATS
from stages.viewer.html import MAX_ASSET

VIEWER, ASSET_VIEWER = "viewer.html", "viewer_asset.html"
PAGES = ("report.html", VIEWER, ASSET_VIEWER)  # of a run
UNSIGNED = "0.1.0"  # the version whose pages have no such line
KEY = 32  # bytes, as many as a SHA-256 has
_LINE = re.compile(rb"<!-- enerf ([0-9a-f]{64}) ([0-9a-f]{64}) -->\n")
_LENGTH = len("<!-- enerf   -->\n") + 2 * 64


def write_page(path: Path, page: bytes) -> None:
    """Write a page atomically, with its signature. Raises OSError."""
    digest = hashlib.sha256(page).hexdigest()
    with files.atomic(path) as temporary, open(temporary, "wb") as file:
        file.write(page)
        file.write(f"<!-- enerf {digest} {_signature(digest)} -->\n".encode("ascii"))


def is_as_written(path: Path) -> bool:
    """Whether a page is as this program, or one that does as it does, wrote it. False for what is no plain file."""
    return _read(path) is not None


def is_own(path: Path) -> bool:
    """Whether this program wrote the page, for this user."""
    found = _read(path)
    return found is not None and hmac.compare_digest(_signature(found[0]), found[1])


def is_newer(page: Path, shown: Iterable[Path]) -> bool:
    """Whether a page is there, and was written after all that it shows: an artifact is published by a rename of its folder, which sets ctime."""
    try:
        written = os.stat(page, follow_symlinks=False).st_mtime_ns
        return all(os.stat(each, follow_symlinks=False).st_ctime_ns <= written for each in shown if os.path.lexists(each))
    except OSError:
        return False


def altered_pages(run: Path) -> list[str]:
    """The names of those pages of a run that are not as they were written."""
    found = [name for name in PAGES if os.path.lexists(run / name) and not is_as_written(run / name)]
    return [name for name in found if _has_line(run / name)] if found and _versions(run) == {UNSIGNED} else found


def _versions(run: Path) -> set[str]:
    """Of this program, that made the artifacts of a run; empty where one cannot be read."""
    try:
        return {read_manifest(path.parent).versions.get(DISTRIBUTION, "") for path in run.glob("*/manifest.json")}
    except (CorruptArtifact, OSError):
        return set()


def _has_line(path: Path) -> bool:
    """Whether a page ends as a signed one does. True for what is no plain file."""
    try:
        with open(files.open_plain(path, follow=False), "rb") as file:
            file.seek(-min(_LENGTH, os.fstat(file.fileno()).st_size), os.SEEK_END)
            return b"<!-- enerf " in file.read()
    except OSError:
        return True


def _read(path: Path) -> tuple[str, str] | None:
    """The digest of a page and its signature; None where it has no such line, or another digest."""
    digest = hashlib.sha256()
    try:
        with open(files.open_plain(path, follow=False), "rb", buffering=0) as file:
            left = os.fstat(file.fileno()).st_size - _LENGTH
            while left > 0 and (chunk := file.read(min(CHUNK, left))):
                digest.update(chunk)
                left -= len(chunk)
            found = _LINE.fullmatch(file.read(_LENGTH + 1)) if left == 0 else None
    except OSError:
        return None
    if found is None or found[1].decode("ascii") != digest.hexdigest():
        return None
    return digest.hexdigest(), found[2].decode("ascii")


def _signature(digest: str) -> str:
    return hmac.new(_key(), digest.encode("ascii"), hashlib.sha256).hexdigest()


@functools.cache
def _key() -> bytes:
    """32 random bytes, one key for each user of a machine; where it cannot be kept, one for this process."""
    try:
        folder = first_private([cache_folder() / "pages"], "key")[0]
        if folder is None:
            return secrets.token_bytes(KEY)
        path = folder / "key"
        if not path.is_file() or path.stat().st_size != KEY:
            files.write_atomically(path, secrets.token_bytes(KEY))
        return path.read_bytes()
    except (OSError, RuntimeError):  # no home, no space
        return secrets.token_bytes(KEY)


def viewers(run: Run) -> dict[str, Path]:
    """The pages that show what the run made, and the file of each: as its `viewer` says, by default the Gaussians where there are any of the present
    asset, else the asset."""
    asset, splats = BakeOutputs.of_run(run.path).asset, SplatsOutputs.of_run(run.path).spz
    sizes = {path: size_of(path) for path in (splats, asset)}
    known = [path for path, size in sizes.items() if size is not None and size <= MAX_ASSET and sizes[asset] is not None]
    if splats in known and not _splats_are_current(run):
        known.remove(splats)
    shown = {"asset": [path for path in known if path == asset], "both": known, "off": []}.get(run.viewer or "splats", known[:1])
    return dict(zip((VIEWER, ASSET_VIEWER), shown, strict=False))


def _splats_are_current(run: Run) -> bool:
    """Whether the Gaussians were made of the artifacts that the run holds now."""
    try:
        inputs = read_manifest(run.folder(SplatsOutputs.stage)).request.inputs
        return all(read_manifest(run.folder(need)).digest == inputs.get(need) for need in SPLATS.needs)
    except (CorruptArtifact, OSError):
        return False


def viewer_is_missing(run: Run) -> bool:
    """Whether a viewer is not there: its file could not be read, or the page is not written yet."""
    return any(not os.path.lexists(run.path / name) for name in viewers(run))


def size_of(path: Path) -> int | None:
    """Bytes of a plain file; None for anything else."""
    with suppress(OSError):
        status = os.stat(path, follow_symlinks=False)
        return status.st_size if stat.S_ISREG(status.st_mode) else None
    return None
