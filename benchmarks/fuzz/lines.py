"""Mutation of text in lines and words: COLMAP's text files, logs."""

from random import Random

from benchmarks.fuzz.binary import LARGEST, changed_bytes
from benchmarks.fuzz.values import NUMBERS, TEXTS

_TOKENS = b"0123456789-.eE+# \n\r\tnaif"
_WORDS = [
    "nan", "inf", "-inf", "NaN", "Infinity", "1e999", "0x10", "1_000", "#", "# Number of images: 7", "# Number of points: 99999999999999999999", "-", "--1",
    "²", "١", "1e400", "-" * 30 + "1",
]  # fmt: skip


def word(rng: Random) -> bytes:
    kind = rng.randrange(3)
    text = rng.choice(_WORDS) if kind == 0 else str(rng.choice(NUMBERS)) if kind == 1 else rng.choice(TEXTS)
    return text.encode("utf-8", "surrogatepass")


def changed(rng: Random, data: bytes) -> bytes:
    """One to three words or lines changed."""
    if rng.random() < 0.2:
        return changed_bytes(rng, data, _TOKENS)
    lines = data.split(b"\n")
    for _ in range(1 + rng.randrange(3)):
        at = rng.randrange(len(lines))
        words = lines[at].split(b" ")
        kind = rng.randrange(8)
        if kind < 4:
            words[rng.randrange(len(words))] = word(rng)
            lines[at] = b" ".join(words)
        elif kind == 4:
            words.insert(rng.randrange(len(words) + 1), word(rng))
            lines[at] = b" ".join(words)
        elif kind == 5:
            lines[at] = b" ".join(words[: rng.randrange(len(words) + 1)])
        elif kind == 6 and len(lines) > 1:
            del lines[at]
        else:
            lines.insert(at, rng.choice(lines))
    return b"\n".join(lines)[:LARGEST]
