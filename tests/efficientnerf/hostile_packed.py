"""A hostile file for each rule of FORMAT.md about the layout `packed`."""

import re
from collections.abc import Callable
from typing import Any

import numpy as np

from efficientnerf.asset.format import LAYOUTS
from tests.efficientnerf.damaged import blob, joined, meta_with, negative, parts, tensor, with_tensor, without

MASKS = b"\1\0\x80\1" + b"\x80\x40\x80\x40"  # all 128 contexts have table 0, in which 0 and 1 are as likely
SURE = b"\1\0\x80\1" + b"\x80\x80\1"  # only 0 occurs, which takes no bits
LOWEST = b"\1\0\0\0"  # the least state


def counted(**changes: Any) -> bytes:
    """The tiny packed file, which claims other counts."""
    _, meta, _ = parts(blob("packed"))
    return meta_with("packed", packed={**meta["packed"], **changes})


def stream(raw: bytes) -> bytes:
    return with_tensor("packed.mask", np.frombuffer(raw, "<u1"), "packed")


def codes(raw: bytes) -> bytes:
    return with_tensor("packed.sh", np.frombuffer(raw, "<u1"), "packed")


def sliced(raw: bytes) -> bytes:
    """The tiny packed file of two bricks, each a slice, with this stream of masks."""
    header, meta, data = parts(stream(raw))
    return joined(header, {**meta, "packed": {**meta["packed"], "slice_bricks": 1}}, data)


PACKED: dict[str, tuple[Callable[[], bytes], str]] = {
    **{f"packed, no {name}": (lambda name=name: without(name, "packed"), f"tensor '{re.escape(name)}' is missing") for name in LAYOUTS["packed"].tensors},  # type: ignore[misc]
    "packed, no counts": (lambda: meta_with("packed", packed="absent"), "'packed' is None; expected an object"),
    "packed voxels below zero": (lambda: counted(voxels=-1), "'voxels' is -1; expected a whole number from 0"),
    "packed bricks of a fraction": (lambda: counted(bricks=0.5), r"'bricks' is 0\.5; expected a whole number"),
    "packed codes of three bytes": (lambda: counted(code_bytes=3), "'code_bytes' is 3; expected a whole number from 1 to 2"),
    "more packed bricks than cells": (lambda: counted(bricks=4), "2 occupied cells but 4 bricks"),
    "more packed voxels than masks name": (lambda: counted(voxels=20), "masks name [0-9]+ voxels but 20 are stored"),
    "a bomb of voxels": (lambda: counted(voxels=2**31 - 1), r"take [0-9]+ MB of memory; expected at most 24 times the size and 200 MB"),
    "a bomb of bricks": (lambda: counted(bricks=2**31 - 1, slice_bricks=2**31 - 1), r"take [0-9]+ MB of memory; expected at most 24 times"),
    "a bomb of cells": (lambda: meta_with("packed", shape=[1024, 1024, 1024]), r"take [0-9]+ MB of memory; expected at most 24 times"),
    "packed codes of the other width": (lambda: counted(code_bytes=2), r"'packed\.sh' .*it is no stream of 1584 contexts"),
    "packed, no groups": (lambda: meta_with("packed", sh_groups="absent"), "'sh_groups' is None"),
    "packed densities without a table": (lambda: with_tensor("density.table", np.zeros(0, "<f4"), "packed"), "voxels, but a table without entries"),
    "packed codes beyond the palette": (lambda: with_tensor("sh.palette", tensor("sh.palette", "packed")[:1], "packed"), "expected codes below the 1 entries"),
    "a packed density below zero": (lambda: with_tensor("density.table", negative("density.table", "packed"), "packed"), "densities must be finite"),
    "an empty stream": (lambda: stream(b""), r"'packed\.mask' ends within its tables; it is no stream of 128 contexts and 1 slices"),
    "a stream without tables": (lambda: stream(b"\0"), "has no table"),
    "contexts of a table that is not there": (lambda: stream(b"\1\1\x80\1"), "gives 128 contexts the table 1 of 1"),
    "too many contexts": (lambda: stream(b"\1\0\x81\1"), "gives 129 contexts the table 0 of 1"),
    "no contexts": (lambda: stream(b"\1\0\0"), "gives 0 contexts the table 0 of 1"),
    "a number without end": (lambda: stream(b"\1\0" + b"\xff" * 9), "holds a number of more than four bytes"),
    "a table that is too much": (lambda: stream(b"\1\0\x80\1" + b"\x81\x80\1"), "has a table whose sum is 16385, not 16384"),
    "a table of too many symbols": (lambda: stream(b"\1\0\x80\1" + b"\0\xff\1\1"), "has a table whose sum is 0, not 16384"),
    "a bit that is 2": (lambda: stream(b"\1\0\x80\1" + b"\0\1\x80\x80\1" + b"\2" + LOWEST), "a table of symbols above 1 for one of the contexts 0 to 127"),
    "which neighbour, of five": (lambda: codes(b"\1\0\xb0\6" + b"\0\3\x80\x80\1" + b"\6" + 3 * LOWEST), "symbols above 3 for one of the contexts 0 to 111"),
    "a stream without slices": (lambda: stream(MASKS), "ends within its tables"),
    "a slice without a state": (lambda: stream(MASKS + b"\0"), r"slice 0 of 'packed\.mask' has 0 words; expected 2 at least"),
    "a slice of half a state": (lambda: stream(MASKS + b"\1\1\0"), "has 1 words; expected 2 at least"),
    "a slice with too few states": (lambda: codes(b"\1\0\xb0\6" + b"\x80\x80\1" + b"\5" + bytes(10)), r"'packed\.sh' has 5 words; expected 6 at least"),
    "a slice of words that are not there": (lambda: stream(MASKS + b"\3" + LOWEST), "has 4 bytes after its tables; expected 6, the words of its slices"),
    "a bomb of words": (lambda: stream(MASKS + b"\xff\xff\xff\x7f" + LOWEST), "has 4 bytes after its tables; expected 536870910, the words"),
    "a slice with a number without end": (lambda: stream(MASKS + b"\xff\xff\xff\xff\1" + LOWEST), "holds a number of more than four bytes"),
    "half a word": (lambda: stream(MASKS + b"\2" + bytes(5)), "has 5 bytes after its tables; expected 4, the words of its slices"),
    "a state below the lowest": (lambda: stream(MASKS + b"\2" + bytes(4)), "begins with the state 0; expected 65536 or more"),
    "a stream that ends too early": (lambda: stream(MASKS + b"\2" + LOWEST), r"slice 0 of 'packed\.mask' ends before its last symbol"),
    "a stream that goes on": (lambda: stream(tensor("packed.mask", "packed").tobytes() + bytes(2)), "bytes after its tables; expected [0-9]+, the words"),
    "a code as that of no neighbour": (lambda: codes(b"\1\0\xb0\6" + b"\x80\x80\1" + b"\6" + 3 * LOWEST), "or holds one that stands for nothing"),
    "slices of no bricks": (lambda: counted(slice_bricks=0), r"'slice_bricks' is 0; expected a whole number from 1"),
    "slices of a part of a brick": (lambda: counted(slice_bricks=1.5), r"'slice_bricks' is 1\.5; expected a whole number"),
    "no slices": (lambda: counted(slice_bricks=None), "'slice_bricks' is None; expected a whole number"),
    "more slices than there may be": (lambda: counted(bricks=8193, slice_bricks=2), r"'slice_bricks' is 2; expected a whole number from 3"),
    "more slices than the stream has": (lambda: counted(slice_bricks=1), r"'packed\.mask' has 3 bytes after its tables; expected 36, the words"),
    "a slice too many": (lambda: sliced(MASKS + b"\2\2\2" + 3 * LOWEST), "has 13 bytes after its tables; expected 8, the words of its slices"),
    "a slice too few": (lambda: sliced(MASKS + b"\2" + LOWEST), r"slice 1 of 'packed\.mask' has 1 words"),
    "a second slice below the lowest state": (lambda: sliced(MASKS + b"\2\2" + LOWEST + bytes(4)), "begins with the state 0; expected 65536 or more"),
    "a second slice that ends too early": (lambda: sliced(MASKS + b"\2\2" + b"\0\1\0\0" + LOWEST), r"slice 1 of 'packed\.mask' ends before its last symbol"),
    "a slice that takes words of the next": (lambda: sliced(SURE + b"\3\3" + 2 * (LOWEST + bytes(2))), r"slice 0 of 'packed\.mask' does not end where its"),
    "a slice that does not end": (lambda: sliced(SURE + b"\2\3" + 2 * LOWEST + bytes(2)), r"slice 1 of 'packed\.mask' does not end where its"),
    "a slice that ends in another state": (lambda: sliced(SURE + b"\2\2" + LOWEST + b"\1\0\1\0"), r"slice 1 of 'packed\.mask' does not end where its"),
}  # fmt: skip
