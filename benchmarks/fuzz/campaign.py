"""Many inputs on many readers, in batches, and on after the input of which a worker died; what the workers report is added up."""

import json
import threading
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from benchmarks.fuzz.nursery import Nursery, scratch_folder
from benchmarks.fuzz.worker import NOTE

GUIDED = 0.25  # of the inputs are guided by coverage, which takes twice the time; the rest begin with what those found
BATCH = 75_000  # inputs of one process


class Nurseries(threading.local):
    """Those of each thread, made when they are needed. They end with this process, which closes their standard input."""

    def __init__(self) -> None:
        self.made: dict[bool, Nursery] = {}

    def of(self, coverage: bool) -> Nursery:
        if coverage not in self.made:
            self.made[coverage] = Nursery(coverage)
        return self.made[coverage]


def fuzz(name: str, inputs: int, seed: int, nurseries: Nurseries, *, coverage: bool, shrink: float) -> dict[str, Any]:
    """All inputs of one reader; the sum of what its processes reported."""
    parts: list[dict[str, Any]] = []
    deaths: list[dict[str, Any]] = []
    with scratch_folder(f"fuzz-{name}-") as folder:
        first = 0
        while first < inputs and len(deaths) < 20:
            guided = coverage and first < GUIDED * inputs
            last = min(round(GUIDED * inputs) if guided else inputs, first + BATCH)
            job = {"name": name, "seed": seed + first, "first": first, "count": last - first, "folder": folder, "coverage": guided, "shrink": shrink}
            found = _batch(job, nurseries.of(guided))
            if "died" in found:
                deaths.append(found)
                first = found["index"] + 1
                parts.append({"inputs": first - found["first"], "accepted": 0, "refused": {"unknown": first - found["first"] - 1}, "findings": [found]})
            else:
                parts.append(found)
                first += found["inputs"]
            print(f"{name}: {first} inputs, {sum(len(part['findings']) for part in parts)} findings", flush=True)
    return summed(name, parts)


def _batch(job: dict[str, Any], nursery: Nursery) -> dict[str, Any]:
    folder, first = Path(job["folder"]), job["first"]
    note = folder / NOTE
    note.unlink(missing_ok=True)
    code = nursery.work(job, note)
    text = (folder / "stdout").read_text(errors="replace").strip().splitlines()
    if code == 0 and text:
        found: dict[str, Any] = json.loads(text[-1])
        return found
    number, _, data = note.read_bytes().partition(b"\n") if note.exists() else (b"", b"", b"")
    index = int(number or first)
    last = (folder / "stderr").read_text(errors="replace")[-2000:]
    what = "stuck" if code is None else f"the process ended with {code}"
    return {"died": True, "first": first, "index": index, "by": what, "place": "", "text": last, "trace": last, "count": 1, "command": None, "data": data.hex()}


def summed(name: str, parts: list[dict[str, Any]]) -> dict[str, Any]:
    findings: dict[tuple[str, str], dict[str, Any]] = {}
    for each in (each for part in parts for each in part["findings"]):
        known = findings.setdefault((each["by"], each["place"]), {**each, "reader": name, "count": 0})
        known["count"] += each["count"]
        if len(each["data"]) < len(known["data"]):
            known["data"] = each["data"]
    inputs, seconds = sum(part["inputs"] for part in parts), sum(part.get("cpu_s", 0.0) for part in parts)
    return {
        "inputs": inputs,
        "accepted": sum(part["accepted"] for part in parts),
        "refused": _counts(part["refused"] for part in parts),
        "command_lines": sum(part.get("commands", 0) for part in parts),
        "exit_codes": _counts(part.get("codes", {}) for part in parts),
        "findings": list(findings.values()),
        "slowest_s": round(max((part.get("slowest_s", 0.0) for part in parts), default=0.0), 3),
        "peak_rss_mib": max((part.get("peak_rss_mib", 0) for part in parts), default=0),
        "rss_before_mib": max((part.get("rss_before_mib", 0) for part in parts), default=0),
        "inputs_per_cpu_s": round(inputs / max(seconds, 1e-9)),
        "cpu_seconds": round(seconds, 1),
    }


def _counts(parts: Iterable[dict[str, int]]) -> dict[str, int]:
    total = Counter[str]()
    for part in parts:
        total.update(part)
    return dict(sorted(total.items()))
