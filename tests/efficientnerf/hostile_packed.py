"""A hostile file for each rule of FORMAT.md about the layout `packed`."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import numpy as np

from efficientnerf.asset.format import LAYOUTS
from tests.efficientnerf.damaged import blob, meta_with, negative, parts, tensor, with_tensor, without

MASKS = b"\1\0\x80\1" + b"\x80\x40\x80\x40"  # all 128 contexts have table 0, in which 0 and 1 are as likely


def counted(**changes: Any) -> bytes:
    """The tiny packed file, which claims other counts."""
    _, meta, _ = parts(blob("packed"))
    return meta_with("packed", packed={**meta["packed"], **changes})


def stream(raw: bytes) -> bytes:
    return with_tensor("packed.mask", np.frombuffer(raw, "<u1"), "packed")


def codes(raw: bytes) -> bytes:
    return with_tensor("packed.sh", np.frombuffer(raw, "<u1"), "packed")


PACKED: dict[str, tuple[Callable[[], bytes], str]] = {
    **{f"packed, no {name}": (lambda name=name: without(name, "packed"), f"tensor '{re.escape(name)}' is missing") for name in LAYOUTS["packed"].tensors},  # type: ignore[misc]
    "packed, no counts": (lambda: meta_with("packed", packed="absent"), "'packed' is None; expected an object"),
    "packed voxels below zero": (lambda: counted(voxels=-1), "'voxels' is -1; expected a whole number from 0"),
    "packed bricks of a fraction": (lambda: counted(bricks=0.5), r"'bricks' is 0\.5; expected a whole number"),
    "packed codes of three bytes": (lambda: counted(code_bytes=3), "'code_bytes' is 3; expected a whole number from 1 to 2"),
    "more packed bricks than cells": (lambda: counted(bricks=4), "2 occupied cells but 4 bricks"),
    "more packed voxels than masks name": (lambda: counted(voxels=20), "masks name [0-9]+ voxels but 20 are stored"),
    "a bomb of voxels": (lambda: counted(voxels=2**31 - 1), r"take [0-9]+ MB of memory; expected at most 24 times the size and 200 MB"),
    "a bomb of bricks": (lambda: counted(bricks=2**31 - 1), r"take [0-9]+ MB of memory; expected at most 24 times"),
    "a bomb of cells": (lambda: meta_with("packed", shape=[1024, 1024, 1024]), r"take [0-9]+ MB of memory; expected at most 24 times"),
    "packed codes of the other width": (lambda: counted(code_bytes=2), r"'packed\.sh' .*it is no stream of 1584 contexts"),
    "packed, no groups": (lambda: meta_with("packed", sh_groups="absent"), "'sh_groups' is None"),
    "packed densities without a table": (lambda: with_tensor("density.table", np.zeros(0, "<f4"), "packed"), "voxels, but a table without entries"),
    "packed codes beyond the palette": (lambda: with_tensor("sh.palette", tensor("sh.palette", "packed")[:1], "packed"), "expected codes below the 1 entries"),
    "a packed density below zero": (lambda: with_tensor("density.table", negative("density.table", "packed"), "packed"), "densities must be finite"),
    "an empty stream": (lambda: stream(b""), r"'packed\.mask' ends within its tables; it is no stream of 128 contexts"),
    "a stream without tables": (lambda: stream(b"\0"), "has no table"),
    "contexts of a table that is not there": (lambda: stream(b"\1\1\x80\1"), "gives 128 contexts the table 1 of 1"),
    "too many contexts": (lambda: stream(b"\1\0\x81\1"), "gives 129 contexts the table 0 of 1"),
    "no contexts": (lambda: stream(b"\1\0\0"), "gives 0 contexts the table 0 of 1"),
    "a number without end": (lambda: stream(b"\1\0" + b"\xff" * 9), "holds a number of more than four bytes"),
    "a table that is too much": (lambda: stream(b"\1\0\x80\1" + b"\x81\x80\1"), "has a table whose sum is 16385, not 16384"),
    "a table of too many symbols": (lambda: stream(b"\1\0\x80\1" + b"\0\xff\1\1"), "has a table whose sum is 0, not 16384"),
    "a stream without a state": (lambda: stream(MASKS), "has 0 bytes after its tables; expected words of 16 bits, two at least"),
    "half a word": (lambda: stream(MASKS + bytes(5)), "has 5 bytes after its tables"),
    "a state below the lowest": (lambda: stream(MASKS + bytes(4)), "begins with the state 0; expected 65536 or more"),
    "a stream that ends too early": (lambda: stream(MASKS + b"\1\0\0\0"), "ends before its last symbol"),
    "a stream that goes on": (lambda: stream(tensor("packed.mask", "packed").tobytes() + bytes(2)), "does not end where its last symbol does"),
    "a bit that is 2": (lambda: stream(b"\1\0\x80\1" + b"\0\1\x80\x80\1" + b"\1\0\0\0"), "or holds one that stands for nothing"),
    "a code as that of no neighbour": (lambda: codes(b"\1\0\xb0\6" + b"\x80\x80\1" + b"\1\0\0\0"), "or holds one that stands for nothing"),
}
