"""Calls of the command line in processes of their own, on the toy workflow, with standard streams that are full, closed, or read by nobody.

    python -m tests.workflows.cli.streams PRESETS < CASES

CASES is a JSON list of {"arguments", "stdin", "stdout", "stderr"}, each stream "ok", "full", "closed" or "gone" (a pipe whose reader has ended). Each case
runs in a fork of this process, which saves the imports, and ends as any Python process ends: with a flush of its streams. Prints a JSON list of
{"code", "out", "err"}.
"""

import gc
import importlib
import json
import os
import sys
import tempfile
from pathlib import Path
from typing import Any, BinaryIO

from tests.workflows.toys import TOYS
from workflows.cli.main import main
from workflows.workflow import Workflow


def attach(number: int, how: str, kept: BinaryIO) -> None:
    """Make descriptor `number` of this process what the case wants; "ok" writes to the file `kept`."""
    if how == "closed":
        os.close(number)
        setattr(sys, ("stdin", "stdout", "stderr")[number], None)  # as Python finds it when it starts so
        return
    if how == "gone":
        reading, writing = os.pipe()
        os.close(reading)
    else:
        writing = os.open("/dev/full", os.O_WRONLY) if how == "full" else kept.fileno()
    os.dup2(writing, number)


def child(case: dict[str, Any], presets: Path, kept: list[BinaryIO]) -> None:
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if number or case.get(name) == "closed":
            attach(number, case.get(name, "ok"), kept[number])
    arguments = [os.fsdecode(text.encode("utf-8", "surrogateescape")) for text in case["arguments"]]  # as the locale has them
    sys.exit(main(arguments, Workflow(TOYS, presets)))


def ran(case: dict[str, Any], presets: Path) -> dict[str, Any]:
    with tempfile.TemporaryFile() as unused, tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        process = os.fork()
        if not process:
            child(case, presets, [unused, out, err])  # ends the process
        _, status = os.waitpid(process, 0)
        for file in (out, err):
            file.seek(0)
        return {"code": os.waitstatus_to_exitcode(status), "out": out.read().decode("utf-8", "replace"), "err": err.read().decode("utf-8", "replace")}


if __name__ == "__main__":
    for module in ("efficientnerf.asset.format", "stages.viewer.page", "workflows.cli.request", "workflows.report.page", "workflows.report.viewer"):
        importlib.import_module(module)  # what the cases import is imported once

    gc.freeze()  # else each fork copies what it never looks at
    given, folder = json.load(sys.stdin), Path(sys.argv[1])
    results = [ran(case, folder) for case in given]
    json.dump(results, sys.stdout)
