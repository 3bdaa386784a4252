"""A page about a run, RUN/report.html: renders, figures and settings.

It refers to the images of the run by relative paths, so that the run may be moved. It belongs to no stage's artifact and can be made again. No script,
nothing from the network. The template is report.html.j2.
"""

import functools
import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any
from urllib.parse import quote

import jinja2
from markupsafe import Markup

from pipeline.decide import Decision, survey
from pipeline.errors import PipelineError
from pipeline.run import Run, cannot_write
from pipeline.stage import Stage
from pipeline.text import printable
from stages.reports import CameraVerdict, PosesReport
from workflows.cli.output import plain
from workflows.cli.progress import duration, size
from workflows.measuring import Measured, how_to_turn_upright, measured, sides_in_words, sides_of, unit_in_words
from workflows.report import documents
from workflows.report.documents import Damaged, MeshQuality, Metrics, Quality, ResultVerdict
from workflows.report.signature import size_of, write_page
from workflows.report.summary import BAKE, EVALUATE, MESH, POINTS, POSES, RUN, SPLATS, TRAIN, TURNTABLE, against_network, quality_in_words, split_of

NAME = "report.html"
VIEWER = RUN / "viewer.html"
DOWNLOADS = (
    (BAKE.asset, "the baked asset"),
    (VIEWER, "the asset in a browser, to walk around; one file, offline"),
    (TURNTABLE.video, "turntable, H.264"),
    (MESH.glb, "mesh with its texture, y up"),
    (MESH.obj, "mesh, the capture's frame"),
    (MESH.material, "its material"),
    (MESH.texture, "its texture"),
    (MESH.ply, "mesh with colours of its vertices, the capture's frame"),
    (POINTS.ply, "point cloud"),
    (SPLATS.ply, "3D Gaussians, the capture's frame"),
    (SPLATS.spz, "3D Gaussians in few bytes, y up"),
    (POSES.scene, "cameras and splits"),
    (EVALUATE.captured_path, "the asset along the captured cameras, H.264"),
    (EVALUATE.metrics, "all figures"),
    (EVALUATE.verdict, "the verdict on the result"),
)
TEMPLATE = "report.html.j2"
# The pictures that a verdict on a result refers to: no other path of an untrusted file is a link.
SHOWN = (EVALUATE.strip_worst, EVALUATE.strip_median, EVALUATE.contact_sheet, EVALUATE.sparse_points, MESH.check, SPLATS.preview, POSES.cameras)
ATTEMPTS = 5  # to find no stage replaced while the page was made
LONGEST = 1000  # characters of a text that is shown


def write_report(run: Run, stages: Sequence[Stage]) -> Path:
    """Write RUN/report.html atomically; returns its path. Raises DiskFull, and BadInput where the folder cannot be written.

    No lock is taken: where a stage is replaced meanwhile, the page is made again, so that all of it is of the same artifacts.
    """
    path = run.path / NAME
    for _ in range(ATTEMPTS):
        before = _published(run, stages)
        text = page(run, survey(stages, run))
        if _published(run, stages) == before:
            break
    try:
        write_page(path, text.encode("utf-8"))
    except OSError as error:
        raise cannot_write(path, error) from error
    return path


def _published(run: Run, stages: Sequence[Stage]) -> list[tuple[int, int] | None]:
    """Identifiers of the artifacts, which change with a replacement: a stage is published by a rename of its folder."""
    found: list[tuple[int, int] | None] = []
    for stage in stages:
        try:
            status = os.stat(run.folder(stage.name), follow_symlinks=False)
            found.append((status.st_ino, status.st_ctime_ns))
        except OSError:
            found.append(None)
    return found


@functools.cache
def _template() -> jinja2.Template:
    """Compiled once: a fleet's process writes many reports."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=_shown,
    )
    environment.filters["link"] = lambda name: quote(os.fsencode(name.as_posix()))
    environment.tests["there"] = jinja2.pass_context(lambda context, name: size_of(context["folder"] / name) is not None)
    return environment.get_template(TEMPLATE)


def page(run: Run, decisions: Sequence[Decision]) -> str:
    """The page as text; whatever names hold, it encodes in UTF-8."""
    folder = run.path
    damaged: list[str] = []
    found = _read(folder / EVALUATE.metrics, Metrics, damaged)
    made = [each.manifest for each in decisions if each.manifest is not None]
    inside = None
    with suppress(PipelineError):  # of a run whose cameras or frame cannot be read nothing is measured
        inside = measured(folder)
    return _template().render(
        folder=folder,
        name=folder.name,
        source=", ".join(map(str, run.sources.values())) or None,
        preset=run.preset,
        quality=quality_in_words(found),
        against=against_network(found),
        result=_result(folder, damaged),
        means=_means(found),
        strips=_strips(found),
        split=split_of(found),
        poses=POSES,
        train=TRAIN,
        bake=BAKE,
        evaluate=EVALUATE,
        turntable=TURNTABLE,
        mesh=MESH,
        splats=SPLATS,
        viewer=VIEWER,
        files=[{"name": name, "what": what, "size": size(count)} for name, what in DOWNLOADS if (count := size_of(folder / name)) is not None],
        views=_views(found),
        asset_report=_facts(folder, BAKE.report, damaged),
        mesh_report=_facts(folder, MESH.report, damaged),
        splats_report=_facts(folder, SPLATS.report, damaged),
        sides=_sides(folder, inside),
        upright=None if inside is None else how_to_turn_upright(folder, inside),
        previews=_previews(folder, TRAIN.previews),
        asset_previews=_previews(folder, BAKE.previews),
        cameras=_cameras(folder, damaged),
        verdict=_verdict(folder, damaged),
        damaged=damaged,
        stages=[_stage(each) for each in decisions],
        settings=run.settings,
        versions=made[-1].versions if made else {},
    )


def _stage(decision: Decision) -> tuple[str, ...]:
    """The row of a stage."""
    made = decision.manifest
    cost = ("", "", "") if made is None else (duration(made.seconds), size(made.size), size(made.peak_memory) if made.peak_memory else "")
    return (decision.stage, decision.state, *cost, decision.reason or decision.note or "")


def _shown(value: Any) -> Any:
    """A value as the page shows it: text without control characters, of bounded length."""
    if isinstance(value, Markup) or value is None or isinstance(value, bool | float):
        return value
    return printable(value if isinstance(value, str) else plain(value), LONGEST)


def _previews(folder: Path, previews: Path) -> list[Path]:
    names: list[str] = []
    with suppress(OSError):
        names = sorted(name for name in os.listdir(folder / previews) if name.endswith(".png"))
    return [previews / name for name in names]


def _read(path: Path, kind: type[Any], damaged: list[str]) -> Any:
    """A document of the run, or None where there is none, or where it joins the damaged ones: a damaged run gets its page, too."""
    try:
        found = documents.read(path, kind)
    except Damaged as error:
        damaged.append(str(error))
        return None
    return None if found is None else found[0]


def _cameras(folder: Path, damaged: list[str]) -> dict[str, Any] | None:
    """Facts from the report of the poses stage: a sentence, the images that were not used, warnings."""
    report: PosesReport | None = _read(folder / POSES.report, PosesReport, damaged)
    if report is None:
        return None
    text = f"{len(report.registered or [])} views"
    if report.reprojection_error is not None:
        text += f", mean reprojection error {report.reprojection_error:.2f} px"
    return {"text": text, "rejected": [(each.name, each.reason) for each in report.rejected or []], "warnings": report.warnings or []}


def _sides(folder: Path, inside: Measured | None) -> list[str]:
    """How large the mesh is and in which unit, or how to get one."""
    if inside is None:
        return []
    with suppress(PipelineError):
        found = sides_of(folder, inside)
        known = [f"Lengths are in metres, within {inside.error:.2g} of each (99 %)."] if inside.metric and inside.error is not None else []
        return [*([] if found is None else [f"The mesh: {sides_in_words(found)}."]), *known, *unit_in_words({"unit": inside.unit, "scale_error": inside.error})]
    return []


def _result(folder: Path, damaged: list[str]) -> dict[str, Any] | None:
    """The verdict on the result: its grade, a sentence, and a row for each problem with the picture that shows it."""
    found: ResultVerdict | None = _read(folder / EVALUATE.verdict, ResultVerdict, damaged)
    if found is None:
        return None
    pictures = {name.as_posix(): name for name in SHOWN}
    rows = [(each.grade, each.sentence, f"{each.cause} {each.remedy}", pictures.get(each.picture)) for each in found.problems]
    return {"grade": found.grade, "summary": found.summary, "problems": rows}


def _verdict(folder: Path, damaged: list[str]) -> dict[str, Any] | None:
    """The verdict on the cameras: a sentence, and a row for each problem."""
    found: CameraVerdict | None = _read(folder / POSES.verdict, CameraVerdict, damaged)
    if found is None:
        return None
    return {"summary": found.summary, "problems": [(each.grade, each.sentence, each.remedy) for each in found.problems]}


def _figures(quality: Quality | None, sign: str = "") -> tuple[str, str]:
    """PSNR and SSIM as text."""
    psnr, ssim = (None, None) if quality is None else (quality.psnr, quality.ssim)
    return "" if psnr is None else f"{psnr:{sign}.2f}", "" if ssim is None else f"{ssim:{sign}.3f}"


def _share(share: float | None) -> str:
    return "" if share is None else f"{100 * share:.2f}"


def _views(found: Metrics | None) -> list[tuple[str, ...]]:
    """A row of figures for each view that was measured."""
    views = found.views if found is not None else []
    return [
        (view.name, *_figures(view.network), *_figures(view.asset), _figures(view.mesh)[0], _figures(view.gap, "+")[0], _share(view.holes),
         _share(view.floaters)) for view in views
    ]  # fmt: skip


def _means(found: Metrics | None) -> list[tuple[str, ...]]:
    """A row of means for each of what was measured: PSNR, SSIM, PSNR with fitted colours."""
    if found is None:
        return []
    mesh = found.mesh or MeshQuality()
    rows = (("network", found.network, ""), ("asset", found.asset, ""), ("mesh, unlit, before the asset's surroundings", mesh, ""),
            ("mesh in the colours of its vertices", Quality(mesh.psnr_vertex_colours, mesh.ssim_vertex_colours), ""),
            ("mesh, on the pixels that it covers", Quality(mesh.psnr_covered), ""), ("asset, on the same pixels", Quality(mesh.asset_psnr_covered), ""),
            ("3D Gaussians", found.splats, ""), ("asset minus network, on the same pixels", found.gap, "+"),
            ("asset's innermost box before the network's surroundings", found.asset_with_network_background, ""))  # fmt: skip
    return [
        (name, *_figures(quality, sign), "" if quality.psnr_colour_fitted is None else f"{quality.psnr_colour_fitted:{sign}.2f}")
        for name, quality, sign in rows if quality is not None and quality.psnr is not None
    ]  # fmt: skip


def _strips(found: Metrics | None) -> list[tuple[Path, str]]:
    """Each strip with its caption; those that metrics.json does not name have none."""
    named = {strip.which: strip for strip in (found.strips if found is not None else [])}
    entries = []
    for which, path in (("worst", EVALUATE.strip_worst), ("median", EVALUATE.strip_median), ("best", EVALUATE.strip_best)):
        strip, caption = named.get(which), f"The {which} view"
        if strip is not None:
            network, asset, mesh = (", ".join(f"{value} {unit}" for value, unit in zip(_figures(q), ("dB", "SSIM"), strict=True) if value) for q in
                                    (strip.network, strip.asset, strip.mesh))  # fmt: skip
            caption += f", {strip.view}: photograph | network {network} | asset {asset}" + (f" | mesh {mesh}" if mesh else "")
        entries.append((path, caption))
    return entries


def _facts(folder: Path, name: Path, damaged: list[str]) -> dict[str, Any]:
    """The plain entries of a stage's report, and its name."""
    found = _read(folder / name, dict[str, Any], damaged) or {}
    return {"name": name.as_posix(), "rows": [(key.replace("_", " "), value) for key, value in found.items() if isinstance(value, (str, int, float, bool))]}
