"""RUN/viewer.html: the page that shows what the run made in a browser. Like the report it belongs to no stage and can be made again."""

import os
from contextlib import suppress
from pathlib import Path

from efficientnerf.asset.format import FormatError, contents, load, serialize
from efficientnerf.geometry.cameras import Camera
from pipeline.errors import PipelineError
from pipeline.run import NAME, Run, cannot_write
from stages.artifacts import BakeOutputs, MeshOutputs, PosesOutputs, SplatsOutputs, TrainOutputs
from stages.framing import true_frame
from stages.mesh.files import read_vertices
from stages.viewer.captured import captured_views
from stages.viewer.page import compact_bytes, splats_page, viewer_page
from workflows.report.signature import ASSET_VIEWER, VIEWER, is_newer, is_own, viewers, write_page


def write_run_viewer(run: Run, *, anew: bool = False) -> Path | None:
    """Write the run's `viewers` atomically, where one is missing, not this program's own or older than what it shows, or `anew`; returns the first one's path.

    None, and no page, for a run without a sound asset, for damaged Gaussians, and for files too large for a page that is made by itself. Raises DiskFull,
    and BadInput where the folder cannot be written.
    """
    shown, path = viewers(run), run.path / VIEWER
    for name in (VIEWER, ASSET_VIEWER):
        page = run.path / name
        try:
            if name not in shown:
                page.unlink(missing_ok=True)
            elif anew or not is_newest(run, page):
                write_viewer_of(run.path, shown[name], page, ASSET_VIEWER if name == VIEWER and ASSET_VIEWER in shown else None)
        except FormatError:  # `enerf verify` says what is wrong
            page.unlink(missing_ok=True)
        except OSError as error:
            raise cannot_write(page, error) from error
    return path if os.path.lexists(path) else None


def write_viewer_of(run: Path, shown: Path, target: Path, other: str | None = None) -> None:
    """Write the page of a run's asset or its Gaussians, signed. Raises FormatError and OSError.

    other  the page of the asset, next to that of the Gaussians
    """
    cameras, photographs = captured(run)
    title, box = os.path.basename(os.path.abspath(run)), _box_of(run)
    if shown == SplatsOutputs.of_run(run).spz:
        metadata = contents(BakeOutputs.of_run(run).asset)[0]
        page = splats_page(shown.read_bytes(), metadata, cameras=cameras, photographs=photographs, title=title, asset=other, true=_frame_of(run), box=box)
    else:
        page = viewer_page(page_bytes(run, shown), cameras=cameras, photographs=photographs, title=title, box=box)
    write_page(target, page)


def page_bytes(run: Path, asset: Path) -> bytes:
    """The bytes of a run's asset that its page holds, in the frame that `enerf measure` found. Raises FormatError."""
    frame = _frame_of(run)
    if frame is None:
        return compact_bytes(asset)
    tree = load(asset)
    return serialize(tree.with_metadata(**frame.metadata(tree.metadata)), "compact")


def _frame_of(run: Path) -> true_frame.TrueFrame | None:
    """The frame that was found for the run; none where its file is damaged: the page shows the scene even so."""
    with suppress(PipelineError):
        return true_frame.load_frame(run)
    return None


def _box_of(run: Path) -> list[list[float]] | None:
    """The corners of the box round the run's mesh, in the frame of exports; None where there is no sound mesh."""
    with suppress(PipelineError):
        mesh = MeshOutputs.of_run(run)
        if mesh.ply.is_file() and len(vertices := read_vertices(mesh)[0]):
            placed = (_frame_of(run) or true_frame.AS_CAPTURED).from_capture.points(vertices)
            return [placed.min(0).tolist(), placed.max(0).tolist()]
    return None


def captured(run: Path) -> tuple[list[Camera], dict[str, bytes]]:
    """Cameras and photographs of the run in this folder, as `stages.viewer.page` takes them; none where they are missing or damaged."""
    with suppress(PipelineError):
        return captured_views(PosesOutputs.of_run(run).folder, TrainOutputs.of_run(run).folder)
    return [], {}


def is_newest(run: Run, path: Path) -> bool:
    """Whether the page is our own, and none of the artifacts that it shows was published after it."""
    stages = (BakeOutputs.stage, MeshOutputs.stage, SplatsOutputs.stage, PosesOutputs.stage, TrainOutputs.stage)
    shown = [run.path / NAME, run.path / true_frame.NAME, *map(run.folder, stages)]  # run.json says what is to be shown
    return is_newer(path, shown) and is_own(path)
