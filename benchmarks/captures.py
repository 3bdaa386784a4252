"""Whole captures: photographs to all deliverables with default settings, what came of each, and a picture of each. To be run before a default is changed.

    python -m benchmarks.captures --runs FOLDER [--sets controller,bonsai] [--data FOLDER] [--preset NAME] [--set KEY=VALUE]... [--device cuda]
    python -m benchmarks.captures --from FOLDER [--sets controller,bonsai]
    python -m benchmarks.captures --runs FOLDER SOURCE [SOURCE ...]

Each set has a run of its own, FOLDER/<its name>, begun or resumed; where its poses are made, the photographs need not be there. With --from nothing is run:
the runs that are there are put into the table. A row is written as soon as it is known. A set whose row has the same options and the same code is not run
again. Results: captures.json, captures.md and captures/NAME.webp (photograph, asset and mesh of the median view). Exit code 1 where a set fails, or where
--before is given and the asset of a set is worse than there by more than 0.1 dB.
"""

import argparse
import datetime
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.machine import hardware
from benchmarks.poses import found_centres, percent_off, true_centres
from benchmarks.project import DATA, ENERF, RESULTS, code_version, last_object
from pipeline.files import read_json, write_atomically, write_json
from pipeline.run import NAME as RUN_FILE
from stages.artifacts import BakeOutputs, EvaluateOutputs, PosesOutputs, SplatsOutputs, TrainOutputs
from workflows.asset import NAMES as STAGES
from workflows.cli.device import has_cuda

FILE = "captures"
SETS = {  # photographs alone, whatever cameras lie next to them
    "still_life": "sample_photos", "banana_photos": "banana_photos", "fern": "fern_4/images_4", "lund_door": "lund_door_colmap/images",
    "lund_photos": "lund_photos", "monstree": "monstree", "snowmiku": "snowmiku/photos", "controller": "controller/photos", "toy_stills": "toy_stills",
    "toy_video": "toy_video/my_video.mp4", "office_room": "office_room/images", "mary_rose": "mary_rose/images", "bonsai": "bonsai/photos",
}  # fmt: skip
REFERENCES = {"still_life": "sample_truth/cameras.json", "snowmiku": "snowmiku/reference_cameras.json"}
KINDS = ("network", "asset", "mesh", "splats")
WORSE = 0.1  # dB, that an asset may lose by a change of a default
PANELS = (0, 2, 3)  # photograph, asset and mesh of a strip's four pictures
LONGEST, MOST_BYTES = 300, 44_000  # px of a picture's longest side; of the file: all thirteen stay under 600 kB
COLUMNS = ("set", "cameras", "photographs", "off the reference %", "training", "result", "network dB", "asset dB", "SSIM", "mesh dB", "splats dB", "holes %",
           "floaters %", "minutes", "peak MiB", "asset MB", "preset", "steps")  # fmt: skip


def sources_of(sets: Sequence[str], paths: Sequence[Path], data: Path) -> dict[str, Path]:
    """Name -> photographs or video of all that is asked for: of every known set where nothing is. Raises SystemExit for a set that is not known."""
    unknown = [name for name in sets if name not in SETS]
    if unknown:
        raise SystemExit(f"{', '.join(unknown)}: no such set. Sets: {', '.join(SETS)}.")
    names = sets or ([] if paths else list(SETS))
    return {name: data / SETS[name] for name in names} | {(path.parent if path.name in ("images", "photos") else path).name: path.absolute() for path in paths}


def run_capture(source: Path, run: Path, options: Sequence[str]) -> str | None:
    """Run all stages, or those that are left; why it failed, or None. Without the source a run goes on from its poses."""
    sources = [str(source)] if source.exists() else []
    command = [*ENERF, "run", *sources, "--out", str(run), "--json", *options]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
    return None if done.returncode == 0 else f"exit code {done.returncode}: {last_object(done.stdout).get('error', 'no summary')}"


def row_of(run: Path, reference: Path | None = None) -> dict[str, Any]:
    """What a run's folder says: figures are None, and stages `missing`, where it holds none."""
    manifests = {stage: read_json(run / stage / "manifest.json") for stage in STAGES if (run / stage / "manifest.json").exists()}
    cameras, result = verdict_of(run, "poses"), verdict_of(run, "evaluate")
    metrics, train = read_where_there(EvaluateOutputs.of_run(run).metrics), read_where_there(TrainOutputs.of_run(run).report)
    asset = BakeOutputs.of_run(run).asset
    return {
        "preset": read_where_there(run / RUN_FILE).get("preset"),
        "iterations": train.get("iterations"),
        "refuted_priors": sorted(name for name, prior in train.get("priors", {}).items() if not prior["applied"]),
        "second_chance": train.get("chosen"),
        "missing": [stage for stage in STAGES if stage not in manifests],
        "cameras": cameras,
        "photographs": len(read_where_there(PosesOutputs.of_run(run).report).get("registered", ())) or None,
        "percent_off_reference": None if reference is None or "poses" not in manifests else off_reference(run, reference),
        "result": result,
        **{kind: {key: (metrics.get(kind) or {}).get(key) for key in ("psnr", "ssim")} for kind in KINDS},
        "views": (metrics.get("asset") or {}).get("views"),
        **{key: metrics.get(key) for key in ("holes", "floaters")},
        "network_floaters": (metrics.get("network") or {}).get("floaters"),
        "gaussians": read_where_there(SplatsOutputs.of_run(run).report).get("gaussians"),
        "seconds": {stage: round(found["seconds"], 1) for stage, found in manifests.items()},
        "peak_mib": {stage: round(found["peak_memory"] / 2**20) for stage, found in manifests.items()},
        "asset_bytes": asset.stat().st_size if asset.exists() else None,
    }


def read_where_there(path: Path) -> dict[str, Any]:
    return dict(read_json(path)) if path.exists() else {}


def verdict_of(run: Path, stage: str) -> dict[str, Any] | None:
    """Grade, and what the problems are, of the cameras (poses) or of the result (evaluate): of a stage that failed, that which its scratch holds."""
    found = [path for path in (run / stage / "verdict.json", *sorted((run / ".work" / stage).rglob("verdict.json"))) if path.exists()]
    if not found:
        return None
    verdict = read_json(found[0])
    counts = {key: verdict[key] for key in ("registered", "photographs") if isinstance(verdict.get(key), int)}
    return {
        "grade": verdict["grade"],
        "summary": verdict.get("summary", ""),
        "problems": [problem["what"] for problem in verdict.get("problems", ())],
        **counts,
    }


def off_reference(run: Path, reference: Path) -> float | None:
    """How far the centres are off those of a reference: a transforms.json, or a list of {"img_name", "position"} as trainers of 3D Gaussians write them."""
    stated = read_json(reference)
    if isinstance(stated, list):
        centres = {Path(camera["img_name"]).stem: np.array(camera["position"]) for camera in stated}
    else:
        centres = {Path(name).stem: centre for name, centre in true_centres(reference).items()}
    return percent_off({Path(name).stem: centre for name, centre in found_centres(run).items()}, centres)


def write_picture(run: Path, path: Path) -> bool:
    """Photograph, asset and mesh of the median view side by side, of the run's strip; False where it has none."""
    from PIL import Image

    from stages.figures.plots import LABEL_HEIGHT, MARGIN
    from stages.io.pictures import opened

    made = EvaluateOutputs.of_run(run)
    strips = [strip for strip in (made.strip_median, made.strip_worst, made.strip_best) if strip.exists()]
    if not strips:
        return False
    with opened(strips[0], ("PNG",)) as picture:
        strip = picture.convert("RGB")
    width, height = (strip.width - MARGIN) // 4 - MARGIN, strip.height - 2 * MARGIN - LABEL_HEIGHT
    scale = min(1.0, LONGEST / max(width, height))
    size = max(1, round(width * scale)), max(1, round(height * scale))
    sheet = Image.new("RGB", (len(PANELS) * (size[0] + 4) - 4, size[1]), (255, 255, 255))
    for place, panel in enumerate(PANELS):
        left = MARGIN + panel * (width + MARGIN)
        part = strip.crop((left, MARGIN, left + width, MARGIN + height))
        sheet.paste(part.resize(size, Image.Resampling.LANCZOS), (place * (size[0] + 4), 0))
    path.parent.mkdir(parents=True, exist_ok=True)
    for quality in (80, 70, 60, 50, 40, 30, 20):
        sheet.save(path, quality=quality, method=6)
        if path.stat().st_size <= MOST_BYTES:
            break
    return True


def cells_of(name: str, row: Mapping[str, Any]) -> list[str]:
    """A row of the table."""

    def shown(value: float | None, digits: int, scale: float = 1.0) -> str:
        return "" if value is None else f"{scale * value:.{digits}f}"

    cameras, result = row["cameras"] or {}, row["result"] or {}
    registered = row["photographs"] or cameras.get("registered")
    given = cameras.get("photographs")
    return [
        name,
        _graded(cameras),
        "" if registered is None else f"{registered}" if given is None else f"{registered} of {given}",
        shown(row["percent_off_reference"], 2),
        ", ".join([*(f"{name} refuted" for name in row["refuted_priors"]), *([f"second chance: {row['second_chance']}"] if row["second_chance"] else [])]),
        f"**{row['error']}**".replace("|", "/").replace("\n", " ") if row.get("error") else _graded(result),
        shown(row["network"]["psnr"], 2),
        shown(row["asset"]["psnr"], 2),
        shown(row["asset"]["ssim"], 3),
        shown(row["mesh"]["psnr"], 2),
        shown(row["splats"]["psnr"], 2),
        shown(row["holes"], 2, 100),
        shown(row["floaters"], 2, 100),
        shown(sum(row["seconds"].values()), 1, 1 / 60) if row["seconds"] else "",
        shown(max(row["peak_mib"].values(), default=None), 0),
        shown(row["asset_bytes"], 1, 1e-6),
        row["preset"] or "",
        shown(row["iterations"], 0),
    ]


def _graded(verdict: Mapping[str, Any]) -> str:
    problems = ", ".join(verdict.get("problems", ()))
    return f"{verdict.get('grade', '')}{f' ({problems})' if problems else ''}"


def in_markdown(rows: Mapping[str, Mapping[str, Any]]) -> str:
    """The page: a table, how it was made, and a picture of each set."""
    lines = ["# Whole captures", "", "`python -m benchmarks.captures`: photographs alone, all stages; PSNR on held-out views.", ""]
    lines += ["| " + " | ".join(COLUMNS) + " |", "|---" * len(COLUMNS) + "|"]
    lines += ["| " + " | ".join(cells_of(name, row)) + " |" for name, row in rows.items()]
    made: dict[str, list[str]] = {}
    for name, row in rows.items():
        machine = row["machine"] or {}
        where = f"{machine['device']}, {machine['cores']} cores of {machine['processor']}" if machine else "a machine that was not noted"
        made.setdefault(f"{row['date']}, code {row['code'] or 'unknown'}, {where}, options: {row['options'] or 'none'}", []).append(name)
    lines += ["", *(f"- {', '.join(names)}: {how}." for how, names in made.items()), "", "Photograph, asset and mesh of the median held-out view:", ""]
    for name, row in rows.items():
        if row["picture"]:
            lines += [f"**{name}**", "", f"![{name}]({row['picture']})", ""]
    return "\n".join(lines).rstrip() + "\n"


def write(rows: Mapping[str, Mapping[str, Any]], out: Path) -> None:
    """The figures and the page, in the order of the sets."""
    order = {name: place for place, name in enumerate(SETS)}
    ordered = {name: rows[name] for name in sorted(rows, key=lambda name: (order.get(name, len(order)), name))}
    write_json(out / f"{FILE}.json", {"rows": ordered})
    write_atomically(out / f"{FILE}.md", in_markdown(ordered).encode())


def read_rows(path: Path) -> dict[str, dict[str, Any]]:
    return dict(read_where_there(path).get("rows", {}))


def measure(name: str, source: Path, run: Path, given: argparse.Namespace) -> dict[str, Any]:
    """The row of one set: run first, unless --from is given; and its picture."""
    options = [] if given.from_runs else options_of(given)
    error = None if given.from_runs else run_capture(source, run, options)
    reference = given.data / REFERENCES[name] if name in REFERENCES else None
    row = row_of(run, reference if reference is not None and reference.exists() else None)
    if error is None and row["missing"]:
        error = f"not made: {', '.join(row['missing'])}"
    picture = given.out / FILE / f"{name}.webp"
    about: dict[str, Any] = {"error": error, "date": datetime.date.today().isoformat(), "code": None, "options": " ".join(options), "machine": None}
    if not given.from_runs:
        about |= {"code": code_version(), "machine": hardware(given.hardware)}
    return {**about, **row, "picture": f"{FILE}/{picture.name}" if write_picture(run, picture) else None}


def options_of(given: argparse.Namespace) -> list[str]:
    """Those of `enerf run`."""
    options = [word for key in ("preset", "device", "budget") if getattr(given, key) for word in (f"--{key}", getattr(given, key))]
    return [*options, *(word for each in given.set for word in ("--set", each))]


def worse_than(before: Mapping[str, Mapping[str, Any]], rows: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Of the sets in both, a line for each whose asset has lost more than WORSE, or has no figure any more."""
    lines = []
    for name in before.keys() & rows.keys():
        was, now = (which[name]["asset"]["psnr"] for which in (before, rows))
        if was is not None and (now is None or now < was - WORSE):
            lines.append(f"{name}: asset {'fails' if now is None else f'{now:.2f} dB'}, {was:.2f} before")
    return sorted(lines)


def parser() -> argparse.ArgumentParser:
    made = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("sources", nargs="*", type=Path, help="more photographs or videos; alone without --sets")
    where = made.add_mutually_exclusive_group(required=True)
    where.add_argument("--runs", type=Path, help="folder of the runs")
    where.add_argument("--from", dest="from_runs", type=Path, help="folder of runs that are only read")
    made.add_argument("--sets", default="", help=f"names, with commas between, of {', '.join(SETS)}; by default all")
    made.add_argument("--data", type=Path, default=DATA, help="folder of the sets")
    made.add_argument("--out", type=Path, default=RESULTS)
    made.add_argument("--before", type=Path, help="a captures.json that no asset may be worse than")
    made.add_argument("--preset")
    made.add_argument("--budget")
    made.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    made.add_argument("--device", choices=("auto", "cpu", "cuda"))
    return made


def main(arguments: Sequence[str] | None = None) -> int:
    given = parser().parse_args(arguments)
    given.hardware = given.device if given.device in ("cpu", "cuda") else "cuda" if has_cuda() else "cpu"
    given.out.mkdir(parents=True, exist_ok=True)
    before = read_rows(given.before) if given.before else {}
    rows, table, measured = read_rows(given.out / f"{FILE}.json"), given.out / f"{FILE}.json", {}
    for name, source in sources_of([name for name in given.sets.split(",") if name], given.sources, given.data).items():
        run = (given.from_runs or given.runs) / name
        known = rows.get(name)
        if given.from_runs and not run.is_dir():
            continue
        if not given.from_runs and known and not known["error"] and (known["code"], known["options"]) == (code_version(), " ".join(options_of(given))):
            print(f"{name}: measured before", flush=True)
        else:
            rows = read_rows(table) | {name: measure(name, source, run, given)}  # other rows may have been written meanwhile
            write(rows, given.out)
            print("| " + " | ".join(cells_of(name, rows[name])) + " |", flush=True)
        measured[name] = rows[name]
    lines = worse_than(before, measured)
    print(*lines, sep="\n", flush=True)
    return 1 if lines or any(row["error"] for row in measured.values()) else 0


if __name__ == "__main__":
    sys.exit(main())
