"""Quality of an asset over its size: a run's field baked to several budgets in several layouts, evaluated on test views.

    python benchmarks/size_quality.py RUN [--sizes 1,2,5,10,20,40] [--layouts compact,packed] [--out benchmarks/results] [--set STAGE.NAME=VALUE]

RUN has to be trained; it is not changed. Each budget, in MB of 10^6 bytes (bake.max_mib is in MiB), is baked and evaluated in a copy beside it by the stages
themselves, with the run's other settings. Writes size_quality_NAME.json, .md and .png after each row, and keeps rows that the file has of other sizes; the
network's PSNR is of the views that the evaluate stage rendered.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any

from stage_runs import linked_copy, made, read_json

from stages.artifacts import BakeOutputs, EvaluateOutputs
from stages.figures.plots import with_palette
from workflows.paper.document import hardware, versions


def row_of(run: Path, layout: str, size: float, settings: dict[str, str]) -> dict[str, Any]:
    """Bake to at most `size` MB, evaluate, and read the figures."""
    took = made(run, "bake", {**settings, "bake.layout": layout, "bake.max_mib": repr(size * 1e6 / 2**20)})
    made(run, "mesh", {})
    made(run, "splats", {"splats.make": "off"})  # `evaluate` needs the stage
    made(run, "evaluate", {"evaluate.field_views": 1})
    report, metrics = read_json(BakeOutputs.of_run(run).report), read_json(EvaluateOutputs.of_run(run).metrics)
    stored = BakeOutputs.of_run(run).asset.stat().st_size / 1e6
    if stored > size:
        raise SystemExit(f"{size:g} MB: the asset has {stored:.2f} MB")
    return {
        "layout": layout,
        "max_mb": size,
        "mb": stored,
        "voxels": report["voxels"],
        "resolution": report["resolution"],
        "psnr": metrics["asset"]["psnr"],
        "ssim": metrics["asset"]["ssim"],
        "views": metrics["asset"]["views"],
        "baking": took,
    }


def in_markdown(name: str, rows: list[dict[str, Any]], network: float | None) -> str:
    columns = ("layout", "budget / MB", "file / MB", "voxels", "grid", "PSNR / dB", "SSIM", "baking / s")
    lines = [f"# Size and quality of the asset: {name}", "", f"| {' | '.join(columns)} |", "|---" * len(columns) + "|"]
    for row in rows:
        grid = " x ".join(str(n) for n in row["resolution"])
        figures = f"{row['psnr']:.2f} | {row['ssim']:.4f} | {row['baking']['seconds']:.0f}"
        lines.append(f"| {row['layout']} | {row['max_mb']:g} | {row['mb']:.2f} | {row['voxels']:,} | {grid} | {figures} |")
    lines += ["", f"PSNR over {rows[0]['views']} test views at full working size." + (f" The network: {network:.2f} dB." if network else "")]
    return "\n".join(lines) + "\n"


def plot(path: Path, rows: list[dict[str, Any]], network: float | None, name: str) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 4), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for layout in dict.fromkeys(row["layout"] for row in rows):
        chosen = [row for row in rows if row["layout"] == layout]
        axes.plot([row["mb"] for row in chosen], [row["psnr"] for row in chosen], "o-", label=layout)
    if network:
        axes.axhline(network, color="grey", linestyle="--", label="network")
    axes.set_xscale("log", base=2)
    budgets = sorted({row["max_mb"] for row in rows})
    axes.set_xticks(budgets, [f"{budget:g}" for budget in budgets])
    axes.set(xlabel="asset file / MB", ylabel="PSNR of test views / dB", title=name)
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(path, metadata={"Software": None})
    with_palette(path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--sizes", default="1,2,5,10,20,40", help="budgets in MB")
    parser.add_argument("--layouts", default="compact,packed", help="values of bake.layout")
    parser.add_argument("--out", type=Path, default=Path(__file__).resolve().parent / "results")
    parser.add_argument("--set", action="append", default=[], dest="sets", metavar="STAGE.NAME=VALUE")
    given = parser.parse_args()
    settings = dict(text.split("=", 1) for text in given.sets)
    name = given.run.resolve().name
    given.out.mkdir(parents=True, exist_ok=True)
    file = given.out / f"size_quality_{name}.json"
    rows = read_json(file)["rows"] if file.exists() else []
    with tempfile.TemporaryDirectory(prefix="sizes-", dir=given.run.resolve().parent) as folder:
        work = linked_copy(given.run, Path(folder) / "run")
        sizes = sorted(float(word) for word in given.sizes.split(","))
        for layout, size in ((layout, size) for layout in given.layouts.split(",") for size in sizes):
            row = {**row_of(work, layout, size, settings), "settings": settings, "hardware": hardware("cpu"), "versions": versions()}
            rows = sorted([*(old for old in rows if (old["layout"], old["max_mb"]) != (layout, size)), row], key=lambda each: (each["layout"], each["max_mb"]))
            print(f"{layout} {size:5g} MB: {row['mb']:.2f} MB, {row['voxels']:,} voxels, {row['psnr']:.2f} dB", flush=True)
            measured = EvaluateOutputs.of_run(given.run).metrics  # of more than one view, where the run has been evaluated
            network = read_json(measured if measured.exists() else EvaluateOutputs.of_run(work).metrics)["network"]
            document = {"run": name, "rows": rows, "network": network}
            file.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
            (given.out / f"size_quality_{name}.md").write_text(in_markdown(name, rows, network["psnr"]), encoding="utf-8")
            plot(given.out / f"size_quality_{name}.png", rows, network["psnr"], name)


if __name__ == "__main__":
    main()
