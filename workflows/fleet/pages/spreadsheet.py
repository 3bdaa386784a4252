"""FLEET/fleet.csv: a line a scene."""

import csv
import io
import json
from typing import Any

from pipeline.fleet.state import FleetState, SceneState
from pipeline.text import printable
from workflows.fleet.pages.index import quality_of

NAME = "fleet.csv"
COLUMNS = (
    "name", "state", "stage", "psnr", "ssim", "seconds", "bytes", "cameras", "result", "warnings", "attempts", "reason", "worker", "run", "sources", "preset",
    "seed",
)  # fmt: skip
_FORMULA = ("=", "+", "-", "@")  # what spreadsheets take for a formula


def fleet_csv(state: FleetState) -> str:
    """The table, in CSV as RFC 4180 has it. After COLUMNS, a column for each setting of a sweep.

    Numbers are unrounded. Text that a spreadsheet would take for a formula has an apostrophe before it.
    """
    sweep = sorted({setting for scene in state.scenes for setting in scene.sweep or {}})
    out = io.StringIO(newline="")
    rows = csv.writer(out)
    rows.writerow([*COLUMNS, *map(_cell, sweep)])
    for scene in state.scenes:
        rows.writerow([*map(_cell, _row(scene)), *(_cell((scene.sweep or {}).get(setting)) for setting in sweep)])
    return out.getvalue()


def _row(scene: SceneState) -> list[Any]:
    quality = quality_of(scene)
    cameras, result = (None if each is None else each.grade for each in (scene.verdict, scene.result))
    return [
        scene.name, scene.state, scene.stage, quality["psnr"], quality["ssim"], scene.seconds, scene.bytes, cameras, result, len(scene.warnings),
        scene.attempts, scene.reason, scene.worker, scene.run, " ".join(scene.sources), scene.preset, scene.seed,
    ]  # fmt: skip


def _cell(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, int | float) and not isinstance(value, bool):
        return repr(value)
    text = printable(value if isinstance(value, str) else json.dumps(value))
    return f"'{text}" if text.startswith(_FORMULA) else text
