"""Mutation of bytes: cut, flipped, copied, and numbers of every width set to their extremes."""

import struct
from random import Random

_INTEGERS = {width: [0, 1, 2, 2 ** (8 * width - 1) - 1, 2 ** (8 * width - 1), 2 ** (8 * width) - 1, 255 % 2 ** (8 * width)] for width in (1, 2, 4, 8)}
_LARGE = [2**16, 2**20, 2**24, 2**31 - 1, 2**32 - 1, 2**40, 2**60, 10**6, 10**9]
_FLOATS = [0.0, -0.0, 1.0, -1.0, float("nan"), float("inf"), float("-inf"), 1e30, 0.5, 1e-9, 2.0]
_LARGE_FLOATS = [1e308, -1e308, 5e-324, 1e154, 1e155, 1e-160]  # beyond single precision
LARGEST = 1 << 20  # bytes of an input


def number(rng: Random) -> bytes:
    """A number that is extreme for its width, of either byte order."""
    order = rng.choice("<<<>")
    if rng.random() < 0.35:
        return struct.pack(order + rng.choice("dddf"), rng.choice(_FLOATS)) if rng.random() < 0.7 else struct.pack(f"{order}d", rng.choice(_LARGE_FLOATS))
    width = rng.choice((1, 2, 4, 4, 8, 8))
    value = rng.choice(_LARGE if rng.random() < 0.3 else _INTEGERS[width]) % 2 ** (8 * width)
    return value.to_bytes(width, "little" if order == "<" else "big")


def changed_bytes(rng: Random, data: bytes, alphabet: bytes | None = None, begin: int = 0, end: int | None = None) -> bytes:
    """One to four changes between two places.

    alphabet  bytes that are put in, as random ones are: the punctuation of a text format
    """
    out = bytearray(data)
    for _ in range(1 + rng.randrange(4)):
        stop = len(out) if end is None else min(end, len(out))
        if stop <= begin:
            out += rng.randbytes(1 + rng.randrange(8))
            continue
        at, count = rng.randrange(begin, stop), 1 + rng.randrange(8)
        kind = rng.randrange(9)
        if kind == 0:
            out[at] ^= 1 << rng.randrange(8)
        elif kind == 1:
            out[at : at + count] = rng.randbytes(count)
        elif kind == 2:
            out[at:at] = rng.randbytes(count)
        elif kind == 3:
            del out[at : at + rng.choice((1, 2, 4, 8, 24, 100))]
        elif kind == 4:
            source, count = rng.randrange(len(out)), rng.choice((1, 4, 8, 64))
            out[at : at + count * rng.randrange(2)] = out[source : source + count]
        elif kind == 5 and alphabet is not None:
            out[at : at + rng.randrange(2)] = rng.choices(alphabet, k=1 + rng.randrange(2))
        elif kind in (5, 6, 7):
            put = number(rng)
            at -= at % len(put) if rng.random() < 0.5 else 0
            out[at : at + len(put)] = put
        else:
            del out[at:]
    return bytes(out[:LARGEST])
