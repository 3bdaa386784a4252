"""The fleet folder, and FLEET/fleet.json: what became of each scene.

    FLEET/fleet.json    the state, rewritten atomically whenever it changes; the contract with programs
    FLEET/<scene>/      a run (pipeline/run.py)
    FLEET/.requests/    what `retry` and `cancel` ask of the process that runs the fleet

A fleet.json may be untrusted: every value is checked and bounded when it is read, and a scene's run lies in the fleet's folder.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from pipeline import files
from pipeline.errors import BadInput, CorruptArtifact, UsageError
from pipeline.failures import cannot_write, failed
from pipeline.text import printable

NAME = "fleet.json"
FORMAT = "efficientnerf-fleet"
VERSION = 1
MOST_SCENES = 20_000
MOST_BYTES = 256 * 2**20  # of fleet.json
LONGEST_LINE = 500  # characters of a reason, a warning or a last line
MOST_LINES = 20  # of warnings, and of last lines

# Names that the fleet's own files and folders have.
_RESERVED = frozenset({"index.html", "fleet.json", "fleet.csv", "run.json", "thumbnails", "comparison", "comparison.html", "pages"})
_MOST_BYTES = 200  # of a name: file systems have 255, less what is put behind it
_NAME = re.compile(r"[^\W_][\w.-]{0,99}")

FleetWord = Literal["running", "done", "failed", "cancelled", "interrupted"]
SceneWord = Literal["waiting", "running", "done", "failed", "quarantined"]
StageWord = Literal["waiting", "running", "done", "failed"]

_Text = Annotated[str, msgspec.Meta(max_length=4 * LONGEST_LINE)]
_Name = Annotated[str, msgspec.Meta(max_length=200)]
_Path = Annotated[str, msgspec.Meta(max_length=4096)]
_Count = Annotated[int, msgspec.Meta(ge=0, le=2**62)]
_Seconds = Annotated[float, msgspec.Meta(ge=0, le=1e12)]
_Table = dict[_Name, dict[_Name, Any]]


def is_scene_name(name: str) -> bool:
    """Whether a scene may have this name: it names a folder of the fleet, in pages and on command lines. Letters, digits, ".", "_" and "-"."""
    return _NAME.fullmatch(name) is not None and len(name.encode("utf-8", "replace")) <= _MOST_BYTES and name.casefold() not in _RESERVED


@dataclass(frozen=True)
class Scene:
    """A scene of a fleet, as the manifest has it."""

    name: str  # unique whatever its case, see `is_scene_name`
    sources: tuple[str, ...]  # absolute paths of its folders and videos
    settings: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)  # stage -> setting -> value, where they are not the preset's
    preset: str | None = None
    seed: int | None = None
    sweep: Mapping[str, Any] | None = None  # "stage.setting" -> value for a scene that a sweep made
    shares: Mapping[str, str] = field(default_factory=dict)  # stage -> the scene before it that makes the same artifact: this one waits for it and adopts it


@dataclass
class StageState:
    """One stage of a scene."""

    state: StageWord = "waiting"
    seconds: _Seconds = 0.0  # wall clock, of its last attempt; 0 while it waits
    cpu_seconds: _Seconds = 0.0
    peak_memory: _Count = 0  # bytes
    worker: _Name | None = None


@dataclass
class Verdict:
    """The grade of a scene's cameras, or of its result."""

    grade: _Name
    summary: _Text


@dataclass
class SceneState:
    """What became of one scene."""

    name: _Name
    state: SceneWord = "waiting"  # failed: by circumstances, the same command tries it again; quarantined: by itself, `retry` tries it again
    reason: _Text | None = None  # of a failed or quarantined scene, a sentence
    metrics: dict[_Name, Any] = field(default_factory=dict)  # what its evaluation measured, as the workflow has it
    seconds: _Seconds = 0.0  # wall clock of its stages together
    bytes: _Count = 0  # of its asset
    stage: _Name | None = None  # that runs now
    stages: dict[_Name, StageState] = field(default_factory=dict)
    verdict: Verdict | None = None  # on its cameras; result: on what was made of them
    result: Verdict | None = None
    warnings: Annotated[list[_Text], msgspec.Meta(max_length=MOST_LINES)] = field(default_factory=list)
    # of a failed or quarantined scene: the last lines of its stage's output
    last_lines: Annotated[list[_Text], msgspec.Meta(max_length=MOST_LINES)] = field(default_factory=list)
    attempts: Annotated[int, msgspec.Meta(ge=0, le=10**6)] = 0  # failures so far of the stage that it is at
    worker: _Name | None = None
    run: _Path = ""  # its folder, relative to the fleet's
    sources: Annotated[list[_Path], msgspec.Meta(max_length=100)] = field(default_factory=list)
    settings: _Table = field(default_factory=dict)
    preset: _Name | None = None
    seed: Annotated[int, msgspec.Meta(ge=-(2**63), le=2**63 - 1)] | None = None
    sweep: dict[_Name, Any] | None = None
    shares: dict[_Name, _Name] = field(default_factory=dict)

    @classmethod
    def of(cls, scene: Scene) -> SceneState:
        """The state of a scene that waits."""
        return cls(**{**asdict(scene), "sources": list(scene.sources)}, run=scene.name)

    def scene(self) -> Scene:
        """The scene that it is of."""
        return Scene(self.name, tuple(self.sources), self.settings, self.preset, self.seed, self.sweep, self.shares)


@dataclass
class Totals:
    """Scenes by state."""

    waiting: _Count = 0
    running: _Count = 0
    done: _Count = 0
    failed: _Count = 0
    quarantined: _Count = 0

    @classmethod
    def of(cls, scenes: Sequence[SceneState]) -> Totals:
        return cls(**Counter[str](scene.state for scene in scenes))


@dataclass
class FleetState:
    """A fleet."""

    state: FleetWord = "running"
    # started, updated: ISO 8601, UTC
    started: _Name = ""
    updated: _Name = ""
    forecast_seconds: _Seconds | None = None  # until its end, None where nothing is known yet
    executor: _Name = "local"  # "local" or "dask"
    slots: _Count = 1  # stages that may run at a time
    note: _Text | None = None  # what it waits for, or why it ended with scenes that wait
    totals: Totals = field(default_factory=Totals)
    scenes: Annotated[list[SceneState], msgspec.Meta(max_length=MOST_SCENES)] = field(default_factory=list)

    @property
    def exit_code(self) -> int:
        """0 where all scenes are done, 3 where some are not."""
        return 0 if all(scene.state == "done" for scene in self.scenes) else 3

    def to_bytes(self) -> bytes:
        """As fleet.json holds it."""
        plain = {"format": FORMAT, "version": VERSION, **msgspec.to_builtins(self)}
        return msgspec.json.format(msgspec.json.encode(plain), indent=1) + b"\n"


def check_scenes(scenes: Sequence[Scene]) -> None:
    """Raise UsageError unless scenes can be of one fleet: their number, their names, whom they share with."""
    if not 0 < len(scenes) <= MOST_SCENES:
        raise UsageError(f"the fleet has {len(scenes)} scenes, expected 1 to {MOST_SCENES}.")
    known: set[str] = set()
    folders: set[str] = set()
    for scene in scenes:
        shown = printable(scene.name, 100)
        if not is_scene_name(scene.name):
            raise UsageError(f"scene {shown!r}: no name for a scene. Expected letters, digits, '.', '_' and '-', a letter or digit first, at most 100.")
        if scene.name.casefold() in folders:
            raise UsageError(f"scene {shown}: two scenes have this name; they would share a folder. Rename one.")
        unknown = [donor for donor in scene.shares.values() if donor not in known]
        if unknown:
            raise UsageError(f"scene {shown}: shares an artifact of {printable(unknown[0], 100)!r}, which does not come before it.")
        known.add(scene.name)
        folders.add(scene.name.casefold())


def write_fleet(fleet: Path, state: FleetState) -> None:
    """Write FLEET/fleet.json atomically. Raises PipelineError."""
    try:
        files.write_atomically(fleet / NAME, state.to_bytes())
    except OSError as error:
        raise cannot_write(fleet / NAME, error) from None


def read_fleet(fleet: Path) -> FleetState:
    """FLEET/fleet.json, checked. Raises BadInput where there is none or it is of another format, CorruptArtifact where it is damaged."""
    path = fleet / NAME
    try:
        value = files.read_json(path, limit=MOST_BYTES, follow=False)
    except FileNotFoundError:
        raise BadInput(f"{fleet}: is no fleet (it has no {NAME}). Begin one: enerf fleet SCENES --out {fleet}") from None
    except files.Unreadable as error:
        if error.denied is not None:
            raise failed(fleet, error.denied) from None
        raise _damaged(path, str(error)) from None
    if not isinstance(value, dict) or value.get("format") != FORMAT:
        raise BadInput(f"{path}: not of a fleet (expected format {FORMAT!r}).")
    if value.get("version") != VERSION or type(value.get("version")) is not int:
        raise BadInput(f"{path}: fleet format version {value.get('version')!r:.20}; this build reads {VERSION}. Upgrade efficientnerf.")
    try:
        found = msgspec.convert(value, FleetState)
    except (ValueError, OverflowError, RecursionError) as error:
        raise _damaged(path, printable(error, 300)) from None
    _check(path, found)
    return found


def _check(path: Path, found: FleetState) -> None:
    """Checks beyond types."""
    try:
        check_scenes([scene.scene() for scene in found.scenes])
    except UsageError as error:
        raise _damaged(path, str(error)) from None
    for scene in found.scenes:
        if scene.run != scene.name:
            raise _damaged(path, f"scene {scene.name}: its run is {printable(scene.run, 100)!r}, expected {scene.name!r}")
        if any("\0" in source or not source.startswith("/") for source in scene.sources):
            raise _damaged(path, f"scene {scene.name}: a source is no absolute path")


def _damaged(path: Path, why: str) -> CorruptArtifact:
    return CorruptArtifact(f"{path}: {why}. Remove it and give the fleet's command again: what its runs hold is kept.", (NAME,))
