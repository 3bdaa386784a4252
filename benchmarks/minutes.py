"""Rows of quality over minutes: their file, their table, their plot and their place in the README.

A row is a mapping: `method`, `set`, `minutes` and `options` name it; `code` is the version that it was measured with. The rest is figures, None where
there are none. Rows of several files (ours, peers') are shown in one table.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.machine import hardware
from efficientnerf.evaluation.metrics import psnr, ssim
from pipeline.files import read_json, write_json
from stages.figures.plots import with_palette

OURS = "efficientnerf"
OTHERS = 0.1  # cores that other programs may take of a row that counts as undisturbed
NAMED_BY = ("method", "set", "minutes", "options")
COLUMNS = ("scene", "method", "minutes", "PSNR / dB", "SSIM", "MB", "peak MiB", "seconds", "pixels")
BEGIN, END = "<!-- begin quality over minutes -->", "<!-- end quality over minutes -->"


def mean_quality(pairs: Sequence[tuple[np.ndarray, np.ndarray]], whole: bool = True) -> dict[str, Any]:
    """Means over renders and their photographs, (H, W, 3) from 0 to 1; SSIM of whole images alone."""
    return {
        "psnr": math.fsum(psnr(*pair) for pair in pairs) / len(pairs),
        "ssim": math.fsum(ssim(*pair) for pair in pairs) / len(pairs) if whole else None,
        "views": len(pairs),
    }


def read_rows(path: Path) -> list[dict[str, Any]]:
    """The rows of a file; none where it is not there."""
    return list(read_json(path)["rows"]) if path.exists() else []


def same_row(one: Mapping[str, Any], two: Mapping[str, Any]) -> bool:
    return all(one[key] == two[key] for key in NAMED_BY)


def with_row(rows: Iterable[Mapping[str, Any]], row: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The rows, one of which the new row takes the place of; sorted by what names them."""
    kept = [dict(other) for other in rows if not same_row(other, row)]
    return sorted([*kept, dict(row)], key=lambda r: (r["set"], r["method"] != OURS, r["method"], r["options"], r["minutes"]))


def write_rows(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """The file of the rows, with the machine; replaced whole."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, {"machine": hardware("cpu"), "rows": list(rows)})


def in_markdown(rows: Sequence[Mapping[str, Any]]) -> str:
    """The table: a line for each row, and what differs between rows as notes below it."""
    lines = [f"| {' | '.join(COLUMNS)} |", "|---" * len(COLUMNS) + "|"]
    lines += [f"| {' | '.join(_cells(row))} |" for row in rows]
    versions = {row["code"] for row in rows if row["method"] == OURS}
    if len(versions) > 1:
        lines += ["", f"Rows of {OURS} were measured with {len(versions)} versions of the code: {', '.join(sorted(versions))}."]
    disturbed = [row for row in rows if (row.get("others") or 0) > OTHERS]
    if disturbed:
        names = ", ".join(f"{row['set']} {row['minutes']:g} ({row['others']:.1f})" for row in disturbed)
        lines += ["", f"So many cores were busy with other work meanwhile: {names}."]
    loaded = [row for row in rows if row.get("others") is None and row["load"][0] > 0.5]
    if loaded:
        names = ", ".join(f"{row['set']} {row['minutes']:g}" for row in loaded)
        lines += ["", f"Other work was running at the beginning of: {names}."]
    return "\n".join(lines) + "\n"


def _cells(row: Mapping[str, Any]) -> list[str]:
    def number(key: str, digits: int) -> str:
        return "" if row[key] is None else f"{row[key]:,.{digits}f}"

    method = f"{row['method']} ({row['options']})" if row["options"] else row["method"]
    return [
        row["set"], method, f"{row['minutes']:g}", number("psnr", 2), number("ssim", 4), number("megabytes", 1), number("peak_mib", 0), number("seconds", 0),
        f"{row['views']} views" + (f", every {row['stride']}th in x and y" if row["stride"] > 1 else ""),
    ]  # fmt: skip


def plot(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """PSNR over minutes: a line for each scene and method."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    lines: dict[str, list[tuple[float, float]]] = {}
    for row in rows:
        if row["psnr"] is not None:
            name = row["set"] if row["method"] == OURS else f"{row['set']}, {row['method']}"
            lines.setdefault(f"{name} {row['options']}".strip(), []).append((row["minutes"], row["psnr"]))
    figure = Figure(figsize=(7, 4.5), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for name, points in lines.items():
        axes.plot(*zip(*sorted(points), strict=True), "o-" if "," not in name else "s--", label=name)
    axes.set_xscale("log")
    ticks = sorted({row["minutes"] for row in rows})
    axes.set_xticks(ticks, [f"{minutes:g}" for minutes in ticks])
    axes.minorticks_off()
    axes.set(xlabel="minutes of training, all of it", ylabel="PSNR of test views / dB")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=7)
    figure.savefig(path, metadata={"Software": None})
    with_palette(path)


def put_between_marks(text: str, table: str) -> str:
    """A document whose part between the marks is replaced by the table. Raises ValueError where there is not one pair of marks."""
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end or BEGIN in after or END in before:
        raise ValueError(f"expected the lines {BEGIN} and {END}, once each and in this order")
    return f"{before}{BEGIN}\n\n{table}\n{END}{after}"


def show(files: Sequence[Path], name: str, out: Path, readme: Path | None) -> None:
    """Write the table and the plot of all rows of some files, and put the table into a document."""
    rows: list[dict[str, Any]] = []
    for path in files:
        for row in read_rows(path):
            rows = with_row(rows, row)
    if not rows:
        return
    table = in_markdown(rows)
    (out / f"{name}.md").write_text(f"# Quality over minutes on a CPU\n\n{table}", encoding="utf-8")
    plot(out / f"{name}.png", rows)
    if readme is not None:
        readme.write_text(put_between_marks(readme.read_text(encoding="utf-8"), table), encoding="utf-8")
