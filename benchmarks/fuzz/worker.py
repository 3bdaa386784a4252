"""A process that tries inputs on one reader, and prints what came of them as a line of JSON.

With atheris the readers' modules report which branches they take, and libFuzzer keeps the inputs that lead somewhere new and changes them again, by
the same mutations; without, an input is kept when its outcome is new, and those that libFuzzer kept before are changed too. Either way the same seed
gives the same inputs. The input that is being tried is on
disk before it is read, so that one that ends this process is known.
"""

import contextlib
import gc
import json
import os
import re
import resource
import shutil
import struct
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

from benchmarks.fuzz.reader import Opened, Outcome, Reader, address_space, commanded, judged

EXTRA_MEMORY = 2**30  # bytes of address space beyond what the imports took
NOTE = "input"  # a file: the number of the input that is being tried, a line's end, the input
CORPUS = "corpus"  # a folder: the inputs that libFuzzer kept
KEPT = 200  # inputs that are changed again, as the seeds are
INSTRUMENTED = ["pipeline", "stages.io", "stages.formats", "stages.train", "workflows.cli", "workflows.report", "workflows.inspection"]


def shrunk(data: bytes, fails: Callable[[bytes], bool], seconds: float) -> bytes:
    """The input without runs of bytes, longer ones first, for as long as it still fails; for at most so many seconds."""
    end = time.monotonic() + seconds
    size = max(len(data) // 2, 1)
    while size and time.monotonic() < end:
        at = 0
        while at < len(data) and time.monotonic() < end:
            candidate = data[:at] + data[at + size :]
            if fails(candidate):
                data = candidate
            else:
                at += size
        size //= 2
    return data


class Tally:
    """What became of the inputs of one process."""

    def __init__(self, reader: Reader, opened: Opened, folder: Path, first: int) -> None:
        self.reader, self.opened, self.folder, self.index = reader, opened, folder, first
        self.inputs = self.accepted = self.commands = 0
        self.refused: Counter[str] = Counter()
        self.codes: Counter[str] = Counter()
        self.findings: dict[tuple[str, str], dict[str, Any]] = {}
        self.slowest = 0.0
        self.note = os.open(folder / NOTE, os.O_WRONLY | os.O_CREAT)  # a descriptor, open as long as this process
        self.before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

    def outcome(self, data: bytes) -> Outcome:
        return judged(lambda: self.opened.read(data), self.reader.refusals)

    def try_input(self, data: bytes) -> Outcome:
        """Read an input, at times through the command line too."""
        os.truncate(self.note, 0)
        os.pwrite(self.note, b"%020d\n%b" % (self.index, data), 0)
        begin = time.process_time()
        found = self.outcome(data)
        spent = time.process_time() - begin
        self.slowest = max(self.slowest, spent)
        self.inputs += 1
        self.accepted += found.kind == "accepted"
        if found.kind == "refused":
            self.refused[found.by] += 1
        elif found.kind == "finding":
            self._keep(found, data, None)
        if self.opened.commands and self.index % self.reader.every == 0:
            self._command(data, self.opened.commands[self.index // self.reader.every % len(self.opened.commands)])
        self.index += 1
        return found

    def _command(self, data: bytes, arguments: tuple[str, ...]) -> None:
        with contextlib.suppress(Exception):
            self.opened.read(data)  # what another command left is overwritten
        self.opened.prepare(data)
        found = commanded(arguments)
        self.commands += 1
        self.codes[found.by if found.kind != "accepted" else "exit code 0"] += 1
        if found.kind == "finding":
            self._keep(found, data, arguments)

    def _keep(self, found: Outcome, data: bytes, command: tuple[str, ...] | None) -> None:
        known = self.findings.setdefault(found.key, {**vars(found), "count": 0, "command": command, "data": data.hex()})
        known["count"] += 1
        if len(data) * 2 < len(known["data"]):
            known["data"] = data.hex()

    def shrink(self, seconds: float) -> None:
        """Make the inputs of the findings smaller."""
        for found in self.findings.values():
            if found["by"].startswith("Hang") or found["command"] is not None:
                continue
            key = found["by"], found["place"]
            found["data"] = shrunk(bytes.fromhex(found["data"]), lambda data, key=key: self.outcome(data).key == key, seconds).hex()  # type: ignore[misc]

    def report(self) -> dict[str, Any]:
        return {
            "inputs": self.inputs, "accepted": self.accepted, "refused": dict(self.refused), "commands": self.commands, "codes": dict(self.codes),
            "findings": list(self.findings.values()), "slowest_s": self.slowest, "cpu_s": time.process_time(),
            "rss_before_mib": self.before // 1024, "peak_rss_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024,
        }  # fmt: skip


def random_of(seed: int, index: int) -> Random:
    return Random(seed << 40 | index)


def changed(reader: Reader, rng: Random, data: bytes) -> bytes:
    """A mutation; the input itself where what an earlier one made of it cannot be changed in the way that was drawn."""
    try:
        return reader.changed(rng, data)
    except (ArithmeticError, LookupError, RecursionError, TypeError, ValueError, struct.error):
        return data


def plainly(tally: Tally, seed: int, count: int) -> None:
    """Inputs by mutation of the seeds, and of inputs whose outcome, or whose way through the code, was new."""
    seeds = tally.reader.seeds()
    kept = [path.read_bytes() for path in sorted((tally.folder / CORPUS).glob("*"))[-KEPT:]]
    known: set[tuple[str, str]] = set()
    for index in range(tally.index, tally.index + count):
        rng = random_of(seed, index)
        base = rng.choice(kept) if kept and rng.random() < 0.4 else rng.choice(seeds)
        data = changed(tally.reader, rng, base)
        found = tally.try_input(data)
        rule = found.by, re.sub(r"[0-9]+|'[^']*'|\[.*\]", "*", found.text)[:80]
        if found.kind != "finding" and rule not in known and len(data) < 4 * max(map(len, seeds)):
            known.add(rule)
            kept.append(data)
            del kept[:-KEPT]


def guided(tally: Tally, seed: int, count: int, finish: Callable[[], None]) -> None:
    """Inputs by libFuzzer, which never returns: `finish` is called after the last input, and ends the process."""
    import atheris

    corpus = tally.folder / CORPUS
    corpus.mkdir(exist_ok=True)
    seeds = tally.reader.seeds()
    for number, data in enumerate(seeds):
        (corpus / f"{number:04d}").write_bytes(data)
    last = tally.index + count

    def try_one(data: bytes) -> None:
        tally.try_input(data)
        if tally.index >= last:
            finish()

    def next_input(data: bytes, largest: int, number: int) -> bytes:
        rng = random_of(seed, number)
        base = bytes(data) if rng.random() < 0.6 else rng.choice(seeds)  # the valid files are near what is accepted
        return changed(tally.reader, rng, base)[:largest]

    options = [f"-seed={seed % 2**31 + 1}"]
    options += ["-timeout=0", "-rss_limit_mb=0", "-max_len=1048576", "-len_control=0", "-mutate_depth=2", "-verbosity=0", "-reload=0"]
    atheris.Setup([sys.argv[0], *options, str(corpus)], try_one, custom_mutator=next_input)
    atheris.Fuzz()


def work(name: str, seed: int, first: int, count: int, folder: Path, *, coverage: bool, shrink: float = 0.0) -> None:
    """Try `count` inputs from number `first` on, print the report and end the process."""
    tempfile.tempdir = str(folder)
    tally = opened_reader(name, folder, first)
    address_space(EXTRA_MEMORY)
    out = os.dup(1)

    def finish() -> None:
        tally.shrink(shrink)
        with os.fdopen(out, "w") as file:
            file.write(json.dumps(tally.report()) + "\n")
        os._exit(0)

    if coverage:
        guided(tally, seed, count, finish)
    else:
        plainly(tally, seed, count)
        finish()


def opened_reader(name: str, folder: Path, first: int) -> Tally:
    """A reader in a new folder, each valid file read once."""
    from benchmarks.fuzz.table import READERS

    reader = READERS[name]
    shutil.rmtree(folder / "place", ignore_errors=True)
    (folder / "place").mkdir(parents=True)
    opened = reader.open(folder / "place")
    for data in reader.seeds():
        judged(lambda data=data: opened.read(data), reader.refusals)  # type: ignore[misc]
    gc.collect()
    return Tally(reader, opened, folder, first)
