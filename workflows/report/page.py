"""A page about a run, RUN/report.html: renders, figures and settings.

It refers to the images of the run by relative paths, so that the run may be moved. It belongs to no stage's artifact and can be made again. No script,
nothing from the network. The template is report.html.j2.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import jinja2

from stages.artifacts import BakeOutputs, EvaluateOutputs, MeshOutputs, PointsOutputs, PosesOutputs, TrainOutputs, TurntableOutputs
from workflows.cli.progress import duration, size
from workflows.report.summary import metrics, quality_in_words, split_of

if TYPE_CHECKING:
    from pipeline.decide import Decision
    from pipeline.run import Run

NAME = "report.html"
RUN = Path()  # names are relative to the page
POSES, TRAIN, BAKE, EVALUATE = PosesOutputs.of_run(RUN), TrainOutputs.of_run(RUN), BakeOutputs.of_run(RUN), EvaluateOutputs.of_run(RUN)
TURNTABLE, MESH, POINTS = TurntableOutputs.of_run(RUN), MeshOutputs.of_run(RUN), PointsOutputs.of_run(RUN)
DOWNLOADS = (
    (BAKE.asset, "the baked asset"),
    (TURNTABLE.video, "turntable, H.264"),
    (MESH.glb, "mesh, y up"),
    (MESH.ply, "mesh, the capture's frame"),
    (POINTS.ply, "point cloud"),
    (POSES.scene, "cameras and splits"),
    (EVALUATE.metrics, "all figures"),
)
TEMPLATE = "report.html.j2"


def write_report(run: Run, decisions: Sequence[Decision]) -> Path:
    """Write RUN/report.html atomically; returns its path. Raises DiskFull, and BadInput where the folder cannot be written."""
    from pipeline.files import write_atomically
    from pipeline.run import cannot_write

    path = run.path / NAME
    try:
        write_atomically(path, page(run, decisions).encode("utf-8"))
    except OSError as error:
        raise cannot_write(path, error) from error
    return path


def page(run: Run, decisions: Sequence[Decision]) -> str:
    """The page as text."""
    folder = run.path
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent), autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters["link"] = lambda name: quote(name.as_posix())
    environment.tests["there"] = lambda name: (folder / name).is_file()
    found = metrics(folder)
    made = [each.manifest for each in decisions if each.manifest is not None]
    return environment.get_template(TEMPLATE).render(
        name=folder.name,
        source=run.source,
        preset=run.preset,
        quality=quality_in_words(found),
        split=split_of(found),
        poses=POSES,
        train=TRAIN,
        evaluate=EVALUATE,
        turntable=TURNTABLE,
        mesh=MESH,
        files=[{"name": name, "what": what, "size": size((folder / name).stat().st_size)} for name, what in DOWNLOADS if (folder / name).is_file()],
        views=_views(found),
        asset_report=_facts(folder, BAKE.report),
        mesh_report=_facts(folder, MESH.report),
        previews=[TRAIN.previews / path.name for path in sorted((folder / TRAIN.previews).glob("*.png"))],
        cameras=_cameras(folder),
        stages=[_stage(each) for each in decisions],
        settings=run.settings,
        versions=made[-1].versions if made else {},
    )


def _stage(decision: Decision) -> tuple[str, ...]:
    """The row of a stage."""
    made = decision.manifest
    cost = ("", "", "") if made is None else (duration(made.seconds), size(made.size), size(made.peak_memory) if made.peak_memory else "")
    return (decision.stage, decision.state, *cost, decision.reason or decision.note or "")


def _json(path: Path) -> Any:
    """A JSON file's value, or None where it cannot be read: the page of a damaged run can be made too."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


def _cameras(folder: Path) -> dict[str, Any] | None:
    """Facts from the report of the poses stage: a sentence, the images that were not used, warnings."""
    report = _json(folder / POSES.report)
    if not isinstance(report, dict):
        return None
    text = f"{len(report.get('registered') or [])} views"
    if isinstance(error := report.get("reprojection_error"), (int, float)):
        text += f", mean reprojection error {error:.2f} px"
    rejected = [(each.get("name", ""), each.get("reason", "")) for each in report.get("rejected") or [] if isinstance(each, dict)]
    return {"text": text, "rejected": rejected, "warnings": report.get("warnings") or []}


def _views(found: dict[str, Any] | None) -> list[tuple[str, ...]]:
    """A row of figures for each view that was measured."""
    views = (found or {}).get("views")

    def figure(view: dict[str, Any], who: str, what: str, digits: int) -> str:
        value = (view.get(who) or {}).get(what)
        return f"{value:.{digits}f}" if isinstance(value, (int, float)) else ""

    return [
        (view.get("name", ""), *(figure(view, who, what, digits) for who in ("network", "asset") for what, digits in (("psnr", 2), ("ssim", 3))))
        for view in (views if isinstance(views, list) else [])
        if isinstance(view, dict)
    ]


def _facts(folder: Path, name: Path) -> dict[str, Any]:
    """The plain entries of a stage's report, and its name."""
    found = _json(folder / name)
    plain = found.items() if isinstance(found, dict) else ()
    return {"name": name.as_posix(), "rows": [(key.replace("_", " "), value) for key, value in plain if isinstance(value, (str, int, float, bool))]}
