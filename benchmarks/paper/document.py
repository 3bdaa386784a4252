"""`python -m benchmarks.paper`: the tables of the paper (EfficientNeRF, Hu et al., CVPR 2022), measured here, next to the paper's figures.

    OUT/table_N.md     for people
    OUT/table_N.json   {"table", "title", "scale", "columns", "rows", "notes", "hardware", "versions"}
    OUT/table_N.png    PSNR over training time, for the tables that train

A row is a mapping from column to value; a column that ends in PAPER holds what the paper printed for the column before it. A table is a function
from a Request to a Result, and TABLES says which; what trains keeps its runs under OUT/runs, so that a table that was interrupted goes on where it was.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from benchmarks.machine import hardware
from benchmarks.paper import tables
from benchmarks.paper.result import Request, Table
from benchmarks.paper.table7 import structures
from pipeline.errors import BadInput, UsageError
from pipeline.files import write_atomically, write_json
from pipeline.manifest import tool_versions
from stages.figures.plots import curve, with_palette

TABLES: dict[str, Table] = {
    "1": Table("Shares of valid and of pivotal samples", True, tables.shares),
    "2": Table("Quality and speed", True, tables.quality),
    "3": Table("Versions N1 to N4", True, tables.versions),
    "4": Table("Sizes of the coarse and of the fine network", True, tables.networks),
    "5": Table("The modules, one by one", True, tables.modules),
    "6": Table("Sampling strategies", True, tables.strategies),
    "7": Table("Structures that cache a scene: dense voxels, sparse tensor, octree, NerfTree", False, structures),
}


def make(number: str, request: Request, tables: Mapping[str, Table] = TABLES) -> dict[str, Path]:
    """Measure one table and write it; returns the files, by kind."""
    if number not in tables:
        raise UsageError(f"paper {number}: no such table. There are: {', '.join(tables)}.")
    table = tables[number]
    if table.needs_data and request.data is None:
        raise UsageError(f"paper {number}: is measured on scenes. Give --data DIR, a data set or a folder of data sets.")
    if request.data is not None and not request.data.is_dir():
        raise BadInput(f"{request.data}: no such folder. Give the folder of a data set, or of several.")
    request.out.mkdir(parents=True, exist_ok=True)
    result = table.measure(request)
    document = {
        "table": number,
        "title": table.title,
        "scale": request.scale,
        "columns": list(result.columns),
        "rows": [dict(row) for row in result.rows],
        "notes": list(result.notes),
        "hardware": hardware(request.device),
        "versions": {name: version for name, version in tool_versions() if name in ("efficientnerf", "torch", "numba")},
    }
    written = {"markdown": request.out / f"table_{number}.md", "json": request.out / f"table_{number}.json"}
    write_json(written["json"], document)
    write_atomically(written["markdown"], in_markdown(document).encode("utf-8"))
    if result.curves:
        written["plot"] = request.out / f"table_{number}.png"
        curve(written["plot"], result.curves, x_label="seconds of training", y_label="PSNR of test views / dB", title=f"Table {number}")
        with_palette(written["plot"])
    return written


def in_markdown(document: Mapping[str, Any]) -> str:
    """The table as Markdown: title, rows, notes, machine."""
    columns = document["columns"]
    lines = [f"# Table {document['table']}: {document['title']}", ""]
    if document["scale"] != 1:
        lines += [f"**Scaled by {document['scale']:g}**: iterations, resolution, networks and grids are smaller than in the paper; see the notes.", ""]
    lines += ["| " + " | ".join(columns) + " |", "|" + "---|" * len(columns)]
    lines += ["| " + " | ".join(shown(row.get(column)) for column in columns) + " |" for row in document["rows"]]
    lines += ["", *[f"- {note}" for note in document["notes"]], ""]
    machine = document["hardware"]
    libraries = ", ".join(f"{name} {version}" for name, version in document["versions"].items())
    lines.append(f"Measured on {machine['processor']}, {machine['cores']} cores, {machine['device']}; {libraries}.")
    lines.append("The paper: one RTX 3090.")
    return "\n".join(lines) + "\n"


def shown(value: Any) -> str:
    """A cell: numbers to four digits, nothing for None."""
    if value is None:
        return ""
    if isinstance(value, float):
        return f"{value:.4g}" if abs(value) < 1000 else f"{value:,.0f}"
    return str(value)
