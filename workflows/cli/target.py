"""Kinds of paths on the command line: a run, an asset, a stage's folder, a file of a known kind, or a data set."""

import shlex
from pathlib import Path

from pipeline.errors import BadInput
from pipeline.links import refuse_links
from pipeline.run import NAME, Resumption, Run
from stages.artifacts import BakeOutputs
from workflows.cli.options import workflow
from workflows.cli.resolve import Settings, table_of

ASSET = BakeOutputs.asset  # the file's name


def resume_command(run: Path, how: Resumption) -> str:
    """The command that resumes a run."""
    folder = shlex.quote(str(run))
    if how.only is not None:
        return f"enerf stage {how.only} {folder}" + (" --force" if how.force else "")
    options = "".join(f" --{option} {stage}" for option, stage in (("from", how.start), ("until", how.until)) if stage is not None)
    return f"enerf run{' SOURCE' if how.with_source else ''} --out {folder}{options}"


def recorded_run(path: Path) -> Run:
    """The run of a folder, whose messages name commands. Raises BadInput and CorruptArtifact."""
    return Run.open(path, resume_command, _stage_names())


def open_run(path: Path) -> Run:
    """The same without settings that this version does not have."""
    run = recorded_run(path)
    settings = Settings(workflow().settings)
    if settings.put_recorded(run.settings):
        run.settings = table_of(settings.resolved())
    return run


def _stage_names() -> frozenset[str]:
    return frozenset(stage.name for stage in workflow().stages)


def is_run(path: Path) -> bool:
    return (path / NAME).is_file()


def asset_of(path: Path) -> Path:
    """The asset file of a run, of its folder `bake`, or the file itself. Raises BadInput, and CorruptArtifact for a run that holds links."""
    if path.is_file():
        return path
    if not path.exists():
        raise BadInput(f"{path}: no such file or folder. Give a run or an asset ({ASSET}).")
    if is_run(path):
        refuse_links(path, _stage_names())
        found = BakeOutputs.of_run(path).asset
        if not found.is_file():
            raise BadInput(f"{path}: has no asset yet. Make it first: enerf run --out {path} --until bake")
        return found
    if (path / ASSET).is_file():
        return path / ASSET
    raise BadInput(f"{path}: neither a run (it has no {NAME}) nor an asset. Give a run or an asset ({ASSET}).")
