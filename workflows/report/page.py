"""A page about a run, for people who would rather look than read: RUN/report.html.

It is made from what the run holds and points to the pictures there by relative paths, so it may be opened from wherever the run is moved to. It
belongs to no stage's artifact: it can be thrown away and made again. No script, nothing from the network.
"""

from __future__ import annotations

import html
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from stages.artifacts import BakeOutputs, EvaluateOutputs, MeshOutputs, PointsOutputs, PosesOutputs, TrainOutputs, TurntableOutputs
from workflows.cli.progress import duration, size
from workflows.report.summary import metrics, quality_in_words

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
STYLE = """
:root { color-scheme: light dark; font: 15px/1.5 system-ui, sans-serif }
body { max-width: 72rem; margin: 2rem auto; padding: 0 1rem }
h1 { font-size: 1.5rem } h2 { font-size: 1.15rem; margin-top: 2.5rem; border-bottom: 1px solid #8885 }
table { border-collapse: collapse } td, th { padding: .2rem .9rem .2rem 0; text-align: left; vertical-align: top }
td.n, th.n { text-align: right; font-variant-numeric: tabular-nums }
p { max-height: 60rem; overflow: auto } img, video { max-width: 100%; height: auto; border-radius: 4px } video { background: #8882 }
.big { font-size: 1.1rem } .odd { color: #c60 } details { margin: .5rem 0 } summary { cursor: pointer }
.row { display: flex; flex-wrap: wrap; gap: .5rem } .row img { max-width: 24rem }
"""


def write_report(run: Run, decisions: Sequence[Decision]) -> Path:
    """Make RUN/report.html, whole or not at all; returns its path. Raises DiskFull, and BadInput where the folder can't be written."""
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
    found = metrics(folder)
    parts = [
        f"<h1>{_text(folder.name)}</h1>",
        f"<p>From {_text(run.source)}" + (f", preset {_text(run.preset)}" if run.preset else "") + "</p>",
        f'<p class="big">{_text(quality_in_words(found) or "not evaluated yet")}</p>',
        _looks(folder),
        _files(folder),
        _section("Held-back views", _picture(folder, EVALUATE.contact_sheet, "Truth, render and error") + _views(found)),
        _section("Asset", _facts(folder, BAKE.report)),
        _section("Mesh", _picture(folder, MESH.preview, "The mesh, coloured and plain") + _facts(folder, MESH.report)),
        _section("Training", _picture(folder, TRAIN.curve, "PSNR over steps") + _row(folder, TRAIN.previews, "Held-back view, truth left")),
        _section("Cameras", _cameras(folder) + _picture(folder, POSES.contact_sheet, "The photographs and what became of them")),
        _section("Stages", _stages(decisions)),
        _section("Settings", _settings(run.settings)),
        _section("Made with", _versions(decisions)),
    ]
    title = f"<title>{_text(folder.name)}</title>"
    head = f'<!doctype html><html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">{title}<style>{STYLE}</style></head>'
    return head + "<body>\n" + "\n".join(part for part in parts if part) + "\n</body></html>\n"


def _text(value: Any) -> str:
    return html.escape(str(value))


def _section(title: str, body: str) -> str:
    return f"<h2>{_text(title)}</h2>\n{body}" if body else ""


def _table(head: Sequence[str], rows: Iterable[Sequence[Any]], numbers: frozenset[int] = frozenset()) -> str:
    """`numbers` are the columns set to the right."""

    def cells(tag: str, values: Sequence[Any]) -> str:
        return "".join(f"<{tag}{' class=n' if n in numbers else ''}>{_text(value)}</{tag}>" for n, value in enumerate(values))

    return f"<table><tr>{cells('th', head)}</tr>" + "".join(f"<tr>{cells('td', row)}</tr>" for row in rows) + "</table>"


def _link(name: Path) -> str:
    return quote(name.as_posix())


def _picture(folder: Path, name: Path, caption: str) -> str:
    return f'<p><img src="{_link(name)}" alt="{_text(caption)}" title="{_text(caption)}"></p>' if (folder / name).is_file() else ""


def _row(folder: Path, name: Path, caption: str) -> str:
    pictures = sorted((folder / name).glob("*.png"))
    shown = "".join(f'<img src="{_link(name / each.name)}" alt="{_text(each.stem)}" title="{_text(each.stem)}">' for each in pictures)
    return f'<p>{_text(caption)}</p><div class="row">{shown}</div>' if shown else ""


def _looks(folder: Path) -> str:
    if not (folder / TURNTABLE.video).is_file():
        return ""
    return f'<p><video src="{_link(TURNTABLE.video)}" poster="{_link(TURNTABLE.poster)}" controls loop muted autoplay playsinline></video></p>'


def _files(folder: Path) -> str:
    there = [(name, what, (folder / name).stat().st_size) for name, what in DOWNLOADS if (folder / name).is_file()]
    rows = "".join(
        f'<tr><td><a href="{_link(name)}">{_text(name.as_posix())}</a></td><td>{_text(what)}</td><td class=n>{size(count)}</td></tr>'
        for name, what, count in there
    )
    return f"<h2>Files</h2>\n<table>{rows}</table>" if rows else ""


def _stages(decisions: Sequence[Decision]) -> str:
    rows = []
    for each in decisions:
        made = each.manifest
        cost = ("", "", "") if made is None else (duration(made.seconds), size(made.size), size(made.peak_memory) if made.peak_memory else "")
        rows.append((each.stage, each.state, *cost, each.reason or each.note or ""))
    return _table(("stage", "state", "time", "size", "peak memory", ""), rows, frozenset({2, 3, 4}))


def _json(path: Path) -> Any:
    """A JSON file's value, or None: a page can be made of a run that is damaged, too."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


def _cameras(folder: Path) -> str:
    report = _json(folder / POSES.report)
    if not isinstance(report, dict):
        return ""
    registered, rejected = report.get("registered") or [], report.get("rejected") or []
    parts = [f"{len(registered)} views"]
    if isinstance(error := report.get("reprojection_error"), (int, float)):
        parts.append(f"mean reprojection error {error:.2f} px")
    out = f"<p>{_text(', '.join(parts))}</p>"
    if rejected:
        rows = [(each.get("name", ""), each.get("reason", "")) for each in rejected if isinstance(each, dict)]
        out += '<p class="odd">Not used:</p>' + _table(("image", "why"), rows)
    if warnings := report.get("warnings"):
        out += "".join(f'<p class="odd">{_text(each)}</p>' for each in warnings)
    return out


def _views(found: dict[str, Any] | None) -> str:
    views = (found or {}).get("views")
    if not isinstance(views, list) or not views:
        return ""

    def figure(view: dict[str, Any], who: str, what: str, digits: int) -> str:
        value = (view.get(who) or {}).get(what)
        return f"{value:.{digits}f}" if isinstance(value, (int, float)) else ""

    rows = [
        (view.get("name", ""), *(figure(view, who, what, digits) for who in ("network", "asset") for what, digits in (("psnr", 2), ("ssim", 3))))
        for view in views
        if isinstance(view, dict)
    ]
    head = ("view", "network PSNR / dB", "network SSIM", "asset PSNR / dB", "asset SSIM")
    return f"<details><summary>{len(rows)} views, each</summary>{_table(head, rows, frozenset({1, 2, 3, 4}))}</details>"


def _facts(folder: Path, name: Path) -> str:
    found = _json(folder / name)
    if not isinstance(found, dict):
        return ""
    plain = [(key.replace("_", " "), value) for key, value in found.items() if isinstance(value, (str, int, float, bool))]
    return f"<details><summary>{_text(name.as_posix())}</summary>{_table(('', ''), plain, frozenset({1}))}</details>"


def _settings(settings: dict[str, dict[str, Any]]) -> str:
    tables = ((stage, _table(("setting", "value"), sorted(values.items()))) for stage, values in settings.items())
    return "".join(f"<details><summary>{_text(stage)}</summary>{table}</details>" for stage, table in tables)


def _versions(decisions: Sequence[Decision]) -> str:
    made = [each.manifest for each in decisions if each.manifest is not None]
    return f"<details><summary>versions</summary>{_table(('', ''), sorted(made[-1].versions.items()))}</details>" if made else ""
