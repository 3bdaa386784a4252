"""The command line of the fuzzer; see the package."""

import argparse
import importlib.metadata
import importlib.util
import platform
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any

from benchmarks.fuzz import campaign, nursery, worker
from benchmarks.project import ROOT

LIBRARIES = ("msgspec", "numpy", "pillow", "pillow-heif", "safetensors", "torch")


def main() -> int:
    given = _arguments()
    coverage = not given.plain and importlib.util.find_spec("atheris") is not None
    if given.serve:
        nursery.serve(coverage)
        return 0
    from benchmarks.fuzz.table import READERS

    unknown = [name for name in given.readers if name not in READERS]
    if unknown:
        print(f"{unknown[0]}: no such reader; there are {', '.join(READERS)}", file=sys.stderr)
        return 2
    if given.file is not None:
        return _again(given.readers[0], given.file)
    wrong, nurseries = False, campaign.Nurseries()

    def fuzz(name: str) -> tuple[str, dict[str, Any]]:
        count = round(given.inputs * READERS[name].share)
        return name, campaign.fuzz(name, count, given.seed, nurseries, coverage=coverage, shrink=given.shrink)

    with ThreadPoolExecutor(given.jobs) as threads:
        for done in as_completed([threads.submit(fuzz, name) for name in given.readers or READERS]):
            name, result = done.result()
            wrong = wrong or bool(result["findings"])
            _tell(name, result, given.findings)
            if given.json is not None:
                write(given.json, name, result, given.seed, coverage)
    return int(wrong)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.fuzz", description="Fuzz every reader, or some.")
    parser.add_argument("readers", nargs="*", metavar="READER")
    parser.add_argument("--inputs", type=int, default=100_000, help="for each reader")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--plain", action="store_true", help="without coverage, also where atheris is installed")
    parser.add_argument("--jobs", type=int, default=1, help="readers at a time")
    parser.add_argument("--shrink", type=float, default=5.0, metavar="SECONDS", help="to make the input of a finding smaller")
    parser.add_argument("--findings", type=Path, default=ROOT / "build" / "fuzz", metavar="DIR", help="where the inputs of findings go")
    parser.add_argument("--json", type=Path, metavar="FILE", help="result to write; what it holds of other readers stays")
    parser.add_argument("--file", type=Path, metavar="FILE", help="try this one input on READER")
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    return parser.parse_args()


def _again(name: str, path: Path) -> int:
    """One input, by every way that the reader has."""
    from benchmarks.fuzz.reader import commanded

    data = path.read_bytes()
    with tempfile.TemporaryDirectory() as folder:
        tally = worker.opened_reader(name, Path(folder), 0)
        outcomes = [("read", tally.outcome(data))]
        for arguments in tally.opened.commands:
            tally.outcome(data)
            tally.opened.prepare(data)
            outcomes.append((" ".join(arguments), commanded(arguments)))
    for what, outcome in outcomes:
        print(f"{what}\n    {outcome.kind} {outcome.by}\n    {outcome.text}\n{outcome.trace}")
    return 1 if any(outcome.kind == "finding" for _, outcome in outcomes) else 0


def _tell(name: str, found: dict[str, Any], folder: Path) -> None:
    """Print a line, and write each finding: its input, and a page about it."""
    print(f"{name}: {found['inputs']} inputs, {found['accepted']} accepted, {sum(found['refused'].values())} refused, "
          f"{found['command_lines']} command lines, {len(found['findings'])} findings; "
          f"{found['inputs_per_cpu_s']} inputs a processor second, slowest {found['slowest_s']} s, peak {found['peak_rss_mib']} MiB", flush=True)  # fmt: skip
    for number, each in enumerate(found["findings"]):
        folder.mkdir(parents=True, exist_ok=True)
        data = bytes.fromhex(each["data"])
        path = folder / f"F_{name}_{number}.bin"
        path.write_bytes(data)
        command = "" if each["command"] is None else f"Command: enerf {' '.join(each['command'])}\n\n"
        path.with_suffix(".md").write_text(
            f"# {name}: {each['by']}\n\nAt {each['place'] or 'an unknown place'}; {each['count']} times; input {len(data)} bytes.\n\n{command}"
            f"Again: `python -m benchmarks.fuzz {name} --file {path}`\n\n    {each['text'][:1000]}\n\n"
            f"Input:\n\n    {data[:600]!r}\n\n```\n{each['trace'][-3000:]}\n```\n",
            encoding="utf-8", errors="backslashreplace",
        )  # fmt: skip
        print(f"    {each['by']} at {each['place']} ({each['count']}): {path}", flush=True)


def write(path: Path, name: str, found: dict[str, Any], seed: int, coverage: bool) -> None:
    """Put what was found of a reader into the file of results; what it holds of other readers stays."""
    from benchmarks.fuzz.reader import LIMIT
    from benchmarks.fuzz.table import READERS
    from benchmarks.machine import processor
    from pipeline.files import read_json, write_json

    readers = dict(read_json(path)["readers"]) if path.exists() else {}
    readers[name] = {
        **found,
        "findings": [{key: one[key] for key in ("by", "place", "count")} for one in found["findings"]],
        "seed": seed,
        "date": time.strftime("%Y-%m-%d", time.gmtime()),
        "guided_by": f"coverage (atheris): {campaign.GUIDED:.0%} of the inputs" if coverage else "outcomes",
    }
    result = {
        "machine": processor(),
        "python": platform.python_version(),
        "versions": {library: importlib.metadata.version(library) for library in (*LIBRARIES, *(["atheris"] if coverage else []))},
        "inputs": sum(each["inputs"] for each in readers.values()),
        "findings": sum(len(each["findings"]) for each in readers.values()),
        "limit_s": LIMIT,
        "memory_mib": worker.EXTRA_MEMORY // 2**20,
        "readers": {reader: readers[reader] for reader in READERS if reader in readers},
    }
    write_json(path, result)


if __name__ == "__main__":
    sys.exit(main())
