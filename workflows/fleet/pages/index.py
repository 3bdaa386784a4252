"""FLEET/index.html: all scenes of a fleet on one page, rewritten as the fleet goes on.

The page is one file with its script, and asks for nothing but the thumbnails in FLEET/thumbnails/, which a browser loads as they come into sight, and the
turntable of the scene that is pointed at. Names and messages are text, whatever they hold.
"""

import functools
import json
from collections.abc import Container, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any
from urllib.parse import quote

import jinja2
from markupsafe import Markup

from pipeline.fleet.state import FleetState, SceneState
from pipeline.text import printable
from stages.artifacts import TurntableOutputs
from stages.viewer.html import json_for_html, policy_hash
from workflows.report.page import NAME as REPORT

NAME = "index.html"
FOLDER = Path(__file__).parent
THUMBNAILS = "thumbnails"
LONGEST = 300  # characters of a value that is shown


def index_page(
    state: FleetState, *, title: str, pictures: Mapping[str, int] | None = None, reports: Container[str] = (), comparison: str | None = None
) -> str:
    """The page as text.

    pictures    scene -> when its thumbnail was made, nanoseconds; others have none
    reports     scenes whose report is there
    comparison  the page of a sweep, where there is one
    """
    facts = {
        "state": state.state,
        "running": state.state == "running",
        "started": printable(state.started),
        "updated": printable(state.updated),
        "forecast": state.forecast_seconds,
        "executor": printable(state.executor),
        "note": printable(state.note or "", LONGEST),
        "slots": state.slots,
        "totals": asdict(state.totals),
        "seconds": sum(stage.seconds for scene in state.scenes for name, stage in scene.stages.items() if name not in scene.shares),
        "bytes": sum(scene.bytes for scene in state.scenes),
        "sweep": sorted({setting for scene in state.scenes for setting in scene.sweep or {}}),
        "scenes": [_scene(scene, (pictures or {}).get(scene.name), reported=scene.name in reports) for scene in state.scenes],
    }
    return filled("index.html.j2", "index.js", title=title, facts=facts, comparison=comparison)


def filled(template: str, script: str | None = None, *, title: str, facts: Any = None, **more: Any) -> str:
    """A page of a template with the style of all of them and, where it has any, a script and the facts that it shows."""
    style = (FOLDER / "page.css").read_text(encoding="utf-8")
    if script is not None:
        code = (FOLDER / script).read_text(encoding="utf-8")
        more |= {"script": Markup(code), "script_hash": policy_hash(code), "data": Markup(json_for_html(facts))}
    return _environment().get_template(template).render(title=printable(title, 200), style=Markup(style), style_hash=policy_hash(style), **more)


@functools.cache
def _environment() -> jinja2.Environment:
    """Cached: it keeps compiled templates, and pages are written often."""
    return jinja2.Environment(loader=jinja2.FileSystemLoader(FOLDER), autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True)


def _scene(scene: SceneState, picture: int | None, *, reported: bool) -> dict[str, Any]:
    """Data on a scene for the page's script."""
    quality, place = quality_of(scene), quote(scene.run)
    made = {name for name, stage in scene.stages.items() if stage.state == "done"}
    return {
        "name": scene.name,
        "state": scene.state,
        "stage": scene.stage,
        "worker": scene.worker,
        "reason": scene.reason and printable(scene.reason),
        "lines": [printable(line) for line in scene.last_lines],
        "warnings": [printable(line) for line in scene.warnings],
        "psnr": quality["psnr"],
        "ssim": quality["ssim"],
        "seconds": scene.seconds,
        "bytes": scene.bytes,
        "grade": scene.verdict and printable(scene.verdict.grade, 20),
        "summary": scene.verdict and printable(scene.verdict.summary),
        "result": scene.result and printable(scene.result.grade, 20),
        "result_summary": scene.result and printable(scene.result.summary),
        "sources": [printable(source, LONGEST) for source in scene.sources],
        "settings": _settings(scene),
        "stages": [(name, stage.state, stage.seconds) for name, stage in scene.stages.items()],
        "attempts": scene.attempts,
        "sweep": scene.sweep and {setting: _plain(value) for setting, value in scene.sweep.items()},
        "picture": None if picture is None else f"{THUMBNAILS}/{quote(scene.name)}.webp?{picture}",
        "video": f"{place}/{TurntableOutputs.of_run(Path()).video.as_posix()}" if TurntableOutputs.stage in made else None,
        "report": f"{place}/{REPORT}" if reported else None,
    }


def quality_of(scene: SceneState) -> dict[str, float | None]:
    """PSNR and SSIM of the scene's asset; of its field where it has none. Others may have written the figures."""
    for part in ("asset", "network"):
        found = scene.metrics.get(part)
        if isinstance(found, Mapping) and found.get("psnr") is not None:
            return {name: _number(found.get(name)) for name in ("psnr", "ssim")}
    return {"psnr": None, "ssim": None}


def _number(value: Any) -> float | None:
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e6 else None


def _settings(scene: SceneState) -> str:
    parts = [f"{stage}.{name}={value_text(value)}" for stage, table in scene.settings.items() for name, value in table.items()]
    return printable(", ".join([*([f"preset {scene.preset}"] if scene.preset else []), *parts]), 4 * LONGEST)


def value_text(value: Any) -> str:
    """A setting's value as the page shows it."""
    return printable(value if isinstance(value, str) else json.dumps(value), LONGEST)


def _plain(value: Any) -> Any:
    """A number, or text."""
    return value if isinstance(value, bool) or _number(value) is not None else value_text(value)
