"""3D Gaussians of a run or an asset as files: those of the run's stage `splats` where it has made the same, else made here."""

from dataclasses import replace
from pathlib import Path

from efficientnerf.splats.gaussians import Gaussians
from stages.artifacts import PosesOutputs, SplatsOutputs, TrainOutputs
from stages.formats.exporters import SPLAT_EXPORTERS
from stages.formats.exporters.splats.frames import in_capture, moved
from stages.formats.exporters.splats.ply import read_splats
from stages.formats.exporters.writing import SourceFrame, source_frame
from stages.framing.restriction import restricted
from stages.memory.need import refuse_more_than
from stages.splats.memory import needed
from stages.splats.run import gaussians_of
from stages.splats.settings import STAGE, SplatsSettings
from workflows.cli.resolve import Settings
from workflows.destination import writing
from workflows.exporting import Export, Progress, Written, frame_of, made_with
from workflows.loading import load_asset


def export_splats(export: Export, settings: Settings, progress: Progress) -> list[Written]:
    """The asset as 3D Gaussians. `settings` holds those of the stage splats."""
    files = export.of(SPLAT_EXPORTERS) if export.as_splats else []
    if not files:
        return []
    wanted = replace(settings.resolved()["splats"], make="on")
    wanted = replace(wanted, region=export.region or (wanted.region if export.crop is None else "all"))
    gaussians, frame = (None if export.crop is not None else _made_by_the_stage(export.what, wanted)) or _made(export, wanted, progress)
    written: list[Written] = []
    for path in files:
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
    if made_with(what, STAGE) != wanted:
        return None
    gaussians, (frame, true) = read_splats(SplatsOutputs.of_run(what).ply), frame_of(what)
    return gaussians if true is None else moved(gaussians, true.from_capture), frame
