"""Mutation of TOML: values of settings, nesting, keys; the text at times."""

from random import Random

from benchmarks.fuzz.binary import LARGEST, changed_bytes
from benchmarks.fuzz.values import NUMBERS, TEXTS

_TOKENS = b"0123456789-.eE+[]{},=\"'\\ \n\t#_"
_VALUES = [
    "true", "false", "nan", "inf", "-inf", "1e999", "+0", "-0", "0x" + "f" * 300, "0b" + "1" * 2000, "1" + "0" * 5000, "9" * 400, "1979-05-27T07:32:00Z",
    "07:32:00", "9999-99-99", "[]", "[[]]", "{}",
    "{a = 1}", "[1, 2, 3, 4, 5, 6]", '["a", 1]', "[" * 100 + "]" * 100, "[" * 2000 + "]" * 2000, "[" * 50000, "{a=" * 800 + "1" + "}" * 800, '""', "''",
    '"""\n"""', '"\\ud800"', '"\\u0000"', "1_000",
    "1__0", "01", "nul", "[" + "0," * 5000 + "]", "a.b",
]  # fmt: skip
_LINES = ["[train]", "[[train]]", "[poses]", "[bake]", "[x]", "[]", "[a.b.c]", "[" + "a." * 300 + "a]", "a." * 300 + "a = 1", "preset = 'tiny'",
    "seed = 3", "device = 'cpu'", 'device = "\x1b[31m"', "seed = true",
          "preset = 3", '"" = 1', '"\\u001b[2J" = 1', "train = 3", "train.iterations = 3", "[train.iterations]", "iterations = 5", "# \x1b", "poses = []",
    "poses = [{}]"]  # fmt: skip


def _text(text: str) -> str:
    """TOML text of a string; some of what it holds has no escape in TOML, and makes the file invalid."""
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n") + '"'


def value(rng: Random) -> str:
    kind = rng.randrange(3)
    return rng.choice(_VALUES) if kind == 0 else str(rng.choice(NUMBERS)) if kind == 1 else _text(rng.choice(TEXTS))


def changed(rng: Random, data: bytes) -> bytes:
    """One to three lines changed."""
    if rng.random() < 0.15:
        return changed_bytes(rng, data, _TOKENS)
    lines = data.decode("utf-8", "replace").split("\n")
    for _ in range(1 + rng.randrange(3)):
        at = rng.randrange(len(lines))
        key, equals, _ = lines[at].partition("=")
        kind = rng.randrange(8)
        if kind < 4 and equals:
            lines[at] = f"{key}= {value(rng)}"
        elif kind == 4 and equals:
            lines[at] = f"{rng.choice(TEXTS)} = {value(rng)}"
        elif kind == 5 and len(lines) > 1:
            del lines[at]
        elif kind == 6:
            lines.insert(at, rng.choice(_LINES))
        else:
            lines.insert(at, rng.choice(lines))
    return "\n".join(lines).encode("utf-8", "surrogatepass")[:LARGEST]
