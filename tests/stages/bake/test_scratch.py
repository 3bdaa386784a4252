"""Arrays in the scratch folder of a bake."""

import ast
import errno
import os
import resource
from pathlib import Path

import numpy as np
import pytest

from stages.bake import scratch

ROOT = Path(__file__).resolve().parents[3]
WRITES_PAST_PYTHON = {"save", "savez", "savez_compressed", "tofile", "memmap"}  # of numpy: their errors have no number


def test_a_write_that_the_system_cuts_short_keeps_the_number_of_its_error(tmp_path: Path) -> None:
    """As a disk that fills up does: the beginning is written. Here it is the limit on a file's size."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2**18, before[1]))
    try:
        with pytest.raises(OSError, match=os.strerror(errno.EFBIG)) as caught:
            scratch.write_arrays({"values": np.ones(2**18, np.float32)}, tmp_path / "block")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert caught.value.errno == errno.EFBIG


def test_nothing_writes_arrays_past_pythons_files() -> None:
    found = []
    for path in (each for package in ("pipeline", "efficientnerf", "stages", "workflows") for each in (ROOT / package).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Attribute) and node.attr in WRITES_PAST_PYTHON:
                of_numpy = isinstance(node.value, ast.Name) and node.value.id in ("np", "numpy")
                found += [f"{path}:{node.lineno}"] if of_numpy or node.attr == "tofile" else []
    assert not found
