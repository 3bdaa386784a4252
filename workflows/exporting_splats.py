"""3D Gaussians of a run or an asset as files: those of the run's stage `splats` where it has made the same, else made here."""

from dataclasses import replace
from pathlib import Path
from typing import Any

from efficientnerf.asset.format import describe
from efficientnerf.splats.gaussians import Gaussians
from pipeline.decide import decide
from pipeline.stage import settings_from
from stages.artifacts import BakeOutputs, PosesOutputs, SplatsOutputs, TrainOutputs
from stages.formats.exporters.splats.frames import in_capture, moved
from stages.formats.exporters.splats.ply import read_splats
from stages.formats.exporters.writing import SourceFrame, source_frame
from stages.framing.restriction import restricted
from stages.framing.true_frame import load_frame
from stages.memory.need import refuse_more_than
from stages.splats.memory import needed
from stages.splats.run import gaussians_of
from stages.splats.settings import STAGE, SplatsSettings
from workflows.cli.resolve import Settings
from workflows.cli.target import is_run, open_run
from workflows.destination import writing
from workflows.exporting import Export, Progress, Written
from workflows.loading import load_asset


def export_splats(export: Export, settings: Settings, progress: Progress) -> list[Written]:
    """The asset as 3D Gaussians. `settings` holds those of the stage splats."""
    if not export.splats:
        return []
    wanted = replace(settings.resolved()["splats"], make="on")
    wanted = replace(wanted, region=export.region or (wanted.region if export.crop is None else "all"))
    gaussians, frame = (None if export.crop is not None else _made_by_the_stage(export.what, wanted)) or _made(export, wanted, progress)
    written: list[Written] = []
    for path in export.splats:
        with writing(path, force=export.force):
            options = {"version": export.spz_version} if path.suffix.lower() == ".spz" else {}
            export.format(path)(gaussians, path, frame, **options)
        written.append({"path": str(path.absolute()), "Gaussians": len(gaussians), "bytes": path.stat().st_size})
    return written


def _made(export: Export, wanted: SplatsSettings, progress: Progress) -> tuple[Gaussians, SourceFrame]:
    """In the capture's frame."""
    tree = restricted(load_asset(export.what), wanted.region, export.crop)
    frame = source_frame(tree.metadata)
    captured = None
    if export.has_photographs and export.crop is None:
        captured = PosesOutputs.of_run(export.what).folder, TrainOutputs.of_run(export.what).folder
    refuse_more_than(export.limit, str(export.what), needed(tree, wanted, captured), f"Lower splats.count ({wanted.count}).")
    return in_capture(gaussians_of(tree, wanted, progress, captured), frame), frame


def _made_by_the_stage(what: Path, wanted: SplatsSettings) -> tuple[Gaussians, SourceFrame] | None:
    """The Gaussians that the run's stage `splats` has made, if those are what is wanted."""
    if not is_run(what):
        return None
    decision = decide(STAGE, open_run(what))
    if not decision.fresh or decision.manifest is None:
        return None
    made: Any = settings_from(SplatsSettings, decision.manifest.request.settings, where=STAGE.name)
    if made != wanted:
        return None
    gaussians, metadata, true = read_splats(SplatsOutputs.of_run(what).ply), describe(BakeOutputs.of_run(what).asset), load_frame(what)
    if true is None:
        return gaussians, source_frame(metadata)
    return moved(gaussians, true.from_capture), true.source_frame(metadata)
