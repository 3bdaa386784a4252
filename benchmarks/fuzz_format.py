"""Fuzzing of the asset format: valid files of every layout, changed at random, must be read or refused.

    python benchmarks/fuzz_format.py [--inputs 100000] [--seed 0] [--json FILE]

Four kinds of mutation: bytes anywhere; bytes of the header; JSON values of the header and the metadata, valid or nearly so; bytes of a tensor with
its digest recomputed, so that the checks after the digests are reached. Files that are read are rendered and saved again.

A child process runs each batch, its address space limited to 1 GiB more than after its imports. Each input is written to disk before it is opened, so
that an input that kills the child is known. Failures are: any exception but FormatError, a child that dies, an input that takes more than ten
seconds. The same seed gives the same inputs.
"""

from __future__ import annotations

import argparse
import copy
import hashlib
import json
import platform
import re
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from efficientnerf.asset.rendering import render_rays

HERE = Path(__file__).resolve().parent
GOLDEN = HERE.parent / "tests" / "data" / "golden"
EXTRA_MEMORY = 2**30  # bytes of address space beyond what the imports took
SLOW = 10  # seconds
BATCH = 20000
NUMBERS = [0, 1, -1, 2, 3, 7, 8, 16, 17, 63, 64, 65, 255, 256, 257, 2**16, 2**31, 2**32, 2**53, 2**63, 2**64, 10**30, 0.5, -0.0, 1e-30, 1e30, 1e300, 1e-320]
TEXTS = [
    "", "sparse", "compact", "full", "ndc-sparse", "ndc-compact", "ndc-full", "U8", "U16", "U64", "F16", "F32", "F64", "1.0", "1.9", "2.0",
    "x.a", "nerftree", "\ud7ff\0", "9" * 50,
]  # fmt: skip
Rng = np.random.Generator


def number(rng: Rng, below: int) -> int:
    return int(rng.integers(below))


def header_of(data: bytes) -> tuple[dict[str, Any], dict[str, Any], bytes]:
    """The header's entries, the metadata and the data of a valid file."""
    length = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + length])
    return header, json.loads(header.pop("__metadata__")["nerftree"]), data[8 + length :]


def file_of(header: dict[str, Any], meta: Any, data: bytes) -> bytes:
    raw = json.dumps({"__metadata__": {"nerftree": json.dumps(meta)}, **header}).encode("utf-8", "surrogatepass")
    return len(raw).to_bytes(8, "little") + raw + data


def with_bytes(rng: Rng, data: bytes, begin: int, end: int) -> bytes:
    """A few changes of bytes between `begin` and `end`: flipped, overwritten, put in, taken out, copied, cut off."""
    out = bytearray(data)
    for _ in range(1 + number(rng, 4)):
        end = min(end, len(out))
        if end <= begin:
            break
        at, count = begin + number(rng, end - begin), 1 + number(rng, 8)
        kind = number(rng, 7)
        if kind == 0:
            out[at] ^= 1 << number(rng, 8)
        elif kind == 1:
            out[at : at + count] = rng.bytes(count)
        elif kind == 2:
            out[at:at] = rng.bytes(count)
        elif kind == 3:
            del out[at : at + count]
        elif kind == 4:
            source = number(rng, len(out))
            out[at : at + count] = out[source : source + count]
        elif kind == 5:
            out[at : at + 1] = b'0123456789-.eE[]{},:"\\ '[number(rng, 23) :][:1]
        else:
            del out[at:]
    return bytes(out)


def value(rng: Rng, depth: int = 0) -> Any:
    """Any JSON value, of kinds that break readers."""
    kind = number(rng, 8 if depth < 3 else 5)
    if kind == 0:
        return [None, True, False][number(rng, 3)]
    if kind in (1, 2):
        return NUMBERS[number(rng, len(NUMBERS))]
    if kind in (3, 4):
        return TEXTS[number(rng, len(TEXTS))]
    if kind == 5:
        return {TEXTS[number(rng, len(TEXTS))]: value(rng, depth + 1) for _ in range(number(rng, 3))}
    return [value(rng, depth + 1) for _ in range(number(rng, 5))]


def with_values(rng: Rng, root: Any) -> Any:
    """The JSON with one value changed, anywhere: by another, by a near one, or gone."""
    root = copy.deepcopy(root)
    node = root
    while True:
        keys: list[Any] = list(node) if isinstance(node, dict) else list(range(len(node)))
        if not keys:
            return root
        key = keys[number(rng, len(keys))]
        if isinstance(node[key], (dict, list)) and node[key] and number(rng, 4):
            node = node[key]
            continue
        kind = number(rng, 4)
        if kind == 0 and isinstance(node[key], (int, float)) and not isinstance(node[key], bool):
            node[key] = node[key] + [-1, 1, 0.5, 8][number(rng, 4)]
        elif kind == 1:
            del node[key]
        elif kind == 2 and isinstance(node, dict):
            node[TEXTS[number(rng, len(TEXTS))]] = node[key]
        else:
            node[key] = value(rng)
        return root


def with_tensor(rng: Rng, data: bytes) -> bytes:
    """Bytes of one tensor changed and its digest put right."""
    header, meta, body = header_of(data)
    name = sorted(header)[number(rng, len(header))]
    begin, end = header[name]["data_offsets"]
    out = bytearray(body)
    for _ in range(1 + number(rng, 4)):
        if end > begin:
            at = begin + number(rng, end - begin)
            out[at] = [0, 255, 0x7C, 0x7E, 0x80, number(rng, 256)][number(rng, 6)]
    meta["sha256"][name] = hashlib.sha256(out[begin:end]).hexdigest()
    if not number(rng, 3):
        meta = with_values(rng, meta)
    return file_of(header, meta, bytes(out))


def changed(rng: Rng, seeds: list[bytes]) -> tuple[str, bytes]:
    """The kind of mutation, and the file."""
    data = seeds[number(rng, len(seeds))]
    kind = number(rng, 4)
    if kind == 0:
        return "bytes", with_bytes(rng, data, 0, len(data))
    if kind == 1:
        return "header bytes", with_bytes(rng, data, 0, 8 + int.from_bytes(data[:8], "little"))
    if kind == 2:
        header, meta, body = header_of(data)
        for _ in range(1 + number(rng, 2)):
            header, meta = (with_values(rng, header), meta) if number(rng, 2) else (header, with_values(rng, meta))
        return "json", file_of(header, meta, body)
    return "tensor", with_tensor(rng, data)


def try_file(path: Path) -> str | None:
    """None if the file is read, rendered and saved; else the reason why it is refused. Anything else is raised."""
    from efficientnerf.asset.format import FormatError, describe, load, serialize

    refusal = None
    try:
        describe(path)
    except FormatError as error:
        refusal = str(error)
    try:
        tree = load(path)
    except FormatError as error:
        return str(error)
    if refusal is not None:
        raise AssertionError(f"read, but not described: {refusal}")
    if tree.degree <= 2 and max(tree.resolution) <= 64:
        centre = (tree.bounds_min + tree.bounds_max) / 2
        with np.errstate(all="ignore"):
            render_rays(tree, centre - tree.voxel * np.array([[50.0, 3.0, 2.0]]), np.array([[1.0, 0.0, 0.0]]))
    serialize(tree)
    return None


def rule(message: str) -> str:
    """The message without what is specific to this file, so that equal refusals count as one."""
    return re.sub(r"'[^']*'|SHA-256.*|[0-9]+|\(.*\)", "*", message.partition(": ")[2])[:60]


def batch(seed: int, first: int, count: int, folder: Path, report: Callable[[dict[str, Any]], None]) -> None:
    """Inputs `first` to `first + count` - 1, in this process."""
    seeds = [path.read_bytes() for path in sorted(GOLDEN.glob("*.nerftree"))]
    path = folder / "fuzzed.nerftree"
    kinds: Counter[str] = Counter()
    refusals: Counter[str] = Counter()
    slowest, read, failures = 0.0, 0, []

    def alarm(*_: Any) -> None:
        raise TimeoutError(f"more than {SLOW} s")

    signal.signal(signal.SIGALRM, alarm)
    for index in range(first, first + count):
        kind, data = changed(np.random.Generator(np.random.Philox(key=seed, counter=[0, 0, 0, index])), seeds)
        path.write_bytes(data)
        (folder / "index").write_text(str(index))
        begin = time.process_time()
        signal.alarm(SLOW)
        try:
            refusal = try_file(path)
        except Exception as error:
            failures.append({"index": index, "kind": kind, "error": f"{type(error).__name__}: {error}"[:300]})
            refusal = "failed"
        signal.alarm(0)
        slowest = max(slowest, time.process_time() - begin)
        kinds[kind] += 1
        read += refusal is None
        if refusal is not None:
            refusals[rule(refusal)] += 1
    report({"inputs": count, "kinds": dict(kinds), "read": read, "refusals": dict(refusals), "slowest_s": slowest, "failures": failures,
            "peak_rss_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024})  # fmt: skip


def child(seed: int, first: int, count: int, folder: Path) -> None:
    """Imports and compiles, then limits its memory, then works."""
    import warnings

    warnings.simplefilter("error")
    for path in sorted(GOLDEN.glob("*.nerftree")):
        try_file(path)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
    pages = int(Path("/proc/self/statm").read_text().split()[0]) if Path("/proc/self/statm").exists() else 0
    if pages:
        limit = pages * resource.getpagesize() + EXTRA_MEMORY
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    batch(seed, first, count, folder, lambda found: print(json.dumps({**found, "rss_before_mib": before}), flush=True))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--inputs", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, default=HERE / "results" / "fuzz_format.json")
    parser.add_argument("--child", type=int, nargs=2, metavar=("FIRST", "COUNT"), help=argparse.SUPPRESS)
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.child:
        child(given.seed, *given.child, given.folder)
        return 0
    found: list[dict[str, Any]] = []
    failures: list[dict[str, Any]] = []
    begin = time.time()
    for first in range(0, given.inputs, BATCH):
        count = min(BATCH, given.inputs - first)
        with tempfile.TemporaryDirectory() as folder:
            command = [sys.executable, __file__, "--seed", str(given.seed), "--child", str(first), str(count), "--folder", folder]
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            if done.returncode:
                at = (Path(folder) / "index").read_text() if (Path(folder) / "index").exists() else "the beginning"
                failures.append({"index": at, "error": f"the process ended with {done.returncode} at input {at}: {done.stderr[-300:]}"})
                continue
        found.append(json.loads(done.stdout))
        failures += found[-1]["failures"]
        print(f"{first + count} inputs, {len(failures)} failures", flush=True)
    refusals, kinds = Counter[str](), Counter[str]()
    for part in found:
        refusals.update(part["refusals"])
        kinds.update(part["kinds"])
    result = {
        "inputs": sum(part["inputs"] for part in found), "seed": given.seed, "kinds": dict(sorted(kinds.items())),
        "read": sum(part["read"] for part in found), "refused": sum(refusals.values()),
        "failures": failures, "slowest_s": round(max((part["slowest_s"] for part in found), default=0), 3),
        "peak_rss_mib": max((part["peak_rss_mib"] for part in found), default=0), "rss_before_mib": max((part["rss_before_mib"] for part in found), default=0),
        "room_mib": EXTRA_MEMORY // 2**20, "seconds": round(time.time() - begin), "python": platform.python_version(), "numpy": np.__version__,
        "most_common_refusals": dict(refusals.most_common(40)),
    }  # fmt: skip
    given.json.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    print(f"{result['inputs']} inputs: {result['read']} read, {result['refused']} refused, {len(failures)} failures; "
          f"peak {result['peak_rss_mib']} MiB ({result['rss_before_mib']} after imports), slowest {result['slowest_s']} s")  # fmt: skip
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
