"""The run that the options of `enerf run` request: source, settings and device."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from efficientnerf.backends.kernel_cache import are_compiled
from pipeline.artifact import listed
from pipeline.errors import BadInput, UsageError
from pipeline.executors.memory import Limit, limit_for, parse_size, size_text
from pipeline.run import MOST_SOURCES, NAME, Run
from pipeline.stage import Stage
from stages.video import KNOWN, SUFFIXES
from workflows.budget import share_budget, train_share
from workflows.cli.device import has_cuda
from workflows.cli.resolve import Config, Settings, Table, metres_of, read_config, read_preset, seconds_of, table_of
from workflows.cli.target import recorded_run, resume_command
from workflows.workflow import Workflow

# Bytes of a process besides the needs of its stages: docs/experiments/memory.md
COMPILING, PAGES = 1600 * 2**20, 300 * 2**20


@dataclass(frozen=True)
class Options:
    """The options of the command line; None or empty where not given."""

    source: Path | None = None
    also: tuple[Path, ...] = ()
    format: str | None = None
    preset: str | None = None
    config: Path | None = None
    sets: tuple[str, ...] = ()
    table: Table = field(default_factory=dict)  # settings of a fleet's scene, as its manifest has them
    seed: int | None = None
    budget: str | None = None
    until: str | None = None
    target_mib: float | None = None
    frames: int | None = None
    lens: str | None = None
    marker_size: str | None = None
    mask_from: str | None = None
    mask_model: str | None = None
    features_model: tuple[str, str] | None = None
    device: str | None = None
    memory: str | None = None
    share: int | None = None  # bytes of its worker's memory that the scene's stages have
    viewer: str | None = None
    strict: bool = False
    allow_outside: bool = False


@dataclass(frozen=True)
class Plan:
    """A run before it is written."""

    run: Run  # a Run with the new settings
    new: bool  # whether its folder has yet to be made
    memory: Limit | None  # what stages may take
    warnings: list[str]  # for the user
    again: Callable[[], Plan]  # makes the plan anew, of what run.json holds then

    @contextmanager
    def written(self) -> Iterator[Run]:
        """Create the run, or update the existing one, and hold its lock: its settings do not change while its stages run.

        The settings that the options change are those that run.json holds under the lock, whatever it held before.
        """
        if self.new:
            Run.create(self.run.path, resume_text=resume_command, **_choices(self.run))
        run = recorded_run(self.run.path)
        with run.locked():
            run.update(**_choices(self.again().run))
            yield run


def _choices(run: Run) -> dict[str, Any]:
    """What options may change of a run."""
    return {name: getattr(run, name) for name in ("source", "also", "settings", "preset", "seed", "device", "memory", "viewer")}


def plan_run(path: Path, workflow: Workflow, options: Options) -> Plan:
    """The run in the folder `path` with these options; writes nothing. Raises BadInput and UsageError."""
    config = read_config(options.config) if options.config is not None else Config({})
    seed = options.seed if options.seed is not None else config.options.get("seed")
    device = options.device or config.options.get("device")
    if device is not None and device not in ("auto", "cpu", "cuda"):
        raise UsageError(f"--config {options.config}: device: found {device!r}, expected auto, cpu or cuda.")
    preset = options.preset or config.options.get("preset")
    new = not os.path.lexists(path / NAME)
    before = Run(path, resume_text=resume_command) if new else recorded_run(path)
    if new:
        before.check_free()  # before anything else: a wrong folder is the first thing to report
        if options.source is None:
            raise UsageError(f"{path}: no run is there. To begin one: enerf run SOURCE --out {path}")
        if preset is None:
            preset = "standard" if device != "cpu" and has_cuda() else "preview"
    warnings: list[str] = []
    settings = Settings(workflow.settings)
    if preset is not None:
        settings.put_table(read_preset(preset, workflow.presets).table, f"preset {preset}")
    elif dropped := settings.put_recorded(before.settings):
        warnings.append(f"settings that this version does not have are left out: {listed(dropped)}")
    settings.put_table(config.table, f"--config {options.config}")
    settings.put_table(options.table, "the manifest")
    for text in options.sets:
        settings.put_option(text)
    seed = before.seed if seed is None and options.preset is not None else seed
    if seed is not None:
        settings.put_seed(seed)
    for name, value, origin in _of_poses(options):
        if value is not None:
            settings.put("poses", name, [value], origin)
    sources = _sources([path for path in (options.source, *options.also) if path is not None], before)
    if options.budget is not None:
        values, names = settings.resolved(), [stage.name for stage in workflow.stages]
        makes = "splats" in names and values["splats"].make != "off"
        makes = makes and (options.until not in names or names.index(options.until) >= names.index("splats"))
        parts = share_budget(seconds_of(options.budget), train_share(sources, values["poses"]), splats=makes)
        for stage, seconds in parts.items():
            settings.put(stage, "time_budget", [seconds], f"--budget {options.budget}")
    if options.target_mib is not None:
        settings.put("bake", "max_mib", [options.target_mib], f"--target-mib {options.target_mib:g}")
    warnings += _without_effect(settings, config, options)
    memory, limit = _memory(options.memory, before, warnings)
    warnings += _beyond(limit if options.share is None else Limit(options.share, "its share of the worker's memory"), workflow.stages)
    run = Run(
        path,
        sources[0] if sources else None,
        table_of(settings.resolved()),
        preset=preset or before.preset, seed=before.seed if seed is None else seed, device=device or before.device or "auto",
        memory=memory, viewer=options.viewer or before.viewer, also=sources[1:], resume_text=resume_command,
    )  # fmt: skip
    return Plan(run, new, limit, warnings, lambda: plan_run(path, workflow, options))


STEPS = (("train", "iterations"), ("bake", "refine_steps"))  # settings that a time budget takes the place of


def _without_effect(settings: Settings, config: Config, options: Options) -> list[str]:
    """A warning for each number of steps that was set although a time budget decides it."""
    set_here = {text.partition("=")[0].strip() for text in options.sets}
    found = []
    for stage, name in STEPS:
        budget = settings.values[stage].get("time_budget", "off") if stage in settings.types else "off"
        if budget != "off" and (f"{stage}.{name}" in set_here or any(name in table.get(stage, {}) for table in (config.table, options.table))):
            remedy = "Leave out --budget" if options.budget is not None else f"Give {stage}.time_budget=off"
            found.append(f"{stage}.{name} has no effect: {stage}.time_budget={budget:g} s decides how many steps are taken. {remedy} to use it.")
    return found


def _of_poses(options: Options) -> tuple[tuple[str, object, str], ...]:
    """The settings of the stage poses that have options of their own: name, value or None, and the option."""
    return (
        ("format", options.format, f"--as {options.format}"),
        ("mask_from", options.mask_from, f"--mask {options.mask_from}"),
        ("mask_model", options.mask_model and os.path.abspath(options.mask_model), f"--mask-model {options.mask_model}"),
        *(
            (name, os.path.abspath(path), f"--features-model {' '.join(options.features_model or ())}")
            for name, path in zip(("features_model", "matcher_model"), options.features_model or (), strict=False)
        ),
        ("strict", options.strict or None, "--strict"),
        ("frames", options.frames, f"--frames {options.frames}"),
        ("lens", options.lens, f"--lens {options.lens}"),
        ("marker_size", options.marker_size and metres_of(options.marker_size), f"--marker-size {options.marker_size}"),
        ("allow_outside", options.allow_outside or None, "--allow-outside"),
    )


def _memory(given: str | None, before: Run, warnings: list[str]) -> tuple[int | None, Limit | None]:
    """The bytes to record, None where the machine decides, and the limit that holds now. Raises UsageError."""
    recorded = before.memory if given is None else None
    asked = None if given in (None, "auto") else parse_size(given)
    here, limit = limit_for(None, None), limit_for(asked, recorded)
    if asked is not None and here is not None and asked > here.bytes:
        warnings.append(f"--memory {given}: {here.whose} leaves {size_text(here.bytes)}; what takes more may be ended by the system")
    return asked or recorded, limit


def _beyond(limit: Limit | None, stages: Sequence[Stage]) -> list[str]:
    """Warnings of what a run takes whatever its limit: to compile kernels, once for a machine, and to write its pages."""
    if limit is None or not any(stage.uses_device for stage in stages):
        return []
    found = []
    if limit.bytes < COMPILING and not are_compiled():
        found.append(
            f"{limit.whose}: {size_text(limit.bytes)}, and kernels are compiled in this run, once for this machine, which takes up to {size_text(COMPILING)}."
            " Where that is too much, run a small scene (--preset tiny) with more memory first."
        )
    if limit.bytes < PAGES:
        found.append(f"{limit.whose}: {size_text(limit.bytes)}, and writing the pages of a run takes up to {size_text(PAGES)}")
    return found


def _sources(given: Sequence[Path], before: Run) -> tuple[Path, ...]:
    """The sources to record. They cannot change once poses have been made of them, unless they no longer exist."""
    recorded = tuple(before.sources.values())
    if not given:
        return recorded
    for path in given:
        _check_source(path)
    sources = tuple(Path(os.path.abspath(path)) for path in given)
    real = [os.path.realpath(path) for path in sources]
    if len(set(real)) < len(real) or len(real) > MOST_SOURCES:
        raise UsageError(f"{listed([str(path) for path in given])}: a source was given twice, or more than {MOST_SOURCES}. Give each once.")
    unchanged = not recorded or real == [os.path.realpath(path) for path in recorded]
    if not unchanged and before.folder("poses").exists() and all(path.exists() for path in recorded):
        was, now = (listed([str(path) for path in paths]) for paths in (recorded, sources))
        remedy = f"Give a new folder for another source, or go on: {before.how_to_resume()}"
        raise UsageError(f"{before.path}: was made from {was}, not from {now}. {remedy}")
    return sources


def _check_source(given: Path) -> None:
    """BadInput for what is no source at all."""
    if not given.exists():
        raise BadInput(f"{given}: no such file or folder. Give the folder of the photographs or of the data set, or a video.")
    if not given.is_dir() and given.suffix.lower() not in SUFFIXES:
        kinds = f"the folder of the photographs or of the data set, or a video ({KNOWN})"
        raise BadInput(f"{given}: is a file; expected {kinds}. Give {given.absolute().parent}")
    if given.is_dir() and not os.listdir(given):
        raise BadInput(f"{given}: the folder is empty; expected photographs or a data set.")
