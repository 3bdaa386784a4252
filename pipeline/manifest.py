"""The origin and files of an artifact: manifest.json, the last file written into an artifact's folder.

request   stage, version, settings, digests of the inputs, digests of the source's files. Its SHA-256 names the work folder
outputs   name -> SHA-256, size, and whether it depends on the clock (volatile)
digest    of the names and SHA-256 of the outputs that do not: all that later requests see
the rest  seconds, processor time, peak memory, tool versions: for people, outside of every digest
checksum  of all of the above, so that a damaged manifest is known as such
"""

import hashlib
import importlib.metadata
import platform
import re
import sys
import time
from dataclasses import asdict, dataclass, field
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import msgspec

from pipeline import files
from pipeline.errors import CorruptArtifact
from pipeline.hashes import Sha256
from pipeline.text import printable

NAME = "manifest.json"
FORMAT = "enerf-manifest"
VERSION = 1
ABSENT = "absent"  # in place of the digest of a source file that is listed but missing
DISTRIBUTION = "efficientnerf"  # its requirements are the packages whose versions are written down

_Sha256OrAbsent = Annotated[str, msgspec.Meta(pattern=rf"^(?:[0-9a-f]{{64}}|{ABSENT})\Z")]
_Count = Annotated[int, msgspec.Meta(ge=0, le=2**62)]
_Seconds = Annotated[float, msgspec.Meta(ge=0, le=1e12)]


@dataclass(frozen=True)
class Request:
    """All that decides the bytes of an artifact."""

    stage: str
    version: _Count
    settings: dict[str, Any]  # plain JSON values
    inputs: dict[str, Sha256]  # need -> digest of its artifact
    source: dict[str, _Sha256OrAbsent] | None = None  # path relative to the source -> SHA-256 (or ABSENT); None for a stage that does not read the source

    @property
    def digest(self) -> str:
        return hashlib.sha256(files.canonical_json(asdict(self))).hexdigest()


@dataclass(frozen=True)
class Output:
    """One file of an artifact; size in bytes."""

    sha256: Sha256
    size: _Count
    volatile: bool = False


@cache
def tool_versions() -> tuple[tuple[str, str], ...]:
    """(name, version) of Python, the platform and the packages that this distribution requires and that are installed."""
    found = {"python": platform.python_version(), "platform": platform.platform(), "implementation": sys.implementation.name}
    packages = [DISTRIBUTION, *(name for name, extra in requirements() if not extra)]
    found |= {name.lower(): version for name in packages if (version := version_of(name)) is not None}
    return tuple(sorted(found.items()))


def requirements() -> list[tuple[str, str]]:
    """(package, the extra that needs it, or nothing) as the installed version of this distribution states them."""
    try:
        lines = importlib.metadata.requires(DISTRIBUTION) or ()
    except importlib.metadata.PackageNotFoundError:
        return []
    found = [re.match(r"([\w.-]+)(?:.*extra == ['\"](\w+)['\"])?", line) for line in lines]
    return [(match[1], match[2] or "") for match in found if match]


def version_of(package: str) -> str | None:
    """The installed version; None where it is not installed."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


@dataclass(frozen=True)
class Manifest:
    """See the module. One that is read is untrusted: types state what is checked."""

    request: Request
    outputs: dict[str, Output]
    seconds: _Seconds = 0.0  # wall clock of the process that finished it
    peak_memory: _Count = 0  # bytes, of that process during the stage
    resumed: bool = False  # whether it went on from the scratch of an earlier process
    made: _Seconds = field(default_factory=time.time)  # since 1970
    versions: dict[str, str] = field(default_factory=lambda: dict(tool_versions()))
    cpu_seconds: _Seconds = 0.0  # processor time of that process and its children during the stage; 0 where it is not known
    cores: _Count = 0  # that the process might use; 0 where it is not known
    facts: dict[str, Any] = field(default_factory=dict)  # what the stage recorded (`Job.record`), as JSON holds it

    @property
    def cores_busy(self) -> float:
        """Processor time over wall clock."""
        return self.cpu_seconds / self.seconds if self.seconds > 0 else 0.0

    @property
    def digest(self) -> str:
        """SHA-256 over the sorted names and hashes of the outputs that do not depend on the clock."""
        rows = [[name, output.sha256] for name, output in sorted(self.outputs.items()) if not output.volatile]
        return hashlib.sha256(files.canonical_json(["artifact", rows])).hexdigest()

    @property
    def size(self) -> int:
        """Bytes of all outputs."""
        return sum(output.size for output in self.outputs.values())

    def to_bytes(self) -> bytes:
        value = {"format": FORMAT, "format_version": VERSION, **asdict(self), "request_digest": self.request.digest, "digest": self.digest}
        for output in value["outputs"].values():
            if not output["volatile"]:
                del output["volatile"]
        value["checksum"] = hashlib.sha256(files.canonical_json(value)).hexdigest()
        return files.pretty_json(value)


def read_manifest(folder: Path) -> Manifest:
    """The manifest in an artifact's folder. Every value is checked. Raises CorruptArtifact; OSError where it may not be read."""
    where = f"{folder.name}/{NAME}"
    try:
        return _parsed(files.read_json(folder / NAME, follow=False))
    except (FileNotFoundError, NotADirectoryError):
        raise CorruptArtifact(f"{where}: is not there", (where,)) from None
    except files.Unreadable as error:
        if error.denied is not None:
            raise error.denied from None
        raise CorruptArtifact(f"{where}: {error}", (where,)) from None
    except (ValueError, OverflowError, RecursionError) as error:  # of msgspec, too
        raise CorruptArtifact(f"{where}: {printable(error, 300)}", (where,)) from None


def _parsed(value: Any) -> Manifest:
    if not isinstance(value, dict):
        raise ValueError(f"found {type(value).__name__}, expected an object")
    if value.get("format") != FORMAT:
        raise ValueError(f"format {value.get('format')!r:.40}, expected {FORMAT!r}")
    if value.get("format_version") != VERSION:
        raise ValueError(f"format version {value.get('format_version')!r:.20}; this build reads {VERSION}. Upgrade {DISTRIBUTION}")
    rest = {key: item for key, item in value.items() if key != "checksum"}
    if value.get("checksum") != hashlib.sha256(files.canonical_json(rest)).hexdigest():
        raise ValueError("its checksum is not that of its content: it was altered or damaged")
    manifest = msgspec.convert(value, Manifest)
    for name in manifest.outputs:
        if not files.is_safe_name(name) or name == NAME:
            raise ValueError(f"output {name!r:.80} is no name of a file in its folder")
    if (value.get("digest"), value.get("request_digest")) != (manifest.digest, manifest.request.digest):
        raise ValueError("its digests are not those of what it lists")
    return manifest
